"""Records and their values as bytes: for digests, and to recognise what was computed before."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Hashable
from dataclasses import fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np


def parts(value: Any, folder: Path) -> list[bytes]:
    """The content of a record, piece by piece; paths as seen from a folder."""
    found: list[bytes] = []

    def add(value: Any) -> None:
        kind = _kind(value.__class__)
        if kind == "tuple":
            found.append(f"tuple {len(value)}".encode())
            for entry in value:
                add(entry)
        elif kind == "array":
            found.append(_array_head(value.dtype, value.shape))
            found.append(value.tobytes())
        elif kind == "content":
            found.append(value.content.encode())
        elif kind == "record":
            found.append(type(value).__name__.encode())
            for name in _names(value.__class__):
                add(getattr(value, name))
        elif kind == "type":
            found.append(value.__name__.encode())
        elif kind == "path":
            found.append(os.path.relpath(value, folder).encode(errors="surrogateescape"))
        else:
            # Numbers come back from their representation to the bit.
            found.append(f"{type(value).__name__} {value!r}".encode(errors="surrogateescape"))

    add(value)
    return found


@cache
def _kind(of: type) -> str:
    """How values of a type are taken apart: records and arrays are many, and asked often."""
    known = {tuple: "tuple", np.ndarray: "array", type: "type", ContentRecord: "content"}
    for base, kind in known.items():
        if issubclass(of, base):
            return kind
    if hasattr(of, "__dataclass_fields__"):
        return "record"
    return "path" if issubclass(of, Path) else "value"


@cache
def _array_head(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    return f"array {dtype} {shape}".encode()


@cache
def _names(kind: Hashable) -> tuple[str, ...]:
    own: Any = kind
    return tuple(
        each.name for each in fields(own) if each.name not in ("source", "reading", "text")
    )


def digest_of_parts(value: Any, folder: Path = Path()) -> str:
    """SHA-256 over `parts`."""
    # The length before each part keeps them apart.
    whole = b"".join(len(part).to_bytes(8, "big") + part for part in parts(value, folder))
    return hashlib.sha256(whole).hexdigest()


class ContentRecord:
    """A record that keeps its digest, so that what is made of it is recognised fast."""

    @cached_property
    def content(self) -> str:
        """Digest of all of it."""
        kind: Any = type(self)
        return digest_of_parts((kind, tuple(getattr(self, name) for name in _names(kind))))


class CacheKey:
    """Arguments of a function whose answers are kept (`functools.lru_cache`): equal to others where
    these are the same. Cells that are tried out share most of what they are made of.

    Attributes:
        given: the arguments.
    """

    def __init__(self, *given: Any, known: Hashable = None) -> None:
        """known: what identifies them; None for their whole content."""
        self.given = given
        self._known = digest_of_parts(given) if known is None else known

    def __hash__(self) -> int:
        return hash(self._known)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CacheKey) and self._known == other._known
