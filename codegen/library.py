"""C of our own as a library, for methods that call no CasADi function."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from codegen.cache import FORMAT, Cache, digest
from codegen.compiled import cannot_load
from codegen.compiler import FLAGS, find_compiler
from codegen.interpreted import warn_interpreted

LEVEL = 3
"""Optimisation level: what is written by hand is short."""


def c_text(package: str, names: Sequence[str], constants: Mapping[str, float] | None = None) -> str:
    """C files of a package, one after the other, with values in place of every @NAME@.

    Args:
        package: that they are in.
        names: of the files, in order.
        constants: by name.
    """
    text = "\n".join(files(package).joinpath(name).read_text() for name in names)
    for name, value in (constants or {}).items():
        text = text.replace(f"@{name}@", repr(value))
    return text


def load_or_build_library(name: str, text: str, cache: Cache | None = None) -> ctypes.CDLL | None:
    """The library, from the cache where it was built before.

    Args:
        name: for messages.
        text: self-contained C; what it offers is visible by attribute.
        cache: where libraries are kept; by default the user's.

    Returns:
        The library; None without a C compiler, with one warning per process.

    Raises:
        CodegenError: it cannot be compiled, cached or loaded.
    """
    compiler = find_compiler()
    if compiler is None:
        warn_interpreted()
        return None
    cache = cache or Cache()
    key = digest("library", str(FORMAT), name, str(LEVEL), compiler.identity, *FLAGS, text)

    def make(library: Path) -> dict[str, Any]:
        source = library.parent / f"{name}.c"
        source.write_text(text)
        compiler.compile(source, library, LEVEL)
        return {}

    def find() -> ctypes.CDLL | None:
        entry = cache.find(key)
        try:
            return None if entry is None else ctypes.CDLL(str(entry.library))
        except OSError:
            return None  # intact, but made against another C library: to be made again

    # A lock writes: what is there already needs none.
    loaded = find()
    if loaded is not None:
        return loaded
    with cache.lock(key):
        loaded = find()
        if loaded is not None:
            return loaded
        entry = cache.store(key, make)
    try:
        return ctypes.CDLL(str(entry.library))
    except OSError as error:
        raise cannot_load(name, error) from error
