"""Files of results: atomic writes, and records that are stored as JSON and checked when they are
read.

The annotations of a record's fields state the allowed values, see `symbolic.read.tables`.
"""

from __future__ import annotations

import csv
import errno
import fcntl
import hashlib
import io
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hybrid_opt.errors import ResultsError
from symbolic import safe_io
from symbolic.errors import OutsideError
from symbolic.read.tables import checked
from symbolic.records.problems import FirstProblem, shown
from symbolic.safe_io import replace_file

Record = TypeVar("Record")

LOCK = ".lock"

RESUME = "make room and continue with --resume"
AGAIN = "make room and try again"
"""Advice in error messages about a full disk: `RESUME` for files of a study, `AGAIN` for others."""

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@contextmanager
def storing(path: Path, remedy: str = RESUME) -> Iterator[None]:
    """Convert operating system errors in the `with` block to a `ResultsError`.

    Args:
        path: path of the file or folder, for the error message.
        remedy: advice that the message gives if the disk is full.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise ResultsError(
                f"{path}: no space left to write ({error.strerror}); everything stored before is "
                f"kept: {remedy}",
                code="no-space",
            ) from error
        raise ResultsError(
            f"{path}: cannot be written ({error.strerror})", code="not-writable"
        ) from error


def write_atomically(path: Path, content: bytes, remedy: str = RESUME) -> None:
    """Replace the content of a file in one step, so that it survives a power failure. A missing
    folder is created.

    Args:
        path: path of the file.
        content: new content of the file.
        remedy: advice that the error message gives if the disk is full.

    Raises:
        ResultsError: the file cannot be written.
    """
    with storing(path, remedy):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content)


def write_json(path: Path, document: Any) -> None:
    """Replace the content of a file by JSON values, in one step as by `write_atomically`.

    Args:
        path: path of the file.
        document: JSON values.

    Raises:
        ValueError: a number is NaN or infinite.
        ResultsError: the file cannot be written.
    """
    text = json.dumps(document, indent=1, allow_nan=False)
    write_atomically(path, (text + "\n").encode())


def to_json(value: Any) -> Any:
    """Convert a dataclass record to JSON values.

    Numbers that are not finite become null. A field is left out if its value and its default are
    both None.
    """
    if is_dataclass(value):
        return {
            field.name: to_json(getattr(value, field.name))
            for field in fields(value)
            if not (field.default is None and getattr(value, field.name) is None)
        }
    if isinstance(value, np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, Mapping):
        return {key: to_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(entry) for entry in value]
    if isinstance(value, Enum):
        return value.value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def from_json(
    kind: type[Record], value: Any, path: Path | str, remedy: str, is_open: bool = True
) -> Record:
    """Convert JSON values to a record, and check them against its annotations.

    Args:
        kind: class of the record.
        value: the JSON values.
        path: path of the file, or another name of the values, for error messages.
        remedy: advice that the error message gives for a damaged file.
        is_open: True to ignore unknown keys, False to refuse them.

    Raises:
        ResultsError: a field is wrong; the message names the field and the problem.
    """
    try:
        record: Record = checked(kind, value, "", FirstProblem(open=is_open))
    except ValueError as error:
        place = "" if str(error).startswith(": ") else " at "
        raise ResultsError(f"{path}: damaged{place}{error}; {remedy}") from error
    return record


def read_record(kind: type[Record], path: Path, remedy: str) -> Record:
    """Read one record from a JSON file.

    Args:
        kind: class of the record.
        path: path of the file.
        remedy: advice for a damaged file.

    Raises:
        ResultsError: the file cannot be read or is damaged.
    """
    return record_of(kind, read_bytes(path), path, remedy)


def record_of(kind: type[Record], content: bytes, path: Path | str, remedy: str) -> Record:
    """Convert the content of a JSON file to a record, and check it.

    Args:
        kind: class of the record.
        content: content of the file.
        path: path of the file, for error messages.
        remedy: advice that the error message gives for a damaged file.

    Raises:
        ResultsError: the content is damaged.
    """
    return from_json(kind, json_of(content, path, remedy), path, remedy)


def csv_text(header: Sequence[str], rows: Iterable[Sequence[str | float]]) -> str:
    """Format a table as CSV text; numbers keep their exact value.

    Args:
        header: name of each column.
        rows: values of each row.
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()


def read_json(path: Path, remedy: str = "") -> Any:
    """Read JSON values.

    Args:
        path: the file.
        remedy: advice for a damaged file.

    Raises:
        ResultsError: the file cannot be read or is not JSON.
    """
    return json_of(read_bytes(path), path, remedy)


def json_of(content: bytes, path: Path | str, remedy: str = "") -> Any:
    """Parse the content of a JSON file.

    Args:
        content: content of the file.
        path: path of the file, for the error message.
        remedy: advice that the error message gives for a damaged file.

    Raises:
        ResultsError: the content is not JSON.
    """
    try:
        return safe_io.json_value(content)
    except OutsideError as error:
        told = f"; {remedy}" if remedy else ""
        raise ResultsError(f"{path}: damaged ({error}){told}") from error


def read_document(path: Path, form: str, version: int, remedy: str = "") -> dict[str, Any]:
    """Read a JSON object and check its entries `format` and `version`.

    Args:
        path: path of the file.
        form: expected format.
        version: expected version.
        remedy: advice for a damaged file or another format.

    Returns:
        All entries by name, with `format` and `version`.

    Raises:
        ResultsError: the file cannot be read, or is of another format or version.
    """
    document = read_json(path, remedy)
    if not isinstance(document, dict) or document.get("format") != form:
        told = f"; {remedy}" if remedy else ""
        raise ResultsError(f"{path}: `format` is not {form!r}{told}")
    if document.get("version") != version:
        found = shown(document.get("version"))
        raise ResultsError(f"{path}: version {found}; this program reads {version}")
    return document


def read_bytes(path: Path) -> bytes:
    """Read a file's content.

    Raises:
        ResultsError: the file cannot be read, is no regular file, or is larger than
            `safe_io.MOST_BYTES`.
    """
    try:
        return safe_io.read_bytes(path, safe_io.MOST_BYTES)
    except OutsideError as error:
        raise ResultsError(f"{path}: {error}") from error


def sha256(content: bytes) -> str:
    """Compute the SHA-256 digest of bytes as hexadecimal text."""
    return hashlib.sha256(content).hexdigest()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a results folder against other processes during the `with` block. If this process dies,
    the lock ends with it.

    Args:
        folder: the results folder.

    Raises:
        ResultsError: another process holds the lock, or the folder cannot be written.
    """
    path = folder / LOCK
    with storing(path):
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.read(handle, 32).decode(errors="replace").strip() or "unknown"
            raise ResultsError(
                f"{folder}: in use by another process (id {holder}); wait for it, or choose "
                "another --output"
            ) from error
        with storing(path):
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(handle)


def own_version() -> str:
    """Return the installed version of this project, 'not installed' without an installation."""
    try:
        return version("dual-arm-carry")
    except PackageNotFoundError:
        return "not installed"
