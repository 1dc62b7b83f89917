"""A workcell file and all files that it names, as one value that can be stored and unpacked.

Relative references in the workcell file stay valid, so its digest does not change. Absolute
references are replaced by relative ones. Files are unpacked below one folder only; a stored file
that refers to anything outside of it is refused.

The drivable variant of a cell is the same cell with the time law `OPTIMAL`. Only this key of the
file's text is changed; comments and everything else stay.
"""

from __future__ import annotations

import base64
import hashlib
import posixpath
import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from symbolic import safe_io
from symbolic.errors import BundleError, DualArmError, OutsideError
from symbolic.read.cell import load, with_branches
from symbolic.read.descriptions import (
    PACKAGE_SCHEME,
    description_content,
    is_mjcf,
    is_xacro,
    resolve_mesh,
)
from symbolic.read.editing import completed, merged, with_paths
from symbolic.read.tables import checked
from symbolic.read.urdf import parse_urdf, read_urdf
from symbolic.records import Robot, Workcell
from symbolic.records.problems import FirstProblem, shown
from symbolic.records.time_law import OPTIMAL

MAX_FILES = 1000
MAX_TOTAL_BYTES = safe_io.CELL_BYTES
MAX_PLAIN_BYTES = 256 * 2**10
"""Text up to this size is stored uncompressed, larger text and binary content compressed
[bytes]."""

_UNSAFE = r"[\x00-\x1f\x7f/\\:]"


