"""Numeric functions that run in native code, without copies of their arrays: compiled to machine
code and called through ctypes, or listed as instructions (a tape) that `tape.cpp` runs.

A compiler needs seconds for a function of ten thousand instructions; listing the instructions of a
scalar CasADi function (type SX) takes milliseconds. `tape.cpp` decodes each instruction once and
runs it for up to 32 samples. The results have the same bits as those of a function compiled in
lanes. One evaluation takes as long as eight.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from itertools import accumulate, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import CodegenError, SlowerWarning
from codegen.function import (
    NativeCall,
    NumericFunction,
    Signature,
    available_cores,
    ports,
)
from symbolic.array import Array
from symbolic.extension import compiled_module

if TYPE_CHECKING:
    import casadi as ca
    from threadpoolctl import ThreadpoolController

_CHUNKS_PER_THREAD = 4
"""Number of pieces of a batch per thread; several pieces even out delays of single threads."""

_ALIGNMENT = 64
"""Alignment of work memory [bytes], the size of the widest vector."""

OTHER_COMPILER = "another compiler (environment variable CC) may do better"

_SUCCESS = -1


class CompiledFunction(NumericFunction):
    """A function in a shared library with the driver of `codegen.source`.

    Several threads may call it at once: each evaluation has its own work memory, and runs without
    Python's global interpreter lock.

    Attributes:
        library: path of the shared library.
        lanes: number of evaluations of a batch that run side by side; 1 if the library has no
            lanes, or if the results in lanes differ in any bit from single evaluations.
    """

    def __init__(self, signature: Signature, library: Path, loaded: ctypes.CDLL) -> None:
        """Wrap the function in a loaded library.

        Args:
            signature: names and shapes of inputs and outputs.
            library: path of the shared library.
            loaded: ctypes handle of the library.

        Raises:
            CodegenError: the library lacks the C functions of a batch driver, by which batches are
                evaluated.
        """
        super().__init__(signature)
        self.library = library
        try:
            loaded.dual_arm_load()
            found = (ctypes.c_longlong * 4)()
            loaded.dual_arm_sizes(found)
            sizes = list(found)
            self._one = _Driver(loaded.dual_arm_run, sizes)
        except AttributeError as error:
            raise cannot_load(self.name, error) from error
        lengths = [8 * size for size in signature.sizes[len(signature.input_shapes) :]]
        self._offsets = list(accumulate(lengths, initial=0))[:-1]
        self.lanes, self._shared = 1, [False] * len(signature.input_names)
        self._in_lanes: _Driver | None = None
        if hasattr(loaded, "dual_arm_run_lanes"):
            self._shared = [bool(loaded.dual_arm_shared(k)) for k in range(len(self._shared))]
            self.lanes = int(loaded.dual_arm_lanes())
            sizes[3] = (sizes[3] + sum(signature.sizes)) * self.lanes
            self._in_lanes = _Driver(loaded.dual_arm_run_lanes, sizes)
            if not self._lanes_agree():
                self.lanes = 1
                warn_one_lane(self.name, f"lanes and single evaluations differ; {OTHER_COMPILER}")

    def _evaluate_block(self, inputs: Sequence[Array], block: NDArray[np.void]) -> None:
        outputs = [block] * len(self._offsets)
        of_block = ports(self.signature, inputs, [False] * len(inputs), outputs)
        for k, offset in enumerate(self._offsets, len(inputs)):
            of_block[2 * k] += offset
        self._run_chunk(ctypes.addressof(of_block), 0, 1)

    def _evaluate_batch(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        n: int,
        threads: int,
    ) -> None:
        self._require_one_value(batched)
        of_batch = ports(self.signature, inputs, batched, outputs)
        begin_of_ports = ctypes.addressof(of_batch)
        if threads == 1 or n == 1:
            self._run_chunk(begin_of_ports, 0, n)
            return
        pieces = min(n, threads * _CHUNKS_PER_THREAD)
        bounds = [n * piece // pieces for piece in range(pieces + 1)]
        chunks = deque(pairwise(bounds))

        # Holding the memory that the threads work on: an interrupt may end this call before them.
        memory = (inputs, outputs, of_batch)

        def drain(_memory: object = memory) -> None:
            while True:
                try:
                    begin, end = chunks.popleft()
                except IndexError:
                    return
                self._run_chunk(begin_of_ports, begin, end)

        futures = [thread_pool().submit(drain) for _ in range(min(threads, pieces))]
        try:
            wait(futures)
        finally:
            chunks.clear()
        for future in futures:
            future.result()

    def _require_one_value(self, batched: Sequence[bool]) -> None:
        """Check that every input declared as shared by all lanes has a single value for the whole
        batch.

        Args:
            batched: for each input, True if it is given with one value per evaluation.

        Raises:
            CodegenError: a shared input is given with one value per evaluation.
        """
        for name, several, shared in zip(
            self.signature.input_names, batched, self._shared, strict=True
        ):
            if several and shared:
                raise CodegenError(
                    f"{self.name}: input '{name}' has one value for all evaluations of a batch; "
                    "give one, or call the function once per value"
                )

    def _prepared(
        self, inputs: Sequence[Array], batched: Sequence[bool], outputs: Sequence[Array]
    ) -> tuple[Callable[[int], None], Callable[[], NativeCall]]:
        self._require_one_value(batched)
        of_batch = ports(self.signature, inputs, batched, outputs)
        begin_of_ports = ctypes.addressof(of_batch)

        def run(count: int, _memory: object = (inputs, outputs, of_batch)) -> None:
            self._run_chunk(begin_of_ports, 0, count)

        return run, lambda: self._native(begin_of_ports)

    def _native(self, of_batch: int) -> NativeCall:
        """Return the addresses by which other C code evaluates a batch: the compiled functions, the
        batch, and work memory of this thread.

        Args:
            of_batch: address of the descriptions of arguments and results, from `ports`.
        """
        lanes = self._in_lanes if self.lanes > 1 else None
        own = [0, 0] if lanes is None else [lanes.address, lanes.own.address]
        return NativeCall(self._one.address, own[0], of_batch, self._one.own.address, own[1])

    def _run_chunk(self, ports_address: int, begin: int, end: int) -> None:
        several = self.lanes > 1 and end - begin > 1
        driver = self._in_lanes if several and self._in_lanes is not None else self._one
        try:
            work = driver.idle.pop()
        except IndexError:
            work = _Work(driver.sizes)
        status = driver.function(ports_address, work.address, begin, end)
        driver.idle.append(work)
        if status != _SUCCESS:
            raise CodegenError(
                f"{self.name}: the function failed at candidate {status} of the batch"
            )

    def _lanes_agree(self) -> bool:
        """Return True if evaluation in lanes and single evaluations give the same bits.

        The test evaluates random inputs, one more than there are lanes, so that the last lanes stay
        partly unused.
        """
        rng = np.random.default_rng(0)
        n = self.lanes + 1
        batched = [not shared for shared in self._shared]
        inputs = [
            rng.normal(0.0, 0.5, (n, *shape) if each else shape)
            for shape, each in zip(self.input_shapes, batched, strict=True)
        ]
        together = [np.empty((n, *shape)) for shape in self.output_shapes]
        apart = [np.empty((n, *shape)) for shape in self.output_shapes]
        if not inputs:
            return True
        self._evaluate_batch(inputs, batched, together, n, 1)
        for k in range(n):
            rows = slice(k, k + 1)
            one = [output[rows] for output in apart]
            own = [a[rows] if each else a for a, each in zip(inputs, batched, strict=True)]
            self._evaluate_batch(own, batched, one, 1, 1)
        return all(map(_same, together, apart))


class _Driver:
    """One driver of a library, with work memory that calls reuse.

    Attributes:
        function: C function with the arguments ports (address of the descriptions of arguments and
            results), work (address of work memory), begin and end. It evaluates the candidates from
            begin to end - 1, and returns the index of the first one that failed, or `_SUCCESS`.
        address: address of the function.
        sizes: sizes of the work memory of one call.
        idle: work memory that no thread uses at present.
    """

    def __init__(self, function: Any, sizes: Sequence[int]) -> None:
        function.argtypes = [ctypes.c_void_p] * 2 + [ctypes.c_longlong] * 2
        function.restype = ctypes.c_longlong
        self.function: Callable[[int, int, int, int], int] = function
        self.sizes = tuple(sizes)
        self.address = ctypes.cast(function, ctypes.c_void_p).value or 0
        self.idle, self._own = deque[_Work](), threading.local()

    @property
    def own(self) -> _Work:
        """Permanent work memory of this thread."""
        if not hasattr(self._own, "work"):
            self._own.work = _Work(self.sizes)
        work: _Work = self._own.work
        return work


class _Work:
    """Work memory for one thread at a time, with the addresses that the driver needs."""

    def __init__(self, sizes: Sequence[int]) -> None:
        arg, res, iw, w = sizes
        self._memory: list[ctypes.Array[Any]] = [
            (ctypes.c_void_p * (arg + 1))(),
            (ctypes.c_void_p * (res + 1))(),
            (ctypes.c_longlong * (iw + 1))(),
            (ctypes.c_double * (w + _ALIGNMENT // 8 + 1))(),
        ]
        addresses = [ctypes.addressof(memory) for memory in self._memory]
        addresses[3] += -addresses[3] % _ALIGNMENT
        self._pointers = (ctypes.c_void_p * 4)(*addresses)
        self.address = ctypes.addressof(self._pointers)


_warned = False


def cannot_load(name: str, error: Exception) -> CodegenError:
    """Return an error that says that a cached library cannot be loaded, and what to do.

    Args:
        name: name of the compiled function.
        error: the error that was raised when the library was loaded.
    """
    return CodegenError(
        f"{name}: the compiled library cannot be loaded: {error}; if its folder does not allow "
        "programs, name another one in the environment variable DUAL_ARM_CACHE",
        code="not-loadable",
    )


def warn_one_lane(name: str, reason: str) -> None:
    """Warn, once per process, that a function is evaluated one input at a time instead of in lanes.

    Args:
        name: name of the function.
        reason: why it has no lanes.
    """
    global _warned
    if _warned:
        return
    _warned = True
    warnings.warn(
        f"{name}: batches are evaluated one by one, which is slower: {reason}",
        SlowerWarning,
        stacklevel=3,
    )


_threads: dict[int, ThreadPoolExecutor] = {}


def thread_pool() -> ThreadPoolExecutor:
    """Return the thread pool of this process; a forked process gets its own."""
    process = os.getpid()
    if process not in _threads:
        _threads.clear()
        _threads[process] = ThreadPoolExecutor(max(32, available_cores()), "codegen")
    return _threads[process]


def _same(a: Array, b: Array) -> bool:
    """Return True if the arrays `a` and `b` hold the same bits, with all NaN equal."""
    unlike = a.view(np.int64) != b.view(np.int64)
    return not (unlike & ~(np.isnan(a) & np.isnan(b))).any()


def one_thread() -> AbstractContextManager[object]:
    """Limit linear algebra to one thread within a `with` block.

    The workers already fill the cores, and on small matrices several threads would wait for one
    another: without the limit a drivable front of two attempts took 18.4 core-seconds instead of
    9.3.
    """
    limited: AbstractContextManager[object]
    limited = _controller(len(sys.modules)).limit(limits=1, user_api="blas")
    return limited


@lru_cache(maxsize=1)
def _controller(modules: int) -> ThreadpoolController:
    """Return the controller of the threads of all loaded linear-algebra libraries.

    A new controller takes 4 ms, so it is cached until further modules are loaded.

    Args:
        modules: number of loaded modules.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


