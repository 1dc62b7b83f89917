"""A workcell file with every file it names, as one value that can be stored and unpacked.

The layout keeps the file's own relative references valid, so that the workcell's digest stays
the same. Absolute references are replaced by relative ones. Unpacking writes below one folder
only, and refuses files that refer to anything outside it.
"""

from __future__ import annotations

import base64
import hashlib
import posixpath
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from symbolic import outside
from symbolic.errors import BundleError, DualArmError, OutsideError, RobotModelError
from symbolic.robot.urdf_file import read_urdf
from symbolic.robot.xacro_file import is_xacro
from symbolic.workcell.file import load
from symbolic.workcell.problems import shown
from symbolic.workcell.records import Workcell
from symbolic.workcell.references import CellCollector, joined, parse_toml, references

MAX_FILES = 1000
MAX_TOTAL_BYTES = outside.CELL_BYTES
MAX_PLAIN_BYTES = 256 * 2**10
"""Text up to this size is stored as it is, anything else compressed."""

_SAFE_PART = re.compile(r"[^\x00-\x1f\x7f/\\:]+")


@dataclass(frozen=True)
class CellFiles:
    """A workcell's files.

    Attributes:
        workcell: path of the workcell file among `files`.
        files: content by relative POSIX path without `..`.
        folders: package folders that have to exist, as relative POSIX paths.
        digest: digest of the workcell as unpacked (`Workcell.digest`).
    """

    workcell: str
    files: Mapping[str, bytes]
    folders: tuple[str, ...]
    digest: str


def collect_cell(workcell: Workcell) -> CellFiles:
    """Collect the files of a workcell that was read with `symbolic.workcell.file.load`.

    Raises:
        BundleError: the file on disk no longer describes this workcell, or a reference cannot
            be made relative.
    """
    return _collected(workcell.source, workcell.digest, workcell.start_branch)


@lru_cache(maxsize=4)
def _collected(source: Path, digest: str, branches: tuple[int, int]) -> CellFiles:
    try:
        current = load(source, decided=branches)
    except DualArmError as error:
        raise BundleError(f"the workcell cannot be stored: {error}") from error
    if current.digest != digest:
        raise BundleError(
            f"{source.name} does not describe the workcell in memory (it was changed after "
            "reading); store trajectories of a workcell as its file has it"
        )
    collector = CellCollector(source)
    collector.collect(current)
    draft = CellFiles(*collector.layout(), digest="")
    with TemporaryDirectory() as folder:
        unpacked = unpack_cell(draft, Path(folder), check_digest=False)
    return CellFiles(draft.workcell, draft.files, draft.folders, unpacked.digest)


