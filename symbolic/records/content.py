"""Records and their values as bytes, for digests and cache keys; the identity of a workcell."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np


def digest_of_parts(value: Any, folder: Path = Path()) -> str:
    """Compute the SHA-256 (hexadecimal text) of a value's content: of a record field by field, of a
    tuple entry by entry.

    Args:
        value: record, tuple, array or plain value.
        folder: folder to which paths in the value count as relative.
    """
    found, left = list[bytes](), [value]
    while left:
        part = left.pop()
        kind = _kind(part.__class__)
        if kind == "plain":
            found.append(_of_plain(part))
        elif kind == "tuple":
            found.append(_tuple_head(len(part)))
            left += reversed(part)
        elif kind == "array":
            found.append(_array_head(part.dtype, part.shape))
            found.append(_counted(part.tobytes()))
        elif kind == "content":
            found.append(_counted(part.content.encode()))
        elif kind == "record":
            head, names = _record(part.__class__)
            found.append(head)
            left += [getattr(part, name) for name in reversed(names)]
        elif kind == "type":
            found.append(_counted(part.__name__.encode()))
        elif kind == "path":
            text = os.path.relpath(part, folder)
            found.append(_counted(text.encode(errors="surrogateescape")))
        else:
            # Numbers come back from their representation to the bit.
            found.append(_of_value(part))
    return hashlib.sha256(b"".join(found)).hexdigest()


def _counted(part: bytes) -> bytes:
    """Return bytes with their length in front, so that a sequence of such parts is unambiguous."""
    return len(part).to_bytes(8, "big") + part


@cache
def _kind(of: type) -> str:
    """Return how `digest_of_parts` divides values of a type into parts: 'plain', 'tuple', 'array',
    'type', 'content', 'record', 'path' or 'value'. The result is cached because it is needed often.
    """
    if of in (str, int, bool, type(None)):
        return "plain"
    known = {tuple: "tuple", np.ndarray: "array", type: "type", ContentRecord: "content"}
    for base, kind in known.items():
        if issubclass(of, base):
            return kind
    if hasattr(of, "__dataclass_fields__"):
        return "record"
    return "path" if issubclass(of, Path) else "value"


def _of_value(value: object) -> bytes:
    text = f"{type(value).__name__} {value!r}"
    return _counted(text.encode(errors="surrogateescape"))


_of_plain = lru_cache(maxsize=4096, typed=True)(_of_value)
"""Of texts and whole numbers: most are keys, names and indices that come again. Floats are not
among them, because 0.0 and -0.0 are equal."""


@cache
def _tuple_head(length: int) -> bytes:
    return _counted(f"tuple {length}".encode())


@cache
def _array_head(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    return _counted(f"array {dtype} {shape}".encode())


@cache
def _record(kind: Hashable) -> tuple[bytes, tuple[str, ...]]:
    """Return what the contents of all records of a class have in common.

    Returns:
        The bytes with which the content begins: the class name with its length in front; and the
        names of the fields that belong to the content.
    """
    own: Any = kind
    names = (each.name for each in fields(own))
    kept = tuple(name for name in names if name not in ("source", "reading", "text"))
    return _counted(own.__name__.encode()), kept


class ContentRecord:
    """Base class of records that cache their digest, so that equal records are recognised
    quickly."""

    @cached_property
    def content(self) -> str:
        """SHA-256 of the whole record, except the fields `source`, `reading` and `text`."""
        kind: Any = type(self)
        return digest_of_parts((kind, tuple(getattr(self, name) for name in _record(kind)[1])))


class CacheKey:
    """Argument of a function with `functools.lru_cache`. Two keys are equal if their content is
    equal, so that cells with equal parts share cached results.

    Attributes:
        given: the values from which the function computes its result.
    """

    def __init__(self, *given: Any, known: Hashable = None) -> None:
        """Store the values from which a function computes its result.

        Args:
            given: the values.
            known: content by which keys are compared; None for the digest of `given`.
        """
        self.given = given
        self._known = digest_of_parts(given) if known is None else known

    def __hash__(self) -> int:
        return hash(self._known)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CacheKey) and self._known == other._known


# --- the digest of a workcell when it was read ---


@dataclass(frozen=True)
class Reading:
    """Digests of a workcell at the time when it was read from its file.

    Attributes:
        files: SHA-256 over the workcell file and the content of every file it names.
        values: SHA-256 over every value of the records; a path counts relative to the workcell
            file.
        named: paths in the records, and the arguments with which each robot's description is
            expanded. They decide which files describe the cell.
    """

    files: str
    values: str
    named: frozenset[str]


def reading_of(workcell: Any, files: str) -> Reading:
    """Compute the digests that show later whether a workcell has changed since it was read.

    Args:
        workcell: the workcell.
        files: digest of the workcell's files, which is copied to the result.
    """
    arms = [(r.urdf, r.package_dirs, r.xacro_arguments, r.srdf) for r in workcell.robots]
    values = digest_of_parts(workcell, workcell.source.parent)
    return Reading(files, values, frozenset([*_paths(workcell), *map(repr, arms)]))


def _paths(value: Any) -> Iterator[str]:
    if is_dataclass(value):
        for field in fields(value):
            yield from _paths(getattr(value, field.name))
    elif isinstance(value, tuple):
        for entry in value:
            yield from _paths(entry)
    elif isinstance(value, Path):
        yield str(value)
