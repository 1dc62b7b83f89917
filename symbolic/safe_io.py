"""Reading and writing of files with bounds on type, size and content.

Every file that may come from outside is read here: workcells, URDFs, meshes, stored results,
trajectories, cache entries. Symbolic links are followed; the opened file is checked before it is
read. Texts are UTF-8. Depth and number of values of JSON and TOML are checked before a parser
builds them.

Messages state the problem and the remedy, but not the file's name; the caller adds it.

`replace_file` writes a file in one step.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from symbolic.errors import OutsideError

MEBIBYTE = 2**20

WORKCELL_BYTES = 1 * MEBIBYTE
URDF_BYTES = 16 * MEBIBYTE
MESH_BYTES = 64 * MEBIBYTE
CELL_BYTES = 128 * MEBIBYTE
"""Largest workcell file, URDF, mesh, and sum of all files that one workcell names."""

MOST_BYTES = 512 * MEBIBYTE
"""Largest file that is read."""

MAX_JSON_VALUES = 1_000_000
"""Largest number of values in one JSON document; each takes up to about 200 bytes of memory."""

MAX_NESTING = 50
"""Largest depth of nested values in JSON and TOML."""

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
_STRING_OR_BRACKET = re.compile(r'"(?:[^"\\]++|\\.)*+"?|[\[{]|[\]}]', re.DOTALL)
_DECLARED = re.compile(r"""^\s*<\?xml[^>]*?encoding\s*=\s*["']([^"']*)["']""")
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_KEYS_AND_TEXTS = re.compile(
    r'''"""(?:[^\\]|\\.)*?"""|'''
    r"""'''.*?'''|#[^\n]*+|"""
    rf"{_KEY_PART}(?P<further>(?:[ \t]*+\.[ \t]*+{_KEY_PART})*+)",
    re.DOTALL,
)
_LONG = re.compile(rf"(?:[ \t]*+\.[ \t]*+{_KEY_PART}){{{MAX_NESTING}}}")


def resolved(path: Path) -> Path:
    """Return the absolute path of an existing file, with symbolic links resolved.

    Raises:
        OutsideError: the file does not exist, or links lead in a circle.
    """
    try:
        return path.resolve(strict=True)
    except (OSError, ValueError, RuntimeError) as error:
        raise OutsideError(f"cannot be read ({_reason(error)})", code="unreadable") from error


def read_bytes(
    path: Path, most: int, judge: Callable[[os.stat_result], None] = lambda found: None
) -> bytes:
    """Return the content of a regular file.

    Args:
        path: the file, or a symbolic link to it.
        most: largest accepted size [bytes].
        judge: function of the opened file's status, called before the file is read; it may raise an
            error to refuse the file.

    Raises:
        OutsideError: the file cannot be read, is not a regular file, or is larger than `most`.
    """
    with _opened(path) as handle:
        judge(os.fstat(handle))
        return _content(handle, most)


def require(path: Path, most: int) -> None:
    """Check that `read_bytes` would accept a file, without reading it.

    Args:
        path: the file, or a symbolic link to it.
        most: largest accepted size [bytes].

    Raises:
        OutsideError: the file cannot be read, is not a regular file, or is larger than `most`.
    """
    with _opened(path) as handle:
        _require_regular(os.fstat(handle), most)


def text(content: bytes) -> str:
    """Decode the bytes of a UTF-8 text.

    Raises:
        OutsideError: the content is not UTF-8.
    """
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise OutsideError(
            f"byte {error.start} is not UTF-8; allowed is text in UTF-8, save it so",
            code="not-utf-8",
        ) from error


def xml_text(content: bytes) -> str:
    """Decode the bytes of a UTF-8 XML document, without a byte order mark.

    Raises:
        OutsideError: the content is not UTF-8, declares another encoding, or has a document type,
            whose entities may expand without end.
    """
    document = text(content).removeprefix("\ufeff")
    declared = _DECLARED.match(document[:1000])
    if declared and declared[1].lower() not in ("utf-8", "utf8", "us-ascii", "ascii"):
        raise OutsideError(
            f"declares the encoding {ascii(declared[1])[:60]}; allowed is UTF-8, save it so and "
            'declare encoding="utf-8"',
            code="encoding",
        )
    if "<!DOCTYPE" in document:
        raise OutsideError("has a document type (<!DOCTYPE>); remove it", code="document-type")
    return document


def json_value(content: bytes) -> Any:
    """Parse a JSON document in which all numbers are finite and all texts can be written as UTF-8.

    Raises:
        OutsideError: the content is not JSON, is nested too deeply, has too many values, or
            contains a number that is not finite or half a surrogate pair.
    """
    count = sum(content.count(mark) for mark in (b",", b"[", b"{"))
    # Quotation marks within texts count as well, so there may be more of them.
    if count > MAX_JSON_VALUES or content.count(b'"') > 8 * MAX_JSON_VALUES:
        raise OutsideError(
            f"holds more than {MAX_JSON_VALUES} values, which is the limit", code="too-many-values"
        )
    found = text(content)
    depth = _json_depth(found)
    if depth > MAX_NESTING:
        raise OutsideError(f"nested {depth} deep; allowed is {MAX_NESTING}", code="too-deep")
    try:
        value = json.loads(found, parse_constant=_refuse_constant, parse_float=_finite)
    except ValueError as error:
        raise OutsideError(f"not JSON: {_one_line(error)}", code="not-json") from error
    if _SURROGATE.search(found):
        _refuse_surrogates(value)
    return value