# --- tapes ---

_INSTRUCTION = np.dtype([("code", np.int32, 4), ("constant", np.float64)])
"""The operation's number in `tape.cpp`, its result's slot and its operands' slots; of an input or
output the operands are its place."""


@cache
def compiled_tape() -> Any:
    """Import the C++ extension module that runs tapes (instructions of CasADi functions), and
    return it.

    Raises:
        BridgeError: the module is missing or cannot be loaded.
    """
    return compiled_module("codegen._tape", "the compiled part of the interpreter")


@dataclass(frozen=True)
class Tape:
    """The instructions of a scalar CasADi function (type SX).

    Attributes:
        signature: names and shapes of the function's inputs and outputs.
        instructions: (n,) records in the order in which they run.
        slots: number of intermediate values in the work memory.
    """

    signature: Signature
    instructions: NDArray[np.void]
    slots: int

    @classmethod
    def of(cls, function: ca.Function) -> Tape | None:
        """Return the tape of a CasADi function; sparse inputs and outputs become dense.

        The result is None if the function is not of type SX, or has an operation that `tape.cpp`
        lacks.

        Raises:
            BridgeError: the compiled module cannot be loaded.
        """
        import casadi as ca

        if not function.is_a("SXFunction"):
            return None
        names = compiled_tape().OPERATIONS
        known = {getattr(ca, f"OP_{name}"): k for k, name in enumerate(names)}
        given = [function.sparsity_in(k).find() for k in range(function.n_in())]
        made = [function.sparsity_out(k).find() for k in range(function.n_out())]
        rows: list[tuple[int, int, int, int]] = []
        constants: list[float] = []
        for k in range(function.n_instructions()):
            operation = function.instruction_id(k)
            if operation not in known:
                return None
            operands, results = function.instruction_input(k), function.instruction_output(k)
            if operation == ca.OP_INPUT:
                operands = [operands[0], given[operands[0]][operands[1]]]
            elif operation == ca.OP_OUTPUT:
                operands = [operands[0], made[results[0]][results[1]]]
            rows.append((known[operation], results[0], *operands, *[0] * (2 - len(operands))))
            constant = operation == ca.OP_CONST
            constants.append(function.instruction_constant(k) if constant else 0.0)
        slots = function.sz_w()
        zeros = [
            (k, place)
            for k, places in enumerate(made)
            for place in sorted(set(range(function.numel_out(k))) - set(places))
        ]
        if zeros:
            rows.append((names.index("CONST"), slots, 0, 0))
            rows += [(names.index("OUTPUT"), k, slots, place) for k, place in zeros]
            constants += [0.0] * (len(zeros) + 1)
        found = np.zeros(len(rows), _INSTRUCTION)
        if rows:
            found["code"], found["constant"] = rows, constants
        return cls(Signature.of(function), found, slots + bool(zeros))

    @cached_property
    def program(self) -> Any:
        """Object of the extension module that holds the instructions and runs them."""
        count = len(self.signature.input_names)
        found = (self.instructions[name] for name in ("code", "constant"))
        codes, constants = map(np.ascontiguousarray, found)
        return compiled_tape().Tape(codes, constants, count, self.slots)

    @classmethod
    def load(cls, path: Path, signature: Signature, slots: int) -> Tape:
        """Read the instructions from a file that `save` wrote.

        Args:
            path: the file.
            signature: signature of the function.
            slots: number of intermediate values in the work memory.
        """
        return cls(signature, np.load(path, allow_pickle=False), slots)

    def save(self, path: Path) -> None:
        """Write the instructions to a NumPy file. Signature and number of slots are not written;
        `load` takes them as arguments."""
        np.save(path, self.instructions, allow_pickle=False)


