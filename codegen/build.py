"""Compile functions to shared libraries, or load them from the cache.

A `CSource` is the C text of one library: a CasADi function with its batch driver, a function
written by hand, or a program (`load_or_build_program`). The key of a library follows from its text
and the compiler. Long functions of a text are compiled to object files with keys of their own. The
cache also stores the keys of all libraries of a set, under a key of the inputs from which the set
is generated. So a second start of a program generates neither expressions nor C.

Functions over CasADi's SX may be stored as tapes instead (`codegen.native`), without a compiler.
"""

from __future__ import annotations

import ctypes
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

from codegen.cache import Cache, CacheEntry, key_of, library_version
from codegen.compiler import (
    FLAGS,
    LANE_FLAGS,
    LANE_LEVEL,
    Compiler,
    default_level,
    find_compiler,
    interruptible,
    stop_if_interrupted,
)
from codegen.errors import CodegenError, FormError
from codegen.function import NumericFunction, Signature, available_cores
from codegen.native import (
    CompiledFunction,
    Tape,
    TapeFunction,
    cannot_load,
    compiled_tape,
    warn_one_lane,
)
from codegen.parts import CodePart, in_parts

if TYPE_CHECKING:
    import casadi as ca

Member = TypeVar("Member", bound="Library | StoredTape")

TAPE_SUFFIX = ".npy"
"""Suffix of the cache's tapes."""

HANDWRITTEN_LEVEL = 3
"""Optimisation level of what is written by hand: it is short."""

ATTENTION_SECONDS = 0.5
"""How long Ctrl-C may go unseen [s]."""

_MAKING = Lock()
"""Sets that are built side by side are made one after the other, so that compilers are busy with
the first while the second is made."""


@dataclass(frozen=True)
class CSource:
    """C text of one library.

    Attributes:
        name: name of the compiled function in its set.
        text: the C text.
        level: optimisation level of the compiler, 0 to 3.
        lanes: number of evaluations side by side; 1 for no lanes, 0 for the machine's width.
        signature: signature of the function; None if the library has no batch driver.
        operations: instructions per evaluation, see `codegen.source.operations`.
        most: highest optimisation level of functions that are compiled separately.
    """

    name: str
    text: str
    level: int
    lanes: int = 1
    signature: Signature | None = None
    operations: int = 0
    most: int = 3

    @classmethod
    def of(cls, name: str, function: ca.Function, lanes: int, level: int | None) -> CSource:
        """Generate the C text of a CasADi function.

        Args:
            name: name of the function in its set.
            function: the function.
            lanes: number of evaluations that run side by side in vector instructions; 0 for the
                machine's width. If the function has no vectorised form, a warning is issued and the
                text evaluates one input at a time.
            level: optimisation level of the compiler, 0 to 3; None to choose by the size of the
                text.
        """
        from codegen.source import c_source, dense, generated_c, operations

        whole = dense(function)
        generated = generated_c([whole])
        try:
            text = c_source(whole, lanes, generated)
        except FormError as error:
            warn_one_lane(name, str(error))
            text, lanes = c_source(whole, 1, generated), 1
        chosen, most = (default_level(len(generated)), 3) if level is None else (level, level)
        return cls(name, text, chosen, lanes, Signature.of(whole), operations(function), most)


@dataclass(frozen=True)
class Library:
    """A loaded library of the cache.

    Attributes:
        entry: the library's entry in the cache.
        handle: ctypes handle, with the C functions as attributes.
    """

    entry: CacheEntry
    handle: ctypes.CDLL

    def function(self) -> CompiledFunction:
        """Return the library's content as a numeric function.

        Raises:
            CodegenError: the library has no batch driver, the C function that evaluates batches.
        """
        signature = Signature.from_json(self.entry.facts["signature"])
        return CompiledFunction(signature, self.entry.library, self.handle)


@dataclass(frozen=True)
class StoredTape:
    """A tape in the cache.

    Attributes:
        entry: the tape's entry in the cache.
        tape: the instructions of the function.
    """

    entry: CacheEntry
    tape: Tape

    def function(self) -> TapeFunction:
        """Return the tape, the instructions of a CasADi function, as a numeric function."""
        return TapeFunction(self.tape)