def toml_tables(content: bytes) -> dict[str, Any]:
    """Parse a TOML document into nested dictionaries.

    Raises:
        OutsideError: the content is not TOML or is nested too deeply.
    """
    found = text(content)
    if found.startswith("\ufeff"):
        raise OutsideError(
            "begins with a byte order mark; save it as UTF-8 without one", code="byte-order-mark"
        )
    if any(
        _LONG.match(found, *match.span("further"))
        for match in _KEYS_AND_TEXTS.finditer(found)
        if match["further"]
    ):
        raise OutsideError(f"a key of more than {MAX_NESTING} parts; {_TOO_DEEP}", code="too-deep")
    try:
        tables = tomllib.loads(found)
    except RecursionError as error:
        raise OutsideError(_TOO_DEEP, code="too-deep") from error
    except ValueError as error:  # also from numbers with too many digits
        raise OutsideError(f"not valid TOML: {_one_line(error)}", code="not-toml") from error
    if _depth(tables) > MAX_NESTING:
        raise OutsideError(_TOO_DEEP, code="too-deep")
    return tables


_TOO_DEEP = f"nested too deeply; allowed is a depth of {MAX_NESTING}"


def megabytes(size: float) -> str:
    """Return a size in bytes as text in MiB."""
    return f"{size / MEBIBYTE:.3g} MiB"


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    try:
        # Without O_NONBLOCK the opening of a pipe would wait for a writer.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
        try:
            yield handle
        finally:
            os.close(handle)
    except (OSError, ValueError) as error:
        raise OutsideError(f"cannot be read ({_reason(error)})", code="unreadable") from error


def _require_regular(found: os.stat_result, most: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = next((name for test, name in _KINDS if test(found.st_mode)), "no regular file")
        raise OutsideError(
            f"cannot be read (it is {kind}); allowed is a regular file", code="no-regular-file"
        )
    if found.st_size > most:
        raise OutsideError(
            f"is too large ({megabytes(found.st_size)}); allowed are {megabytes(most)}",
            code="too-large",
        )


def _content(handle: int, most: int) -> bytes:
    found = os.fstat(handle)
    _require_regular(found, most)
    content = bytearray()
    # A file may grow meanwhile, and some of /proc do not tell their size.
    while len(content) <= most and (part := os.read(handle, min(found.st_size + 1, 2**24))):
        content += part
    if len(content) > most:
        raise OutsideError(f"is too large; allowed are {megabytes(most)}", code="too-large")
    return bytes(content)


def _json_depth(document: str) -> int:
    depth = deepest = 0
    for match in _STRING_OR_BRACKET.finditer(document):
        mark = document[match.start()]
        if mark in "[{":
            depth += 1
            deepest = max(deepest, depth)
        elif mark in "]}":
            depth -= 1
    return deepest


def _depth(value: Any) -> int:
    """Return the depth of nested tables and arrays. It is computed without recursion."""
    level, layer = 0, [value]
    while layer:
        level += 1
        layer = [
            inner
            for outer in layer
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, dict | list)
        ]
    return level


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _finite(digits: str) -> float:
    number = float(digits)
    if math.isinf(number):
        raise ValueError(f"{digits[:60]} is no finite number")
    return number


def _refuse_surrogates(value: Any) -> None:
    """Raise an OutsideError if a text contains half a surrogate pair, which no file and no terminal
    accepts."""
    left = [value]
    while left:
        one = left.pop()
        if isinstance(one, dict):
            left += [*one.keys(), *one.values()]
        elif isinstance(one, list):
            left += one
        elif isinstance(one, str) and not one.isascii():
            try:
                one.encode("utf-8")
            except UnicodeEncodeError as error:
                raise OutsideError(
                    f"the text {ascii(one)[:60]} holds half a surrogate pair; write the character",
                    code="half-surrogate",
                ) from error


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return _one_line(error) or "it is not a file"


def _one_line(error: Exception) -> str:
    found = (str(error).splitlines() or [""])[0]
    if found.startswith("Exceeds the limit"):
        return "a whole number of more than 4300 digits"
    return found if len(found) <= 200 else f"{found[:197]}..."


def replace_file(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Replace a file such that an interruption at any moment leaves either the old or the new
    content.

    The new content is first written to `.NAME.draft` beside the file, under a lock, so that a
    second writer of the same file waits. A draft that a killed process left is overwritten.

    Args:
        path: the file, in an existing folder.
        content: new content of the file.
        mode: permissions of the file, as far as the process's mask allows them.

    Raises:
        OSError: the file cannot be written; the draft is removed.
    """
    draft = path.with_name(f".{path.name}.draft")
    with _alone(draft, mode) as file:
        try:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            os.replace(draft, path)
        except OSError:
            with suppress(OSError):
                draft.unlink()
            raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Write the entries of a folder to the disk, so that a power failure does not lose them.

    Raises:
        OSError: the folder does not exist, or the disk cannot be written.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _alone(draft: Path, mode: int) -> Iterator[BinaryIO]:
    """Open a file for writing, emptied, while no other process writes it: under an exclusive lock,
    if the file system supports locks.

    Args:
        draft: path of the file.
        mode: permission bits of a new file.
    """
    while True:
        with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, mode), "wb") as file:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
            if _is_still(draft, file):
                file.truncate(0)
                yield file
                return


def _is_still(draft: Path, file: BinaryIO) -> bool:
    """Return True if the path `draft` still refers to the open file. It does not if a former owner
    of the lock has renamed the file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), draft.stat(follow_symlinks=False))
    except FileNotFoundError:
        return False


def printable(text: str) -> str:
    """Return a text of unknown origin as one line: characters that cannot be printed become spaces,
    and runs of spaces one space."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