@dataclass(frozen=True)
class CellFiles:
    """A workcell file and the files that it names.

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

    def __hash__(self) -> int:
        return hash(self.digest)


def collect_cell(workcell: Workcell) -> CellFiles:
    """Collect the files of a workcell that was read with `symbolic.read.cell.load`.

    Raises:
        BundleError: a file was changed after the workcell was read, or a reference cannot be made
            relative.
    """
    known = workcell.source, workcell.digest, workcell.start_branch, workcell.text
    return _collected(*known)


@lru_cache(maxsize=4)
def _collected(
    source: Path, digest: str, branches: tuple[int, int], text: bytes | None
) -> CellFiles:
    with _as_bundle_errors("the workcell cannot be stored:"):
        current = load(source, decided=branches, text=text)
    if current.digest != digest:
        raise BundleError(
            f"{source.name} does not describe the workcell in memory (it was changed after "
            "reading); store trajectories of a workcell as its file has it",
            code="changed-in-memory",
        )
    collector = CellCollector(source, text)
    collector.collect(current)
    draft = CellFiles(*collector.layout(), digest="")
    with TemporaryDirectory() as folder:
        unpacked = unpack_cell(draft, Path(folder), check_digest=False)
    return CellFiles(draft.workcell, draft.files, draft.folders, unpacked.digest)


def unpack_cell(stored: CellFiles, folder: Path, check_digest: bool = True) -> Workcell:
    """Write a cell's files below a folder, and read the workcell from there.

    Args:
        stored: the files.
        folder: the folder; files in it are not overwritten.
        check_digest: True to check that the workcell's digest is the stored one.

    Raises:
        BundleError: a path would leave the folder, a reference points outside of it, a file cannot
            be written, or the workcell is not valid or not the stored one.
    """
    root = folder.resolve()
    named = {"files": stored.files, "folders": stored.folders, "workcell": (stored.workcell,)}
    for key, names in named.items():
        for name in names:
            _check_name(name, f"cell.{key}")
    name = ""
    try:
        for name in stored.folders:
            (root / name).mkdir(parents=True, exist_ok=True)
        for name, content in stored.files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            with (root / name).open("xb") as file:
                file.write(content)
    except OSError as error:
        raise BundleError(f"stored {shown(name)} cannot be unpacked ({error.strerror})") from error
    _check_references(stored, root)
    with _as_bundle_errors("the stored workcell is not valid:"):
        workcell = load(root / stored.workcell, stored=True)
    if check_digest and workcell.digest != stored.digest:
        raise BundleError("the stored workcell's digest does not match its files", code="digest")
    return workcell


Encoding = Literal["utf-8", "zlib+base64"]


@dataclass(frozen=True)
class StoredFile:
    """A file as JSON values.

    Attributes:
        path: relative POSIX path of the file.
        sha256: checksum of the content.
        encoding: 'utf-8' for text as it is; 'zlib+base64' for binary and large files.
        content: the encoded content.
    """

    path: str
    sha256: str
    encoding: Encoding
    content: str


@dataclass(frozen=True)
class StoredFiles:
    """The files of a workcell (`CellFiles`) as JSON values.

    Attributes:
        workcell: path of the workcell file among the files.
        digest: digest of the workcell as unpacked.
        folders: package folders that have to exist, as relative POSIX paths.
        files: the files with their content.
    """

    workcell: str
    digest: str
    folders: tuple[str, ...]
    files: tuple[StoredFile, ...]


def cell_to_json(stored: CellFiles) -> dict[str, Any]:
    """Convert a workcell's files to a dictionary for JSON, with the fields of `StoredFiles` as
    keys."""
    files = [asdict(_packed(name, stored.files[name])) for name in sorted(stored.files)]
    return {
        "workcell": stored.workcell,
        "digest": stored.digest,
        "folders": list(stored.folders),
        "files": files,
    }


def cell_from_json(data: Any) -> CellFiles:
    """Read a workcell's files from the JSON values of `StoredFiles`, and check every field.

    Raises:
        BundleError: a field is wrong; the message names it.
    """
    try:
        stored: StoredFiles = checked(StoredFiles, data, "cell", FirstProblem())
    except ValueError as error:
        raise BundleError(str(error), code="field") from error
    for name in ("files", "folders"):
        if len(getattr(stored, name)) > MAX_FILES:
            raise BundleError(f"cell.{name}: expected at most {MAX_FILES}")
    files: dict[str, bytes] = {}
    room = MAX_TOTAL_BYTES
    for index, entry in enumerate(stored.files):
        _check_name(entry.path, f"cell.files[{index}].path")
        if entry.path in files:
            raise BundleError(f"cell.files[{index}]: {shown(entry.path)} is stored twice")
        files[entry.path] = _unpacked(entry, f"cell.files[{index}]", room)
        room -= len(files[entry.path])
    if stored.workcell not in files:
        raise BundleError("cell.workcell: names no stored file")
    return CellFiles(stored.workcell, files, stored.folders, stored.digest)


def _packed(name: str, content: bytes) -> StoredFile:
    checksum = hashlib.sha256(content).hexdigest()
    if len(content) <= MAX_PLAIN_BYTES:
        with suppress(UnicodeDecodeError):
            return StoredFile(name, checksum, "utf-8", content.decode("utf-8"))
    return StoredFile(name, checksum, "zlib+base64", _compressed(content))


@lru_cache(maxsize=32)
def _compressed(content: bytes) -> str:
    """Compress bytes with zlib and return them as base64 text.

    Results are cached: a study stores its cell in several trajectory files, and the meshes of two
    robots are 10 MB.
    """
    return base64.b64encode(zlib.compress(content)).decode("ascii")


def _unpacked(entry: StoredFile, where: str, room: int) -> bytes:
    try:
        if entry.encoding == "utf-8":
            content = entry.content.encode("utf-8")
        else:
            packed = base64.b64decode(entry.content, validate=True)
            # The limit keeps a small file from unfolding into a huge one.
            content = zlib.decompressobj().decompress(packed, room + 1)
    except (ValueError, zlib.error) as error:
        raise BundleError(
            f"{where}.content: cannot be decoded ({error})", code="not-decodable"
        ) from error
    if len(content) > room:
        raise BundleError(
            f"{where}: the files exceed {MAX_TOTAL_BYTES // 2**20} MiB unpacked", code="too-large"
        )
    if hashlib.sha256(content).hexdigest() != entry.sha256:
        raise BundleError(f"{where}: the content of {shown(entry.path)} is damaged", code="damaged")
    return content


def _check_name(name: str, key: str) -> None:
    if not _is_plain(name) or ".." in name.split("/"):
        raise BundleError(
            f"{key}: stored path {shown(name)} is not allowed; only plain relative paths are",
            code="path",
        )


def _is_plain(name: str) -> bool:
    return all(part not in ("", ".") and not re.search(_UNSAFE, part) for part in name.split("/"))


def _check_references(stored: CellFiles, root: Path) -> None:
    """Check that a stored workcell file and its URDFs name only stored files, and that robots are
    described by plain URDF, neither xacro nor MJCF.

    Args:
        stored: the files.
        root: folder to which their paths are relative.

    Raises:
        BundleError: a name leads outside the stored files, or a description is not a valid URDF.
    """
    base = posixpath.dirname(stored.workcell)
    for reference, package_dirs in references(parse_toml(stored.files[stored.workcell])):
        target = joined(base, reference)
        if target not in stored.files:
            raise BundleError(
                f"the stored workcell names {shown(reference)}, which is not stored",
                code="not-stored",
            )
        if package_dirs is None:
            continue
        folders = [joined(base, entry) for entry in package_dirs]
        with _as_bundle_errors(f"the stored {shown(target)} is not valid:"):
            if is_xacro(stored.files[target]):
                raise OutsideError(
                    "holds xacro macros, which are never expanded from a stored cell",
                    code="xacro-macros",
                )
            if is_mjcf(stored.files[target]):
                raise OutsideError("is MJCF, which a stored cell holds as URDF")
            named = read_urdf(root / target)
        for address in (*named.collision_meshes, *named.visual_meshes):
            relative = address.removeprefix("package://").removeprefix("file://")
            bases = folders if address.startswith("package://") else [posixpath.dirname(target)]
            if any(f"{joined(folder, relative)}/".startswith(("/", "../")) for folder in bases):
                raise BundleError(
                    f"the stored {shown(target)} names {shown(address)}, not stored with it",
                    code="not-stored",
                )


# --- finding the files ---


class CellCollector:
    """Collector of the files of a workcell.

    Each file gets a path relative to the workcell file.
    """

    def __init__(self, source: Path, text: bytes | None = None) -> None:
        self._source = source
        self._text = _content(source, safe_io.WORKCELL_BYTES) if text is None else text
        self._files: dict[str, bytes] = {}
        self._folders: list[str] = []
        self._moved = 0
        self._places: dict[str, str] = {}

    def collect(self, workcell: Workcell) -> None:
        """Add the content of every file that a workcell needs: robot descriptions with their
        meshes, and meshes of the payload and of obstacles.

        In the collected text of the workcell file, paths are replaced by those of the collected
        files, and each robot states its URDF and its start branch.

        Args:
            workcell: the workcell as read from the file of this collector.

        Raises:
            BundleError: a file cannot be read, or the workcell's text cannot be changed.
        """
        self._text = with_branches(self._text, parse_toml(self._text), workcell.start_branch)
        stated = parse_toml(self._text)
        described = [
            {"robot": None, "urdf": str(robot.urdf)} if "robot" in entry else {}
            for robot, entry in zip(workcell.robots, stated["robots"], strict=True)
        ]
        data = merged(stated, {"robots": described})
        for robot, entry in zip(workcell.robots, data["robots"], strict=True):
            urdf = self._place(str(entry["urdf"]))
            folders = [self._place(str(folder)) for folder in entry.get("package_dirs", [])]
            self._folders.extend(folders)
            # Folders beyond those of the file belong to this machine; what they hold is embedded.
            named = list(zip(robot.package_dirs, folders, strict=False))
            self._files[urdf] = self._with_meshes(robot, urdf, named)
            if robot.srdf is not None:
                place = self._place(str(entry["srdf"]))
                self._files[place] = _content(robot.srdf, safe_io.URDF_BYTES)
        for reference, package_dirs in references(data):
            if package_dirs is None and self._place(reference) not in self._files:
                content = _content(self._source.parent / reference, safe_io.MESH_BYTES)
                self._files[self._place(reference)] = content
        changes = merged({"robots": described}, with_paths(data, self._address))
        with _as_bundle_errors(f"{self._source.name}:"):
            self._text = completed(safe_io.text(self._text), stated, changes).encode()

    def layout(self) -> tuple[str, dict[str, bytes], tuple[str, ...]]:
        """Return all collected files, with paths below one common folder.

        Paths of collected files are relative to the workcell file and may contain '..'. If so, the
        workcell file is put into as many subfolders as the longest sequence of '..' needs.

        Returns:
            The path of the workcell file, the content of every file by path, and the package
            folders.
        """
        names = [name.split("/") for name in (*self._files, *self._folders)]
        depth = max((parts.count("..") for parts in names), default=0)
        taken = {part for parts in names for part in parts}
        level = next(name for name in (f"cell{k or ''}" for k in count()) if name not in taken)
        base = "/".join([level] * depth)
        workcell = joined(base, "workcell.toml" if depth else f"{level}.toml")
        files = {joined(base, name): content for name, content in self._files.items()}
        files[workcell] = self._text
        folders = dict.fromkeys(joined(base, name) for name in self._folders)
        folders.pop(".", None)  # the workcell file's own folder exists in any case
        return workcell, files, tuple(folders)

    def _place(self, reference: str) -> str:
        return posixpath.normpath(self._address(reference))

    def _address(self, reference: str) -> str:
        place = posixpath.normpath(reference)
        if not reference.startswith(PACKAGE_SCHEME) and (place == "." or _is_plain(place)):
            turns_back = reference.split("/").count("..") > place.split("/").count("..")
            return place if turns_back else reference  # the folder in between is not stored
        if reference not in self._places:  # both robots may name one file
            self._places[reference] = self._new_place(reference)
        return self._places[reference]

    def _new_place(self, reference: str) -> str:
        self._moved += 1
        name = re.sub(_UNSAFE, "_", posixpath.basename(posixpath.normpath(reference)))
        return f"embedded/{self._moved}/{name or 'folder'}"

    def _with_meshes(self, robot: Robot, place: str, packages: list[tuple[Path, str]]) -> bytes:
        """Add the meshes of a robot's URDF, and return the URDF with all mesh addresses valid among
        the collected files.

        Args:
            robot: the robot.
            place: path of the URDF among the collected files.
            packages: package folders on this machine, each with its path among the collected files.
        """
        path = robot.urdf
        with _as_bundle_errors():
            content = description_content(path, robot.xacro_arguments, robot.package_dirs)
            named = parse_urdf(content, path.name)
        for address in dict.fromkeys((*named.collision_meshes, *named.visual_meshes)):
            mesh = resolve_mesh(address, path, robot.package_dirs)
            if mesh is None:
                continue
            target = self._own_place(address, path, place, packages)
            if target is None or not _is_plain(target):
                # Below the URDF's folder, whose own name the address need not know.
                relative = self._new_place(mesh.as_posix())
                target = joined(posixpath.dirname(place), relative)
                content = _replaced(content.decode("utf-8"), address, relative, path.name).encode(
                    "utf-8"
                )
            self._files[target] = _content(mesh, safe_io.MESH_BYTES)
        return content

    @staticmethod
    def _own_place(
        address: str, urdf: Path, place: str, packages: list[tuple[Path, str]]
    ) -> str | None:
        """Return the path of a mesh among the collected files; None if the mesh is outside the
        workcell's folders.

        Args:
            address: address of the mesh in the URDF.
            urdf: path of the URDF on this machine.
            place: path of the URDF among the collected files.
            packages: package folders on this machine, each with its path among the collected files.
        """
        if address.startswith(PACKAGE_SCHEME):
            held = (at for folder, at in packages if resolve_mesh(address, urdf, (folder,)))
            folder = next(held, None)
            return folder and joined(folder, address.removeprefix(PACKAGE_SCHEME))
        target = address.removeprefix("file://")
        return None if posixpath.isabs(target) else joined(posixpath.dirname(place), target)


def _content(path: Path, most: int) -> bytes:
    with _as_bundle_errors(str(path)):
        return safe_io.read_bytes(path, most)


@contextmanager
def _as_bundle_errors(subject: str = "") -> Iterator[None]:
    """Convert errors that are raised in the `with` block to a `BundleError` about `subject`."""
    try:
        yield
    except DualArmError as error:
        raise BundleError(f"{subject} {error}".lstrip()) from error


def _replaced(text: str, reference: str, moved: str, file: str) -> str:
    """Return a text in which every quoted `reference` is replaced by the path `moved`.

    Args:
        text: the text of a file.
        reference: the path or address to replace.
        moved: the new path.
        file: name of the file, for messages.
    """
    for quote in ('"', "'"):
        if f"{quote}{reference}{quote}" in text:
            return text.replace(f"{quote}{reference}{quote}", f"{quote}{moved}{quote}")
    raise BundleError(
        f"{file} names {reference!r} by an absolute path in an unusual spelling; write it "
        "relative to the file so that the trajectory can be stored with it"
    )


def joined(base: str, reference: str) -> str:
    """Return the path of `reference`, which is relative to the folder `base`, with every `..`
    resolved."""
    return posixpath.normpath(posixpath.join(base, reference))


def parse_toml(content: bytes) -> dict[str, Any]:
    """Parse a workcell file into nested dictionaries.

    Raises:
        BundleError: the content is not TOML.
    """
    with _as_bundle_errors("the stored workcell:"):
        return safe_io.toml_tables(content)


def references(data: Mapping[str, Any]) -> Iterator[tuple[str, list[str] | None]]:
    """Yield every path or address by which a workcell file names a file: descriptions of robots,
    then meshes. With a URDF comes the list of its package folders, with any other file None.

    Args:
        data: the tables of the workcell file.

    Raises:
        BundleError: a key is missing or has another type.
    """
    try:
        for robot in data.get("robots", []):
            yield str(robot["urdf"]), [str(entry) for entry in robot.get("package_dirs", [])]
            if "srdf" in robot:
                yield str(robot["srdf"]), None
            yield from _meshes(robot.get("tool", []))
        yield from _meshes(data.get("environment", []))
        yield from _meshes([data.get("payload", {})])
    except (KeyError, TypeError, AttributeError) as error:
        raise BundleError(
            f"the stored workcell lacks or misuses the key {error}", code="missing-key"
        ) from error


def _meshes(bodies: Any) -> Iterator[tuple[str, None]]:
    for body in bodies:
        if body.get("kind") == "mesh":
            yield str(body["path"]), None


# --- the drivable variant ---


def drivable_files(stored: CellFiles) -> CellFiles:
    """Return the files of a cell (`collect_cell`) with the time law changed to 'optimal': timed
    from rest to rest within all limits of the robots.

    Raises:
        BundleError: the file writes the task in a way that cannot be changed line by line, or the
            changed cell is not valid.
    """
    content = stored.files[stored.workcell]
    law = {"task": {"time_law": OPTIMAL}}
    with _as_bundle_errors(f"{stored.workcell}: the time law cannot be changed:"):
        changed = completed(safe_io.text(content), parse_toml(content), law).encode()
    draft = replace(stored, files={**stored.files, stored.workcell: changed}, digest="")
    with TemporaryDirectory() as folder:
        digest = unpack_cell(draft, Path(folder), check_digest=False).digest
    return replace(draft, digest=digest)
