"""Functions compiled to machine code, called through ctypes without copies."""

from __future__ import annotations

import ctypes
import os
import threading
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

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
        """Check that no input that is shared by all lanes is given with one value per evaluation.

        Args:
            batched: for each input, True if it is given with one value per evaluation.

        Raises:
            CodegenError: such an input has one value per evaluation.
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
        """Return the addresses with which C code evaluates a batch: the compiled functions, the
        batch and work memory of this thread.

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
        """Return True if a batch that does not fill the lanes gives the same bits as single
        evaluations."""
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
    """Return True if two arrays hold the same bits, with all NaN equal."""
    unlike = a.view(np.int64) != b.view(np.int64)
    return not (unlike & ~(np.isnan(a) & np.isnan(b))).any()