class TapeFunction(NumericFunction):
    """A numeric function that runs from its tape. Several threads may call it at once.

    Attributes:
        tape: the instructions of the function.
    """

    def __init__(self, tape: Tape) -> None:
        super().__init__(tape.signature)
        self.tape, self._idle = tape, deque[Any]()

    def _evaluate_block(self, inputs: Sequence[Array], block: NDArray[np.void]) -> None:
        outputs = [block[name] for name in self.output_names]
        self._evaluate_batch(inputs, [False] * len(inputs), outputs, 1, 1)

    def _evaluate_batch(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        n: int,
        threads: int,
    ) -> None:
        of_batch = ports(self.signature, inputs, batched, outputs)
        try:
            work = self._idle.pop()
        except IndexError:
            work = compiled_tape().Work(self.tape.program)
        work.run(ctypes.addressof(of_batch), 0, n)
        self._idle.append(work)

    def _prepared(
        self, inputs: Sequence[Array], batched: Sequence[bool], outputs: Sequence[Array]
    ) -> tuple[Callable[[int], None], Callable[[], NativeCall]]:
        of_batch = ports(self.signature, inputs, batched, outputs)
        begin, work = ctypes.addressof(of_batch), compiled_tape().Work(self.tape.program)

        def run(count: int, _memory: object = (inputs, outputs, of_batch)) -> None:
            work.run(begin, 0, count)

        call = NativeCall(compiled_tape().RUN, compiled_tape().RUN, begin, *[work.address] * 2)
        return run, lambda: call