@dataclass(frozen=True)
class FunctionReport:
    """Record of one function's build.

    Attributes:
        name: name of the function in its set.
        operations: instructions per evaluation, see `codegen.source.operations`.
        c_bytes: size of the C text.
        compile_seconds: time of the compiler when the library was made [s].
        level: optimisation level of the compiler.
        from_cache: True if the cache already had the library.
    """

    name: str
    operations: int
    c_bytes: int
    compile_seconds: float
    level: int
    from_cache: bool


@dataclass(frozen=True)
class Build:
    """Compiled functions and reports on their builds, in the order in which they were requested.

    Attributes:
        functions: the compiled functions by name.
        reports: one report per function.
        keys: cache key of each function's library, by the function's name.
    """

    functions: dict[str, NumericFunction]
    reports: tuple[FunctionReport, ...]
    keys: dict[str, str]


def compiler_of(cache: Cache) -> Compiler:
    """Return the C compiler of this machine.

    On a machine without compiler, return the record of the compiler that made the cached libraries
    for this type of processor, because the keys of these libraries depend on it.

    Raises:
        CodegenError: no compiler works, and either CC names one or the cache has no record.
    """
    try:
        return find_compiler()
    except CodegenError:
        known = None if os.environ.get("CC", "").strip() else cache.read_record(_compiler_key())
        if known is None:
            raise
        words = {name: tuple(known[name]) for name in ("command", "machine")}
        return Compiler(version=known["version"], instructions=known["instructions"], **words)


def _compiler_key() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return key_of("compiler", machine=platform.machine(), features=line)
    return key_of("compiler", machine=platform.machine())


def compile_function(
    function: ca.Function,
    cache: Cache | None = None,
    *,
    level: int | None = None,
    lanes: int = 1,
) -> CompiledFunction:
    """Compile one CasADi function, or load it from the cache.

    Args:
        function: any function that CasADi can write as C; sparse inputs and outputs become dense.
        cache: cache of the library; None for the user's (`codegen.cache.default_folder`).
        level: optimisation level 0 to 3; None to choose by the size of the C text.
        lanes: number of evaluations of a batch that run side by side; 0 for the machine's width.

    Raises:
        CodegenError: there is no C compiler, or the function cannot be generated, compiled, cached
            or loaded.
    """
    source = CSource.of(function.name(), function, lanes, level)
    return _compiled([source], cache or Cache())[source.name][0].function()


def build(
    functions: Mapping[str, ca.Function],
    cache: Cache | None = None,
    *,
    key: str | None = None,
    levels: Mapping[str, int] | None = None,
    rebuild: bool = False,
    lanes: int = 1,
) -> Build:
    """Compile a set of CasADi functions in parallel, or load them from the cache.

    Args:
        functions: CasADi functions by name.
        cache: cache of the libraries; None for the user's.
        key: key under which `load_or_build` finds the set later; None to store no such key.
        levels: optimisation levels by name of the function. The size of the C text decides the
            level of other functions; None for all.
        rebuild: True to compile functions again that are in the cache.
        lanes: number of evaluations of a batch that run side by side; 0 for the machine's width.

    Raises:
        CodegenError: as in `compile_function`.
    """
    cache = cache or Cache()
    sources = _sources_of(lambda: functions, levels or {}, lanes)
    built = _compiled(sources, cache, rebuild=rebuild)
    ordered = {name: built[name] for name in functions}
    if key is not None:
        libraries = {name: library for name, (library, _) in ordered.items()}
        _remember(_set_key(key, levels, lanes, cache), libraries, cache)
    told = ("operations", "c_bytes", "compile_seconds", "level")
    reports, functions, keys = [], {}, {}
    for name, (library, found) in ordered.items():
        facts = {fact: library.entry.facts[fact] for fact in told}
        reports.append(FunctionReport(name=name, from_cache=found, **facts))
        functions[name], keys[name] = library.function(), library.entry.key
    return Build(functions, tuple(reports), keys)


