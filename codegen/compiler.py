"""The system's C compiler: how it is found, identified and called."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from codegen.errors import CodegenError
from codegen.function import available_cores

FLAGS = (
    "-std=gnu11",
    "-fPIC",
    "-shared",
    "-fvisibility=hidden",
    # CasADi's own entry points stay visible, so that `casadi.external` can use a library as well.
    "-DGCC_HASCLASSVISIBILITY",
    "-fno-math-errno",
    # Without fused multiply-adds all processors give the same bits.
    # Never -ffast-math: NaN must stay NaN.
    "-ffp-contract=off",
)

LANE_FLAGS = (
    # Where it vectorises, GCC 12 makes wrong code of loops over four lanes (AVX-512VL), and fuses
    # what alternates between sum and difference, against -ffp-contract. Lanes gain nothing from it.
    "-fno-tree-vectorize",
    "-fno-tree-slp-vectorize",
    "-Wno-psabi",
)

MACHINE_FLAGS = ("-march=native", "-mcpu=native")
"""Flags for the machine's own instruction set, as compilers name it; the first accepted one is
used. The instruction set is part of a library's key, so machines that share a cache keep their own
libraries."""

SMALL_SOURCE = 600_000
LARGE_SOURCE = 2_000_000
"""Size of a C source above which the optimisation level falls [bytes]. A candidate's evaluator (0.3
MB) takes gcc 5 to 6 s at -O3, 3 s at -O1 and 1.4 s at -O0, and runs in 0.39, 0.49 and 1.6 ms. One
straight line of code costs about 20 s per megabyte at -O3, 15 s at -O1 and 5 s at -O0, and gains
nothing from -O3."""

LANE_LEVEL = 2
"""Optimisation level of code for lanes: -O3 compiles longer and gains nothing."""

LONG_PART = 90_000
"""A function with more bytes of C than this is compiled one level lower. The clearances of the rack
(193 kB) take gcc 12 in lanes 5.1 s at -O2 and 2.2 s at -O1, and run in 32.6 and 29.9 us per 64; one
by one they take it 4.0 s at -O3 and 2.3 s at -O2, and run in 11.3 and 11.2 us."""

LEVELS = (0, 1, 2, 3)
"""Optimisation levels in use: -O0 for the largest sources, -O3 for the smallest."""

NAMES = ("cc", "gcc", "clang")

PACKAGED = "ziglang"
"""A package of PyPI with a compiler in it, for machines that have none (extra `compiler`)."""

ZIG_FLAGS = ("-fno-sanitize=undefined",)
"""Flags for Zig. By default it instruments C at -O0 with checks for undefined behaviour. The
handlers of these checks are linked only if the library itself is at -O0, so other libraries could
not be loaded."""

_PART = """
#include <math.h>
double part_{level}(const double *values, int count) {{
  double sum = 0.0;
  for (int k = 0; k < count; ++k) sum += sqrt(values[k + count * {level}]);
  return sum;
}}
"""

_WHOLE = """
{declared}
__attribute__((visibility("default"))) double whole(const double *values, int count) {{
  return {sum};
}}
"""
"""C text of the self-test: signed arithmetic, arrays, the mathematical library, calls between
files."""

MOST_SECONDS = 1200.0
"""A compiler that runs longer than this counts as hung [s]. Sources here take seconds, at most
minutes."""

_CORES = threading.BoundedSemaphore(available_cores())

_AT_WORK: set[subprocess.Popen[str]] = set()
_BEGINNING = threading.Lock()
_INTERRUPTED = threading.Event()


@contextmanager
def interruptible() -> Iterator[None]:
    """Kill all compiler processes of this process if Ctrl-C is pressed in the `with` block.

    Worker threads then start no further compilers. A new block in the main thread allows them
    again.
    """
    if threading.current_thread() is threading.main_thread():
        _INTERRUPTED.clear()
    try:
        yield
    except KeyboardInterrupt:
        with _BEGINNING:
            _INTERRUPTED.set()
            for process in _AT_WORK:
                _end(process)
        raise


def stop_if_interrupted() -> None:
    """Raise in a worker thread if the main thread was interrupted.

    Raises:
        KeyboardInterrupt: the main thread was interrupted in a block of `interruptible`.
    """
    if _INTERRUPTED.is_set():
        raise KeyboardInterrupt


def _end(process: subprocess.Popen[str]) -> None:
    """Kill a compiler and the processes that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


_OTHER_COMPILER = "name another one in the environment variable CC"


