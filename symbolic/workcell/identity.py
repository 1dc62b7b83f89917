"""What tells a workcell from every other: the content of its files and the values in memory.

A workcell that is as it was read has the digest of its files. One that was changed in memory
(`dataclasses.replace`) has one of its own, made from that and from its values, so that nothing that
is kept under a digest belongs to another cell.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Reading:
    """What a workcell was like when it was read.

    Attributes:
        files: SHA-256 over the workcell file and the content of every file it names.
        values: `values_digest` of its records.
        named: `named` of its records.
    """

    files: str
    values: str
    named: frozenset[str]


def reading_of(workcell: Any, files: str) -> Reading:
    """The reading of a workcell as it is now."""
    return Reading(files, values_digest(workcell), named(workcell))


def digest_of(workcell: Any, reading: Reading | None) -> str:
    """The digest of a workcell; '' where no files, or others than were read, describe it."""
    if reading is None:
        return ""
    values = values_digest(workcell)
    if values == reading.values:
        return reading.files
    if not named(workcell) <= reading.named:
        return ""
    return hashlib.sha256(f"{reading.files} {values}".encode()).hexdigest()


def values_digest(workcell: Any) -> str:
    """SHA-256 over every value of the records, files by their place beside the workcell file."""
    total = hashlib.sha256()
    for part in _parts(workcell, workcell.source.parent):
        # The length before each part keeps them apart.
        total.update(len(part).to_bytes(8, "big") + part)
    return total.hexdigest()


def named(workcell: Any) -> frozenset[str]:
    """What decides which files describe the cell: the paths in its records, and what each robot's
    description is expanded with."""
    arms = [(r.urdf, r.package_dirs, r.xacro_arguments, r.srdf) for r in workcell.robots]
    return frozenset([*_paths(workcell), *map(repr, arms)])


def _parts(value: Any, folder: Path) -> Iterator[bytes]:
    if is_dataclass(value):
        yield type(value).__name__.encode()
        for field in fields(value):
            if field.name not in ("source", "reading"):
                yield from _parts(getattr(value, field.name), folder)
    elif isinstance(value, tuple):
        yield f"tuple {len(value)}".encode()
        for entry in value:
            yield from _parts(entry, folder)
    elif isinstance(value, np.ndarray):
        yield f"array {value.dtype} {value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, Path):
        yield os.path.relpath(value, folder).encode(errors="surrogateescape")
    else:
        # Numbers come back from their representation to the bit.
        yield f"{type(value).__name__} {value!r}".encode(errors="surrogateescape")


def _paths(value: Any) -> Iterator[str]:
    if is_dataclass(value):
        for field in fields(value):
            yield from _paths(getattr(value, field.name))
    elif isinstance(value, tuple):
        for entry in value:
            yield from _paths(entry)
    elif isinstance(value, Path):
        yield str(value)