def load_or_build(
    key: str,
    make: Callable[[], Mapping[str, ca.Function]],
    cache: Cache | None = None,
    *,
    levels: Mapping[str, int] | None = None,
    lanes: int = 1,
    taped: bool = False,
) -> dict[str, NumericFunction]:
    """Load a set of functions that is stored under a key, or build and store the set.

    If this compiler and these library versions built the set before, `make` is not called and
    CasADi is not imported.

    Args:
        key: digest of everything on which `make` depends, except the version of CasADi.
        make: function that returns the CasADi functions by name; its errors are passed on.
        cache: cache of the libraries; None for the user's.
        levels: optimisation levels by name of the function. The size of the C text decides the
            level of other functions; None for all.
        lanes: number of evaluations of a batch that run side by side; 0 for the machine's width.
        taped: True to store functions over SX as tapes and compile only the others.

    Raises:
        CodegenError: as in `compile_function`.
        BridgeError: the module that runs tapes cannot be loaded.
    """
    cache = cache or Cache()
    full = _set_key(key, levels, lanes, cache, taped)

    def members() -> dict[str, Library | StoredTape]:
        tapes: dict[str, StoredTape] = {}

        def sources() -> Iterator[CSource]:
            functions = dict(make())
            for name in list(functions) if taped else ():
                if (tape := Tape.of(functions[name])) is not None:
                    tapes[name] = _stored(tape, cache)
                    del functions[name]
            yield from _sources_of(lambda: functions, levels or {}, lanes)

        # The tapes are stored while the sources are made.
        libraries = _libraries(sources(), cache)
        return {**libraries, **tapes}

    found = _obtained(full, members, cache, _member)
    return {name: member.function() for name, member in found.items()}


def _stored(tape: Tape, cache: Cache) -> StoredTape:
    """Store a tape (the instructions of a CasADi function) in the cache, and return the stored
    tape."""
    signature = tape.signature.to_json()
    content = tape.instructions.tobytes().hex()
    key = key_of("tape", signature=signature, slots=tape.slots, content=content)

    def find() -> StoredTape | None:
        found = _member(key, cache)
        return found if isinstance(found, StoredTape) else None

    def write(file: Path) -> dict[str, Any]:
        tape.save(file)
        return {"signature": signature, "slots": tape.slots}

    def make() -> StoredTape:
        return StoredTape(cache.store(key, write, TAPE_SUFFIX), tape)

    return cache.obtain(key, find, make)[0]


def _member(key: str, cache: Cache) -> Library | StoredTape | None:
    """Load the library or tape stored under a key of the cache; None if none can be loaded."""
    entry = cache.find(key)
    if entry is None or entry.library.suffix != TAPE_SUFFIX:
        return _loaded(key, cache)
    signature = Signature.from_json(entry.facts["signature"])
    return StoredTape(entry, Tape.load(entry.library, signature, entry.facts["slots"]))


def load_or_compile(
    key: str, make: Callable[[], tuple[Signature, str]], cache: Cache | None = None
) -> NumericFunction:
    """Load a handwritten C function that is stored under a key, or compile and store it.

    Args:
        key: digest of everything on which `make` depends, except the version of CasADi.
        make: function that returns signature and C text (`codegen.source.handwritten_source`). It
            is called only if the cache lacks the function; its errors are passed on.
        cache: cache of the library; None for the user's.

    Raises:
        CodegenError: there is no C compiler, or the text cannot be compiled, cached or loaded.
    """

    cache = cache or Cache()

    def source() -> Iterator[CSource]:
        signature, text = make()
        yield CSource(signature.name, text, HANDWRITTEN_LEVEL, signature=signature)

    full = _set_key(key, None, 1, cache)
    (library,) = _obtained(full, lambda: _libraries(source(), cache), cache, _loaded).values()
    return library.function()