@dataclass(frozen=True)
class Compiler:
    """A C compiler that runs on this machine.

    Attributes:
        command: absolute path of the compiler, then the arguments in the user's CC.
        version: output of the compiler on its version and target.
        machine: flag for the machine's own instruction set; '' if the compiler has none.
        instructions: macros that the compiler defines for this instruction set.
    """

    command: tuple[str, ...]
    version: str
    machine: tuple[str, ...] = ()
    instructions: str = ""

    @property
    def identity(self) -> str:
        """Text that differs between compilers, versions, targets and machines."""
        return "\n".join([*self.command, self.version, *self.machine, self.instructions])

    def compile(
        self,
        source: Path,
        result: Path,
        level: int,
        flags: tuple[str, ...] = (),
        objects: Sequence[Path] | None = (),
    ) -> None:
        """Compile one C file to a shared library or, with `objects` None, to an object file.

        At most one compiler per core runs at a time.

        Args:
            source: the C file.
            result: the file to write.
            level: optimisation level, 0 to 3.
            flags: further flags.
            objects: object files that are linked into the library; None to write an object file.

        Raises:
            CodegenError: the compiler refused the source, could not write, or was killed.
        """
        if not os.access(self.command[0], os.X_OK):
            find_compiler()  # which says what to do
        own = [f"-O{level}", *FLAGS, *self.machine, *flags]
        last = ["-c"] if objects is None else [*map(str, objects), "-lm"]
        command = [*self.command, *own, "-o", str(result), str(source), *last]
        with _CORES:
            self._run(command, source, result)

    def self_test(self, folder: Path) -> None:
        """Test the compiler by small C files with a known result.

        At every optimisation level one object file is compiled. At every level all of them are then
        linked into a library, which is loaded and called. This takes gcc 0.3 s of CPU time.

        Args:
            folder: an empty folder of the cache, for all files of the test.

        Raises:
            CodegenError: a step fails, or a library computes a wrong result.
        """
        objects = []
        for level in LEVELS:
            source = folder / f"part_{level}.c"
            source.write_text(_PART.format(level=level))
            objects.append(source.with_suffix(".o"))
            self.compile(source, objects[-1], level, LANE_FLAGS, None)
        source = folder / "whole.c"
        parts = [f"part_{level}(const double *, int)" for level in LEVELS]
        calls = [f"part_{level}(values, count)" for level in LEVELS]
        declared = "".join(f"double {part};\n" for part in parts)
        source.write_text(_WHOLE.format(declared=declared, sum=" + ".join(calls)))
        roots = range(5 * len(LEVELS))
        squares = (ctypes.c_double * len(roots))(*[float(root * root) for root in roots])
        for level in LEVELS:
            library = folder / f"whole_{level}.so"
            self.compile(source, library, level, objects=objects)
            try:
                whole = ctypes.CDLL(str(library)).whole
            except (OSError, AttributeError) as error:
                raise CodegenError(
                    f"the C compiler {self.command[0]} made a library at -O{level} that cannot be "
                    f"loaded: {error}; {_OTHER_COMPILER}, or if {folder.parent} does not allow "
                    "programs, another folder in the environment variable DUAL_ARM_CACHE",
                    code="not-loadable",
                ) from error
            whole.restype = ctypes.c_double
            found, expected = whole(squares, len(roots) // len(LEVELS)), float(sum(roots))
            if found != expected:
                raise CodegenError(
                    f"the C compiler {self.command[0]} makes wrong code at -O{level}: a sum is "
                    f"{found!r} in place of {expected!r}; {_OTHER_COMPILER}",
                    code="wrong-code",
                )

    def _run(self, command: Sequence[str], source: Path, result: Path) -> None:
        # The compiler's own temporary files stay in the build folder and go away with it.
        environment = os.environ | {"TMPDIR": str(source.parent), "LC_ALL": "C"}
        try:
            with _BEGINNING:
                stop_if_interrupted()
                # In a group of its own: Ctrl-C is for this process, which ends its compilers.
                process = subprocess.Popen(
                    command,
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    text=True,
                    errors="replace",
                    process_group=0,
                )
                _AT_WORK.add(process)
        except OSError as error:
            raise CodegenError(f"the C compiler {self.command[0]} cannot run: {error}") from error
        with process:
            try:
                said = process.communicate(timeout=MOST_SECONDS)[1]
            except subprocess.TimeoutExpired as error:
                raise CodegenError(
                    f"the C compiler {self.command[0]} took longer than {MOST_SECONDS:g} s over "
                    f"{source.name} and was ended; {_OTHER_COMPILER}",
                    code="compiler-hangs",
                ) from error
            finally:
                with _BEGINNING:
                    _AT_WORK.discard(process)
                if process.returncode is None:
                    _end(process)
        if process.returncode != 0:
            stop_if_interrupted()
            raise CodegenError(
                _failure(self.command[0], source, process.returncode, said), code="compiler-failed"
            )
        if not result.is_file() or result.stat().st_size == 0:
            raise CodegenError(
                f"the C compiler {self.command[0]} reported success but made no library of "
                f"{source.name}; {_OTHER_COMPILER}",
                code="no-library",
            )


def default_level(c_bytes: int) -> int:
    """Return the optimisation level, 0 to 3, that keeps the compile time of a C text short.

    Args:
        c_bytes: size of the text [bytes].
    """
    if c_bytes <= SMALL_SOURCE:
        return 3
    return 1 if c_bytes <= LARGE_SOURCE else 0


def part_level(c_bytes: int, in_lanes: bool) -> int:
    """Return the optimisation level of a function that is compiled separately (`codegen.parts`).

    Args:
        c_bytes: size of the function's C text [bytes].
        in_lanes: True if the function evaluates several inputs side by side in vector instructions.
    """
    level = LANE_LEVEL if in_lanes else default_level(c_bytes)
    return level if c_bytes < LONG_PART else min(level, 1 if in_lanes else 2)


def find_compiler() -> Compiler:
    """Return the C compiler in CC if set, otherwise the first that works of cc, gcc, clang, and the
    compiler of the package `ziglang`.

    If CC is set and does not run, no other compiler is tried.

    Raises:
        CodegenError: no compiler works.
    """
    own = os.environ.get("CC", "")
    found = _find(own, os.environ.get("PATH", ""))
    if found is None:
        tried = (
            f"CC names {own.strip()!r}"
            if own.strip()
            else "tried were cc, gcc, clang and the package ziglang"
        )
        raise CodegenError(
            f"no C compiler that works was found ({tried}), and without one nothing can be "
            "computed: install one (Debian and Ubuntu: `apt install g++`; without rights to, `pip "
            "install ziglang`), or name it in the environment variable CC",
            code="no-compiler",
        )
    return found


def _words(cc: str) -> list[str]:
    try:
        return shlex.split(cc)
    except ValueError as error:
        raise CodegenError(
            f"the environment variable CC holds {cc[:60]!r}, which is no command ({error}); "
            "correct or unset it",
            code="no-command",
        ) from error


@cache
def _find(cc: str, path: str) -> Compiler | None:
    candidates = [_words(cc)] if cc.strip() else [[name] for name in NAMES]
    if not cc.strip() and find_spec(PACKAGED) is not None:
        candidates.append([sys.executable, "-m", PACKAGED, "cc"])
    for command in candidates:
        executable = shutil.which(command[0], path=path)
        if executable is None:
            continue
        full = (os.path.abspath(executable), *command[1:])
        if any(Path(word).name in ("zig", PACKAGED) for word in command):
            full += ZIG_FLAGS
        said = _ask(full, "-v")
        if said is None:
            continue
        for flag in MACHINE_FLAGS:
            defined = _ask(full, flag, "-dM", "-E", "-x", "c", os.devnull)
            if defined is not None:
                return Compiler(full, said, (flag,), defined)
        return Compiler(full, said)
    return None


def _ask(command: tuple[str, ...], *arguments: str) -> str | None:
    """Return what a command prints when called with further arguments; None if it fails."""
    try:
        said = subprocess.run(
            [*command, *arguments],
            env=os.environ | {"LC_ALL": "C"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return said.stdout + said.stderr if said.returncode == 0 else None


def _failure(compiler: str, source: Path, code: int, said: str) -> str:
    if code < 0:
        return (
            f"the C compiler {compiler} was ended by signal {-code} at {source.name}; "
            "if memory ran out, build fewer functions at once"
        )
    every = said.splitlines()
    lines = [line for line in every if "error" in line or "No space" in line]
    first = (lines or every or ["no message"])[0].strip()
    return (
        f"the C compiler {compiler} failed at {source.name}: {first}; make sure that it compiles a "
        f"C file with math.h (packages such as build-essential or gcc and libc-dev), or "
        f"{_OTHER_COMPILER}"
    )
