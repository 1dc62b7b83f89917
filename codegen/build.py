"""Build sets of functions: from the cache where possible, otherwise compiled side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from threading import Lock
from typing import TYPE_CHECKING, Any

from codegen.cache import FORMAT, Cache, digest, source_digest
from codegen.compilation import Source, compile_source, load_compiled
from codegen.compiler import Compiler, find_compiler, interruptible, stop_if_interrupted
from codegen.function import NumericFunction, available_cores
from codegen.interpreted import InterpretedFunction, warn_interpreted
from codegen.signature import Signature

if TYPE_CHECKING:
    import casadi as ca

_MAKING = Lock()
"""Sets that are built side by side are made one after the other, so that compilers are busy with
the first while the second is made."""


@dataclass(frozen=True)
class FunctionReport:
    """How one function was built.

    Attributes:
        name: in the set that was built.
        operations: instructions per evaluation, see `codegen.source.operations`.
        c_bytes: size of the C text; 0 where the function is interpreted.
        compile_seconds: what the compiler took, now or when the cached library was made; 0 where
            the function is interpreted.
        level: the compiler's optimisation level.
        from_cache: whether the library was there already.
        compiled: False where the function is interpreted for want of a compiler.
    """

    name: str
    operations: int
    c_bytes: int
    compile_seconds: float
    level: int
    from_cache: bool
    compiled: bool


@dataclass(frozen=True)
class Build:
    """A set of functions and how each was built, in the order they were given.

    Attributes:
        functions: by name.
        reports: how each was built.
        keys: by name, where the cache holds it; empty where functions are interpreted.
    """

    functions: dict[str, NumericFunction]
    reports: tuple[FunctionReport, ...]
    keys: dict[str, str]


def compile_function(
    function: ca.Function,
    cache: Cache | None = None,
    *,
    level: int | None = None,
    lanes: int = 1,
) -> NumericFunction:
    """Compile one CasADi function, or take it from the cache.

    Args:
        function: any function that CasADi can write as C; sparse inputs and outputs become dense.
        cache: where libraries are kept; by default the user's (`codegen.cache.default_folder`).
        level: optimisation level 0 to 3; by default by the size of the source.
        lanes: evaluations of a batch that run side by side; 0 for what suits the machine.

    Returns:
        A `CompiledFunction`, or without a C compiler an `InterpretedFunction`, with one warning
        per process.

    Raises:
        CodegenError: it cannot be generated, compiled, cached or loaded.
    """
    levels = None if level is None else {"function": level}
    return build({"function": function}, cache, levels=levels, lanes=lanes).functions["function"]


def build(
    functions: Mapping[str, ca.Function],
    cache: Cache | None = None,
    *,
    levels: Mapping[str, int] | None = None,
    jobs: int = 0,
    rebuild: bool = False,
    lanes: int = 1,
) -> Build:
    """Compile a set of CasADi functions, several at once.

    Args:
        functions: by the name under which they are wanted.
        cache: where libraries are kept; by default the user's.
        levels: optimisation level per name, where the default by size is not wanted.
        jobs: compilers that run at once; 0 for one per core.
        rebuild: compile also what is in the cache.
        lanes: evaluations of a batch that run side by side; 0 for what suits the machine.

    Raises:
        CodegenError: see `compile_function`.
    """
    from codegen.source import operations

    compiler = find_compiler()
    if compiler is None:
        return _interpreted(functions)
    cache = cache or Cache()
    with ThreadPoolExecutor(jobs or available_cores()) as pool, interruptible():
        futures = {}
        with _MAKING:
            # The longest first: none is left to run alone in the end.
            for name in sorted(functions, key=lambda name: -operations(functions[name])):
                source = Source.of(functions[name], lanes)
                level = (levels or {}).get(name)
                futures[name] = compile_source(
                    source, compiler, cache, level, pool.submit, rebuild=rebuild
                )
        built = [futures[name].result() for name in functions]
    reports = tuple(
        FunctionReport(
            name=name,
            operations=entry.facts["operations"],
            c_bytes=entry.facts["c_bytes"],
            compile_seconds=entry.facts["compile_seconds"],
            level=entry.facts["level"],
            from_cache=found,
            compiled=True,
        )
        for name, (_, entry, found) in zip(functions, built, strict=True)
    )
    return Build(
        {name: function for name, (function, _, _) in zip(functions, built, strict=True)},
        reports,
        {name: entry.key for name, (_, entry, _) in zip(functions, built, strict=True)},
    )


def load_or_build(
    key: str,
    make: Callable[[], Mapping[str, ca.Function]],
    cache: Cache | None = None,
    *,
    levels: Mapping[str, int] | None = None,
    lanes: int = 1,
) -> dict[str, NumericFunction]:
    """A set of functions by the key of what they are made from.

    Where the set was built before, with this compiler and these library versions, neither
    expressions nor C are made again: `make` is not called and CasADi is not imported.

    Args:
        key: changes with everything that `make` depends on, except the version of CasADi.
        make: makes the functions.
        cache: where libraries are kept; by default the user's.
        levels: optimisation level per name, where the default by size is not wanted.
        lanes: evaluations of a batch that run side by side; 0 for what suits the machine.

    Raises:
        CodegenError: see `compile_function`; and whatever `make` raises.
    """
    compiler = find_compiler()
    if compiler is None:
        return _interpreted(make()).functions
    cache = cache or Cache()
    found = _load_set(key, lanes, compiler, cache)
    if found is not None:
        return found
    with cache.lock(_set_key(key, lanes, compiler)):
        found = _load_set(key, lanes, compiler, cache)
        if found is None:
            with _MAKING:
                stop_if_interrupted()
                functions = make()
            found = build_set(key, functions, cache, levels=levels, lanes=lanes).functions
        return found


def load_or_compile(
    key: str, make: Callable[[], tuple[Signature, str]], cache: Cache | None = None
) -> NumericFunction | None:
    """A function written in C by hand, by the key of what it is made from.

    Args:
        key: changes with everything that `make` depends on, except the version of CasADi.
        make: its signature and its text (`codegen.source.handwritten_source`); not called where
            the function was compiled before.
        cache: where libraries are kept; by default the user's.

    Returns:
        The function, or None without a C compiler.

    Raises:
        CodegenError: it cannot be compiled, cached or loaded; and whatever `make` raises.
    """
    compiler = find_compiler()
    if compiler is None:
        return None
    cache = cache or Cache()
    found = _load_set(key, 1, compiler, cache)
    if found is not None:
        return next(iter(found.values()))
    signature, text = make()
    source = Source(signature, 0, text, len(text), None)
    with ThreadPoolExecutor(1) as pool, interruptible():
        function, entry, _ = compile_source(source, compiler, cache, 3, pool.submit).result()
    cache.write_record(_set_key(key, 1, compiler), {"members": {signature.name: entry.key}})
    return function


def build_set(
    key: str, functions: Mapping[str, ca.Function], cache: Cache | None = None, **options: Any
) -> Build:
    """`build`, and remember the set for `load_or_build` under the same key."""
    cache = cache or Cache()
    built = build(functions, cache, **options)
    compiler = find_compiler()
    if compiler is not None:
        key = _set_key(key, options.get("lanes", 1), compiler)
        cache.write_record(key, {"members": built.keys})
    return built


def _load_set(
    key: str, lanes: int, compiler: Compiler, cache: Cache
) -> dict[str, NumericFunction] | None:
    record = cache.read_record(_set_key(key, lanes, compiler))
    if record is None:
        return None
    functions: dict[str, NumericFunction] = {}
    for name, member in record["members"].items():
        hit = load_compiled(member, cache)
        if hit is None:
            return None
        functions[name] = hit[0]
    return functions


def _set_key(key: str, lanes: int, compiler: Compiler) -> str:
    return digest(
        "set",
        str(FORMAT),
        key,
        str(lanes),
        compiler.identity,
        version("casadi"),
        source_digest("codegen"),
    )


def _interpreted(functions: Mapping[str, ca.Function]) -> Build:
    from codegen.source import dense, operations

    warn_interpreted()
    reports = tuple(
        FunctionReport(
            name=name,
            operations=operations(function),
            c_bytes=0,
            compile_seconds=0.0,
            level=0,
            from_cache=False,
            compiled=False,
        )
        for name, function in functions.items()
    )
    return Build(
        {name: InterpretedFunction(dense(function)) for name, function in functions.items()},
        reports,
        {},
    )