def load_or_build_program(
    name: str,
    key: str,
    make: Callable[[], Mapping[str, ca.Function]],
    own: str,
    cache: Cache | None = None,
    lanes: int = 0,
) -> ctypes.CDLL:
    """Load or build one library of CasADi functions in lanes and of handwritten C that calls them.

    A lane is one of the evaluations that a vector instruction makes side by side. The C code passes
    results from function to function without leaving the lanes. This saves time if the functions
    are so short that calls through NumPy would take longer. See `codegen.source.program_source`.

    Args:
        name: name of the program, for messages.
        key: digest of everything on which `make` depends, except the version of CasADi.
        make: function that returns the CasADi functions, by the names under which `own` calls them.
        own: handwritten C, appended to the C text of the functions.
        cache: cache of the library; None for the user's.
        lanes: number of evaluations side by side; 0 for the machine's width.

    Returns:
        The library. Its C function `dual_arm_lanes()` returns the number of lanes. If this is 1,
        the machine has no vector instructions for lanes, and the library has no other function.

    Raises:
        CodegenError: as in `load_or_compile`, or a function has no vectorised form.
    """

    cache = cache or Cache()

    def source() -> Iterator[CSource]:
        from codegen.source import program_source

        yield CSource(name, program_source(make(), own, lanes), LANE_LEVEL, lanes)

    full = key_of("program", name=name, of=_set_key(key, None, lanes, cache), own=own)
    return _obtained(full, lambda: _libraries(source(), cache), cache, _loaded)[name].handle


def _sources_of(
    make: Callable[[], Mapping[str, ca.Function]], levels: Mapping[str, int], lanes: int
) -> Iterable[CSource]:
    from codegen.source import operations

    functions = make()
    # The longest first: none is left to run alone in the end.
    for name in sorted(functions, key=lambda name: -operations(functions[name])):
        yield CSource.of(name, functions[name], lanes, levels.get(name))


def _set_key(
    key: str, levels: Mapping[str, int] | None, lanes: int, cache: Cache, taped: bool = False
) -> str:
    return key_of(
        "set",
        recipe=key,
        # A tape names operations by their numbers.
        taped=compiled_tape().OPERATIONS if taped else [],
        levels=sorted((levels or {}).items()),
        lanes=lanes,
        compiler=compiler_of(cache).identity,
        casadi=library_version("casadi"),
        generator=cache.code_digest("codegen"),
    )


def _obtained(
    key: str,
    make: Callable[[], Mapping[str, Member]],
    cache: Cache,
    load: Callable[[str, Cache], Member | None],
) -> dict[str, Member]:
    """Load all libraries or tapes of a set. If any is missing, make all of them and store the
    record of the set, the list of their keys.

    Args:
        key: key of the set's record in the cache.
        make: function that makes and stores all members, by name.
        cache: the cache.
        load: function that loads one member by its own key; it returns None if there is none.

    Returns:
        The libraries or tapes by name.
    """

    def find() -> dict[str, Member] | None:
        record = cache.read_record(key)
        if record is None:
            return None
        found = {name: load(member, cache) for name, member in record["members"].items()}
        whole = {name: member for name, member in found.items() if member is not None}
        return whole if len(whole) == len(found) else None

    def made() -> dict[str, Member]:
        built = dict(make())
        _remember(key, built, cache)
        return built

    return cache.obtain(key, find, made)[0]


def _libraries(sources: Iterable[CSource], cache: Cache) -> dict[str, Library]:
    """Compile sources, or take their libraries from the cache; return the libraries by name."""
    return {name: library for name, (library, _) in _compiled(sources, cache).items()}


def _remember(key: str, built: Mapping[str, Library | StoredTape], cache: Cache) -> None:
    members = {name: member.entry.key for name, member in built.items()}
    cache.write_record(key, {"members": members})


def _loaded(key: str, cache: Cache) -> Library | None:
    """Load the library stored under a key of the cache; None if none can be loaded."""
    entry = cache.find(key)
    try:
        return None if entry is None else Library(entry, ctypes.CDLL(str(entry.library)))
    except OSError:
        return None  # intact, but made against another C library: to be made again


