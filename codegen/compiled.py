"""Functions compiled to machine code, called through ctypes without copies."""

from __future__ import annotations

import ctypes
import os
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import CodegenError
from codegen.function import NumericFunction, available_cores
from codegen.signature import Signature
from symbolic.array import Array

_CHUNKS_PER_THREAD = 4
"""Pieces of a batch per thread: small enough to even out threads that are held up."""

# Under short names for speed; NumPy arrays are buffers, which their type does not say.
_writable: Any = ctypes.c_char.from_buffer
_address_of = ctypes.addressof

_SUCCESS = -1
_TOO_MANY = -2


class CompiledFunction(NumericFunction):
    """A function in a shared library with the driver of `codegen.source`.

    Safe to call from several threads: each evaluation has its own work memory, and runs without
    the interpreter's lock.

    Attributes:
        library: the shared library's path.
    """

    def __init__(self, signature: Signature, library: Path) -> None:
        """Load the library.

        Raises:
            CodegenError: it cannot be loaded.
        """
        super().__init__(signature)
        self.library = library
        try:
            loaded = ctypes.CDLL(str(library))
            self._once, self._run = loaded.dual_arm_once, loaded.dual_arm_run
            loaded.dual_arm_load()
            sizes = (ctypes.c_longlong * 4)()
            loaded.dual_arm_sizes(sizes)
        except (OSError, AttributeError) as error:
            raise CodegenError(
                f"{self.name}: the compiled library cannot be loaded: {error}; if its folder does "
                "not allow programs, name another one in the environment variable DUAL_ARM_CACHE"
            ) from error
        self._once.argtypes = [ctypes.c_void_p] * 3
        self._run.argtypes = [ctypes.c_void_p] * 2 + [ctypes.c_longlong] * 2
        self._once.restype = self._run.restype = ctypes.c_longlong
        self._work_sizes = tuple(int(size) for size in sizes)
        self._idle: deque[_Work] = deque()

    def _evaluate_block(self, inputs: Sequence[Array], block: NDArray[np.void]) -> None:
        work = self._take_work()
        addresses = work.inputs
        for i, array in enumerate(inputs):
            addresses[i] = _address(array)
        base = _address_of(_writable(block)) if block.nbytes else 0
        self._finish(work, self._once(work.inputs_address, base, work.address))

    def _evaluate_into(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        work = self._take_work()
        ports = work.ports
        slot = 0
        for array in inputs:
            ports[slot] = _address(array)
            slot += 2
        for array in outputs:
            ports[slot] = _address(array)
            slot += 2
        self._finish(work, self._run(work.ports_address, work.address, 0, 1))

    def _evaluate_batch(
        self,
        inputs: Sequence[Array],
        batched: Sequence[bool],
        outputs: Sequence[Array],
        n: int,
        threads: int,
    ) -> None:
        steps = [
            _size(shape) if per_candidate else 0
            for shape, per_candidate in zip(self.input_shapes, batched, strict=True)
        ] + [_size(shape) for shape in self.output_shapes]
        ports = (ctypes.c_longlong * (2 * len(steps)))()
        for k, (array, step) in enumerate(zip([*inputs, *outputs], steps, strict=True)):
            ports[2 * k] = _address(array)
            ports[2 * k + 1] = step
        address = ctypes.addressof(ports)
        if threads == 1 or n == 1:
            self._run_chunk(address, 0, n)
            return
        pieces = min(n, threads * _CHUNKS_PER_THREAD)
        bounds = [n * piece // pieces for piece in range(pieces + 1)]
        chunks = deque(pairwise(bounds))

        # Holding the memory that the threads work on: an interrupt may end this call before them.
        memory = (inputs, outputs, ports)

        def drain(_memory: object = memory) -> None:
            while True:
                try:
                    begin, end = chunks.popleft()
                except IndexError:
                    return
                self._run_chunk(address, begin, end)

        futures = [_executor().submit(drain) for _ in range(min(threads, pieces))]
        try:
            wait(futures)
        finally:
            chunks.clear()
        for future in futures:
            future.result()

    def _run_chunk(self, ports_address: int, begin: int, end: int) -> None:
        work = self._take_work()
        self._finish(work, self._run(ports_address, work.address, begin, end), of=" of the batch")

    def _take_work(self) -> _Work:
        try:
            return self._idle.pop()
        except IndexError:
            return _Work(self._work_sizes, len(self.input_names), len(self.output_names))

    def _finish(self, work: _Work, status: int, of: str = "") -> None:
        self._idle.append(work)
        if status == _SUCCESS:
            return
        if status == _TOO_MANY:
            raise CodegenError(f"{self.name}: too many evaluations at once; use fewer threads")
        raise CodegenError(f"{self.name}: the function failed at candidate {status}{of}")


class _Work:
    """Work memory of one evaluation at a time, with the addresses the driver wants."""

    def __init__(self, sizes: Sequence[int], n_in: int, n_out: int) -> None:
        arg, res, iw, w = sizes
        self._memory: list[ctypes.Array[Any]] = [
            (ctypes.c_void_p * (arg + 1))(),
            (ctypes.c_void_p * (res + 1))(),
            (ctypes.c_longlong * (iw + 1))(),
            (ctypes.c_double * (w + 1))(),
        ]
        self._pointers = (ctypes.c_void_p * 4)(*[ctypes.addressof(m) for m in self._memory])
        self.address = ctypes.addressof(self._pointers)
        self.inputs = (ctypes.c_longlong * (n_in + 1))()
        self.inputs_address = ctypes.addressof(self.inputs)
        self.ports = (ctypes.c_longlong * (2 * (n_in + n_out)))()
        self.ports_address = ctypes.addressof(self.ports)


_threads: dict[int, ThreadPoolExecutor] = {}


def _executor() -> ThreadPoolExecutor:
    """The process's threads; a forked child has none of its parent's and gets its own."""
    process = os.getpid()
    if process not in _threads:
        _threads.clear()
        _threads[process] = ThreadPoolExecutor(max(32, available_cores()), "codegen")
    return _threads[process]


def _address(array: Array) -> int:
    if array.size == 0:
        return 0
    try:
        return _address_of(_writable(array))
    except TypeError:  # read-only
        return int(array.ctypes.data)


def _size(shape: Sequence[int]) -> int:
    size = 1
    for length in shape:
        size *= length
    return size