def unpack_cell(stored: CellFiles, folder: Path, check_digest: bool = True) -> Workcell:
    """Write a cell's files below a folder and read the workcell from there.

    Raises:
        BundleError: a path would leave the folder, a reference points outside of it, or the
            workcell is not the one that was stored.
    """
    root = folder.resolve()
    for name in (*stored.files, *stored.folders, stored.workcell):
        _check_name(name)
    for name in stored.folders:
        try:
            (root / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BundleError(
                f"stored folder {shown(name)} cannot be unpacked ({error.strerror})"
            ) from error
    for name, content in stored.files.items():
        target = root / name
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("xb") as file:
                file.write(content)
        except OSError as error:
            raise BundleError(
                f"stored file {shown(name)} cannot be unpacked ({error.strerror})"
            ) from error
    _check_references(stored, root)
    try:
        workcell = load(root / stored.workcell, stored=True)
    except DualArmError as error:
        raise BundleError(f"the stored workcell is not valid: {error}") from error
    if check_digest and workcell.digest != stored.digest:
        raise BundleError("the stored workcell's digest does not match its files")
    return workcell


def cell_to_json(stored: CellFiles) -> dict[str, Any]:
    """The files as JSON values: text as it is, binary and large files compressed."""
    return {
        "workcell": stored.workcell,
        "digest": stored.digest,
        "folders": list(stored.folders),
        "files": [_file_to_json(name, stored.files[name]) for name in sorted(stored.files)],
    }


def cell_from_json(data: Any) -> CellFiles:
    """The files from JSON values, every field checked.

    Raises:
        BundleError: with the field that is wrong.
    """
    if not isinstance(data, dict) or set(data) != {"workcell", "digest", "folders", "files"}:
        raise BundleError("cell: expected the keys workcell, digest, folders and files")
    entries, folders = data["files"], data["folders"]
    if not isinstance(entries, list) or not 0 < len(entries) <= MAX_FILES:
        raise BundleError(f"cell.files: expected 1 to {MAX_FILES} files")
    if not isinstance(folders, list) or not all(isinstance(name, str) for name in folders):
        raise BundleError("cell.folders: expected texts")
    if len(folders) > MAX_FILES:
        raise BundleError(f"cell.folders: expected at most {MAX_FILES} folders")
    if not isinstance(data["workcell"], str) or not isinstance(data["digest"], str):
        raise BundleError("cell.workcell and cell.digest: expected texts")
    files: dict[str, bytes] = {}
    room = MAX_TOTAL_BYTES
    for index, entry in enumerate(entries):
        name, content = _file_from_json(entry, index, room)
        if name in files:
            raise BundleError(f"cell.files[{index}]: {shown(name)} is stored twice")
        files[name] = content
        room -= len(content)
    if data["workcell"] not in files:
        raise BundleError("cell.workcell: names no stored file")
    return CellFiles(data["workcell"], files, tuple(folders), data["digest"])


def _file_to_json(name: str, content: bytes) -> dict[str, Any]:
    entry: dict[str, Any] = {"path": name, "sha256": hashlib.sha256(content).hexdigest()}
    if len(content) <= MAX_PLAIN_BYTES:
        try:
            return entry | {"encoding": "utf-8", "content": content.decode("utf-8")}
        except UnicodeDecodeError:
            pass
    packed = base64.b64encode(zlib.compress(content, 9)).decode("ascii")
    return entry | {"encoding": "zlib+base64", "content": packed}


def _file_from_json(entry: Any, index: int, room: int) -> tuple[str, bytes]:
    where = f"cell.files[{index}]"
    keys = ("path", "sha256", "encoding", "content")
    if not isinstance(entry, dict) or not all(isinstance(entry.get(key), str) for key in keys):
        raise BundleError(f"{where}: expected texts {', '.join(keys)}")
    _check_name(entry["path"])
    try:
        if entry["encoding"] == "utf-8":
            content = entry["content"].encode("utf-8")
        elif entry["encoding"] == "zlib+base64":
            packed = base64.b64decode(entry["content"], validate=True)
            # The limit keeps a small file from unfolding into a huge one.
            content = zlib.decompressobj().decompress(packed, room + 1)
        else:
            raise BundleError(f"{where}.encoding: expected utf-8 or zlib+base64")
    except (ValueError, zlib.error) as error:
        raise BundleError(f"{where}.content: cannot be decoded ({error})") from error
    if len(content) > room:
        raise BundleError(f"{where}: the files exceed {MAX_TOTAL_BYTES // 2**20} MiB unpacked")
    if hashlib.sha256(content).hexdigest() != entry["sha256"]:
        raise BundleError(f"{where}: the content of {shown(entry['path'])} is damaged")
    return entry["path"], content


def _check_name(name: str) -> None:
    parts = name.split("/")
    if not all(_SAFE_PART.fullmatch(part) and part not in (".", "..") for part in parts):
        raise BundleError(
            f"stored path {shown(name)} is not allowed; only plain relative paths are"
        )


def _check_references(stored: CellFiles, root: Path) -> None:
    """No reference of the workcell or of its URDFs may lead out of the files."""
    base = posixpath.dirname(stored.workcell)
    for reference, package_dirs in references(parse_toml(stored.files[stored.workcell])):
        target = joined(base, reference)
        if target not in stored.files:
            raise BundleError(f"the stored workcell names {shown(reference)}, which is not stored")
        if package_dirs is None:
            continue
        folders = [joined(base, entry) for entry in package_dirs]
        try:
            if is_xacro(stored.files[target]):
                raise OutsideError(
                    "holds xacro macros, which are never expanded from a stored cell"
                )
            named = read_urdf(root / target)
        except (OutsideError, RobotModelError) as error:
            raise BundleError(f"the stored {shown(target)} is not valid: {error}") from error
        for address in (*named.collision_meshes, *named.visual_meshes):
            relative = address.removeprefix("package://").removeprefix("file://")
            bases = folders if address.startswith("package://") else [posixpath.dirname(target)]
            if any(_leads_out(joined(folder, relative)) for folder in bases):
                raise BundleError(
                    f"the stored {shown(target)} names {shown(address)}, not stored with it"
                )


def _leads_out(path: str) -> bool:
    return path.startswith(("/", "../")) or path == ".."
