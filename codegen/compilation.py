"""One function from its source to a loaded library, by way of the cache."""

from __future__ import annotations

import time
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.cache import FORMAT, Cache, Entry, digest
from codegen.compiled import CompiledFunction, warn_one_lane
from codegen.compiler import FLAGS, LANE_FLAGS, Compiler, default_level
from codegen.errors import CodegenError
from codegen.parts import Submit, compile_parts, in_parts
from codegen.signature import Signature

if TYPE_CHECKING:
    import casadi as ca

Built = tuple[CompiledFunction, Entry, bool]
"""A function, its entry in the cache, and whether that was there already."""


@dataclass(frozen=True)
class Source:
    """C to compile, for so many lanes, and without lanes if that fails. own_bytes: what CasADi
    generated of it."""

    signature: Signature
    operations: int
    text: str
    own_bytes: int
    without_lanes: str | None
    lanes: int = 1

    @classmethod
    def of(cls, function: ca.Function, lanes: int) -> Source:
        """The C of a function, with so many evaluations of a batch side by side."""
        from codegen.source import c_source, dense, generated_c, operations

        densified = dense(function)
        generated = generated_c([densified])
        text = c_source(densified, 1, generated)
        wide = text if lanes == 1 else c_source(densified, lanes, generated)
        signature, count = Signature.of(densified), operations(function)
        other = None if wide == text else text
        return cls(signature, count, wide, len(generated), other, lanes)


def compile_source(
    source: Source,
    compiler: Compiler,
    cache: Cache,
    level: int | None,
    submit: Submit,
    *,
    rebuild: bool = False,
) -> Future[Built]:
    """Begin to compile a function: its library, its entry, and whether the cache had it already.

    Args:
        level: of optimisation; None for one by the size of the text, and of each of its parts.
        submit: runs what it is given, beside others but not before what it was given earlier.
        rebuild: compile also what is in the cache.

    Raises:
        CodegenError: from the future, that it cannot be compiled, cached or loaded.
    """
    signature = source.signature
    flags = () if source.without_lanes is None else LANE_FLAGS
    rest, parts = in_parts(source.text, source.lanes)
    most = 3 if level is None else level
    parts = tuple(replace(part, level=min(part.level, most)) for part in parts)
    level = default_level(source.own_bytes) if level is None else level
    # Names and shapes are part of the C text, except which of two equal layouts they mean.
    names = str((signature.to_json(), [(part.name, part.level) for part in parts]))
    key = digest(str(FORMAT), compiler.identity, str(level), *FLAGS, *flags, names, rest)
    if not rebuild and (hit := load_compiled(key, cache)) is not None:
        known: Future[Built] = Future()
        known.set_result((*hit, True))
        return known
    objects = compile_parts(rest, parts, compiler, cache, submit)

    def make(library: Path) -> dict[str, Any]:
        text = library.parent / f"{signature.name}.c"
        start = time.perf_counter()
        try:
            objects.link(text, library, level, flags)
        except CodegenError as error:
            if source.without_lanes is None:
                raise
            text.write_text(source.without_lanes)
            compiler.compile(text, library, level)
            warn_one_lane(signature.name, str(error))
        return {
            "signature": signature.to_json(),
            "operations": source.operations,
            "c_bytes": len(source.text),
            "compile_seconds": time.perf_counter() - start,
            "level": level,
        }

    def built() -> Built:
        if not rebuild and (hit := load_compiled(key, cache)) is not None:
            return *hit, True
        with cache.lock(key):
            if not rebuild and (hit := load_compiled(key, cache)) is not None:
                return *hit, True
            entry = cache.store(key, make)
        return CompiledFunction(signature, entry.library), entry, False

    return submit(built)


def load_compiled(key: str, cache: Cache) -> tuple[CompiledFunction, Entry] | None:
    """The library kept under a key; None where there is none that can be loaded."""
    entry = cache.find(key)
    if entry is None:
        return None
    try:
        signature = Signature.from_json(entry.facts["signature"])
        return CompiledFunction(signature, entry.library), entry
    except CodegenError:
        # Intact but not loadable, such as made against a newer C library: to be made again.
        return None