def _compiled(
    sources: Iterable[CSource], cache: Cache, *, rebuild: bool = False
) -> dict[str, tuple[Library, bool]]:
    """Compile sources in parallel, or take their libraries from the cache unless `rebuild`.

    Returns:
        By the name of the source: the library, and True if it was in the cache.
    """
    compiler = compiler_of(cache)
    with ThreadPoolExecutor(available_cores()) as pool, interruptible():
        with _MAKING:
            stop_if_interrupted()
            futures = {
                source.name: _begin(source, compiler, cache, pool, rebuild) for source in sources
            }
        # In steps: a signal that comes just before a wait is seen when the wait ends.
        while wait(futures.values(), ATTENTION_SECONDS).not_done:
            pass
        built = {name: future.result() for name, future in futures.items()}
    key = _compiler_key()
    if not all(found for _, found in built.values()) or cache.read_record(key) is None:
        cache.write_record(key, asdict(compiler))
        cache.trim()
    return built


def _begin(
    source: CSource, compiler: Compiler, cache: Cache, pool: ThreadPoolExecutor, rebuild: bool
) -> Future[tuple[Library, bool]]:
    """Start to compile a source in the threads of `pool`, or load its library from the cache.

    The pool starts work in order. The object files of separately compiled functions are therefore
    started before the library that links them.

    Args:
        source: the C text.
        compiler: the compiler.
        cache: cache of the library.
        pool: threads that compile.
        rebuild: True to compile even if the library is in the cache.

    Returns:
        Future of the library, and True if it came from the cache.
    """
    flags = () if source.lanes == 1 else LANE_FLAGS
    rest, parts = in_parts(source.text, source.most)
    # Names and shapes are part of the C text, except which of two equal layouts they mean.
    signature = None if source.signature is None else source.signature.to_json()
    key = key_of(
        "library",
        compiler=compiler.identity,
        level=source.level,
        flags=(*FLAGS, *flags),
        signature=signature,
        parts=[(part.name, part.level) for part in parts],
        text=rest,
    )
    find = partial(_loaded, key, cache)
    if not rebuild and (known := find()) is not None:
        done: Future[tuple[Library, bool]] = Future()
        done.set_result((known, True))
        return done
    _require_sound(compiler, cache)
    longest_first = sorted(parts, key=lambda part: -len(part.text))
    objects = [pool.submit(_object, part, compiler, cache) for part in longest_first]
    file = source.name if source.signature is None else source.signature.name

    def write(library: Path) -> dict[str, Any]:
        text = library.parent / f"{file}.c"
        text.write_text(rest)
        start = time.perf_counter()
        given = [part.result() for part in objects]
        compiler.compile(text, library, source.level, flags, given)
        return {
            "signature": signature,
            "operations": source.operations,
            "c_bytes": len(source.text),
            "compile_seconds": time.perf_counter() - start,
            "level": source.level,
        }

    def make() -> Library:
        entry = cache.store(key, write)
        try:
            return Library(entry, ctypes.CDLL(str(entry.library)))
        except OSError as error:
            raise cannot_load(file, error) from error

    return pool.submit(cache.obtain, key, find, make, anew=rebuild)


def _require_sound(compiler: Compiler, cache: Cache) -> None:
    """Test a compiler before its first use with this cache.

    Raises:
        CodegenError: the compiler fails `Compiler.self_test`.
    """
    key = key_of("compiler test", compiler=compiler.identity, flags=(*FLAGS, *LANE_FLAGS))

    def test() -> None:
        with cache.build_folder() as scratch:
            compiler.self_test(scratch)
        cache.write_record(key, {"works": True})

    cache.obtain(key, lambda: cache.read_record(key), test)


def _object(part: CodePart, compiler: Compiler, cache: Cache) -> Path:
    """Return the object file of a part of C code, compiled by `compiler` if the cache lacks it."""
    flags = (*FLAGS, *LANE_FLAGS)
    key = key_of("part", compiler=compiler.identity, level=part.level, flags=flags, text=part.text)

    def find() -> Path | None:
        entry = cache.find(key)
        return None if entry is None else entry.library

    def write(result: Path) -> dict[str, Any]:
        text = result.with_name(f"{part.name}.c")
        text.write_text(part.text)
        compiler.compile(text, result, part.level, LANE_FLAGS, None)
        return {}

    return cache.obtain(key, find, lambda: cache.store(key, write, ".o").library)[0]
