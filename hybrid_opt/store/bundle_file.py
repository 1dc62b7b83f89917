"""A bundle as a folder of files, written in one step. Its manifest holds the digests of all files
and its own digest, which is checked when it is read.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import AGAIN, read_bytes, read_document, sha256, storing
from symbolic.safe_io import replace_file, sync_folder

MANIFEST = "manifest.json"

MEASURED_FILE = "measured.toml"
"""Name of the file that the bundle's bring-up program writes into the bundle; it is kept when the
bundle is replaced."""

BUNDLE_FORMAT = "dual-arm-carry bundle"
BUNDLE_VERSION = 2


def write_bundle(
    folder: Path, contents: Mapping[str, str | bytes], manifest: Mapping[str, Any]
) -> tuple[Path, ...]:
    """Write the files and the manifest of a bundle to a folder, replacing an older bundle in one
    step.

    Everything is written next to the folder first: if the disk is full, the old files stay.

    Args:
        folder: folder that holds nothing but the bundle.
        contents: content of each file, by path relative to the folder.
        manifest: JSON values by name; digests of the files and of the manifest are added.

    Returns:
        Paths of the written files, the manifest first.

    Raises:
        ResultsError: the bundle cannot be written, or the folder holds other files.
    """
    _require_own(folder)
    data = {
        name: text.encode() if isinstance(text, str) else text for name, text in contents.items()
    }
    document = {"format": BUNDLE_FORMAT, "version": BUNDLE_VERSION, **manifest}
    document["files"] = {name: sha256(content) for name, content in data.items()}
    document["sha256"] = sha256(_text(document))
    text = _text(document)
    draft = folder.with_name(f".{folder.name}.{os.getpid()}")
    old = folder.with_name(f".{folder.name}.old")
    with storing(folder, AGAIN):
        try:
            for name, content in ((MANIFEST, text), *data.items()):
                (draft / name).parent.mkdir(parents=True, exist_ok=True)
                replace_file(draft / name, content)
            if folder.exists():
                shutil.rmtree(old, ignore_errors=True)
                os.rename(folder, old)
            os.rename(draft, folder)
        except OSError:
            if old.exists() and not folder.exists():
                os.rename(old, folder)
            with suppress(OSError):
                shutil.rmtree(draft)
            raise
        shutil.rmtree(old, ignore_errors=True)
        sync_folder(folder.parent)
    return tuple(folder / name for name in (MANIFEST, *data))


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a bundle and check its checksum.

    Args:
        folder: folder of the bundle.

    Returns:
        Entries of the manifest by name, as JSON values, without the checksum.

    Raises:
        ResultsError: the manifest is missing, damaged, or was changed after writing.
    """
    path = folder / MANIFEST
    document = read_document(path, BUNDLE_FORMAT, BUNDLE_VERSION)
    files = document.get("files")
    if not isinstance(files, dict) or not all(isinstance(f, str) for f in files.values()):
        raise ResultsError(f"{path}: damaged (files: expected digests by name)")
    if document.pop("sha256", None) != sha256(_text(document)):
        raise ResultsError(f"{path}: was changed since it was written, its checksum differs")
    return document


def _require_own(folder: Path) -> None:
    """Check that a folder can be replaced by a bundle: it is missing, empty, or holds only a bundle
    whose files are unchanged since they were written.

    Raises:
        ResultsError: the folder holds another or a changed file; the message names the first one.
    """
    if not os.path.lexists(folder):
        return
    remedy = "it stays as it is: move it away, or choose another --output"
    if folder.is_symlink() or not folder.is_dir():
        raise ResultsError(f"{folder} is in the way of a bundle; {remedy}", code="in-the-way")
    found = sorted(path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    if not found:
        return
    try:
        files = read_manifest(folder)["files"]
    except ResultsError as error:
        text = f"{found[0]} is in the way of a bundle ({error}); {remedy}"
        raise ResultsError(text, code="in-the-way") from error
    for path in found:
        name = path.relative_to(folder).as_posix()
        if name in (MANIFEST, MEASURED_FILE):
            continue
        if name not in files or path.is_symlink():
            raise ResultsError(f"{path} is no file of this bundle; {remedy}", code="foreign-file")
        if sha256(read_bytes(path)) != files[name]:
            raise ResultsError(
                f"{path} was changed since it was written; {remedy}", code="changed-file"
            )


def _text(document: Mapping[str, Any]) -> bytes:
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()
