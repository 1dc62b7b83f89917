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
        if isinstance(value, tuple):
            found.append(f"tuple {len(value)}".encode())
            for entry in value:
                add(entry)
        elif isinstance(value, np.ndarray):
            found.append(f"array {value.dtype} {value.shape}".encode())
            found.append(value.tobytes())
        elif isinstance(value, type):
            found.append(value.__name__.encode())
        elif isinstance(value, ContentRecord):
            found.append(value.content.encode())
        elif hasattr(type(value), "__dataclass_fields__"):
            found.append(type(value).__name__.encode())
            for name in _names(value.__class__):
                add(getattr(value, name))
        elif isinstance(value, Path):
            found.append(os.path.relpath(value, folder).encode(errors="surrogateescape"))
        else:
            # Numbers come back from their representation to the bit.
            found.append(f"{type(value).__name__} {value!r}".encode(errors="surrogateescape"))

    add(value)
    return found


@cache
def _names(kind: Hashable) -> tuple[str, ...]:
    own: Any = kind
    return tuple(
        each.name for each in fields(own) if each.name not in ("source", "reading", "text")
    )


def digest_of_parts(value: Any, folder: Path = Path()) -> str:
    """SHA-256 over `parts`."""
    total = hashlib.sha256()
    for part in parts(value, folder):
        # The length before each part keeps them apart.
        total.update(len(part).to_bytes(8, "big") + part)
    return total.hexdigest()


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
