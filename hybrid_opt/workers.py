"""Parallel calls in worker processes of this machine, through `concurrent.futures`. No call depends
on another.

Functions, arguments and results have to be picklable. A worker keeps what it has loaded for later
calls (`functools.lru_cache`). The results depend neither on the worker nor on the order of the
calls. A call takes seconds, so a call whose worker is lost is repeated as a whole.
`hybrid_opt.cluster` does the same on a Dask cluster.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from threading import Thread, current_thread, main_thread
from types import TracebackType
from typing import Any, Self, TypeVar

from codegen.function import available_cores
from codegen.native import one_thread
from hybrid_opt.errors import WorkerError
from symbolic.errors import DualArmError

Argument = TypeVar("Argument")
Result = TypeVar("Result")
OnResult = Callable[[int, Any], None]

MAX_DEATHS = 3
"""Number of worker processes that may end unexpectedly between two results before the work is given
up."""

RESUME_HINT = "what was computed is kept: continue with --resume"


def ignore_result(index: int, result: object) -> None:
    """Do nothing with the result of a call. This is the default of `on_result` in `Workers.map`.

    Args:
        index: index of the call; not used.
        result: its result; not used.
    """


class Workers(ABC):
    """Processes that call functions in parallel; leaving the `with` block stops all calls."""

    def map(
        self,
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        on_result: OnResult = ignore_result,
    ) -> list[Result]:
        """Call a function with every argument; return the results in the arguments' order.

        Args:
            function: function of one argument that can be pickled.
            arguments: one argument for each call.
            on_result: function that this process calls with the index and the result of each
                finished call.

        Raises:
            DualArmError: a call failed, or worker processes died; the message states the reason.
        """
        results: dict[int, Result] = {}
        try:
            for index, result in self._results(function, arguments):
                results[index] = result
                on_result(index, result)
        except BaseException:
            self.close()
            raise
        return [results[index] for index in range(len(arguments))]

    @abstractmethod
    def _results(
        self, function: Callable[[Argument], Result], arguments: Sequence[Argument]
    ) -> Iterator[tuple[int, Result]]:
        """Call a function once per argument, and yield the results in the order in which the calls
        end.

        Args:
            function: function of one argument.
            arguments: one argument for each call.

        Yields:
            Index of the call, and its result.
        """

    @abstractmethod
    def close(self) -> None:
        """End all workers at once."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class LocalWorkers(Workers):
    """Worker processes on this machine.

    A single call runs in this process itself, and so do all calls if only one process is allowed. A
    crash then ends this process.
    """

    def __init__(self, jobs: int = 1) -> None:
        """Set the largest number of processes; no process starts yet.

        Args:
            jobs: largest number of processes, 0 for one per core.
        """
        self._jobs = jobs or available_cores()
        self._pool: ProcessPoolExecutor | None = None
        self._processes = set[BaseProcess]()
        self._lifeline: Connection | None = None

    def _results(
        self, function: Callable[[Argument], Result], arguments: Sequence[Argument]
    ) -> Iterator[tuple[int, Result]]:
        if min(self._jobs, len(arguments)) <= 1:
            for index, argument in enumerate(arguments):
                with one_thread():
                    result = function(argument)
                yield index, result
            return
        left, deaths = dict(enumerate(arguments)), 0
        while left:
            try:
                for index, result in finished(self._submit(function, left)):
                    del left[index]
                    deaths = 0
                    yield index, result
            except BrokenExecutor as error:
                self.close()
                deaths += 1
                if deaths == MAX_DEATHS:
                    raise WorkerError(
                        f"worker processes died {MAX_DEATHS} times (killed from outside, out of "
                        "memory, or started by a script without `if __name__ == '__main__':`?); "
                        f"{RESUME_HINT}, perhaps with fewer --jobs"
                    ) from error

    def _submit(
        self, function: Callable[[Argument], Result], arguments: Mapping[int, Argument]
    ) -> dict[Future[Result], int]:
        """Submit calls to the pool of processes; the first calls start the processes.

        Args:
            function: function of one argument.
            arguments: argument of each call, by the index of the call.

        Returns:
            Index of each submitted call, by the future of its result.
        """
        with _interrupts_later():
            pool, before = self._started(), set(multiprocessing.active_children())
            calls = {pool.submit(call_safely, function, one): k for k, one in arguments.items()}
            self._processes |= set(multiprocessing.active_children()) - before
        return calls

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            end, self._lifeline = multiprocessing.Pipe(duplex=False)
            with _without_interrupts():
                forkserver.ensure_running()
            context = multiprocessing.get_context("forkserver")
            self._pool = ProcessPoolExecutor(self._jobs, context, _live, (end,))
        return self._pool

    def close(self) -> None:
        """End all processes at once."""
        if self._pool is not None and self._lifeline is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in self._processes:
                process.kill()
            # What they share with this process has to last as long as they do.
            for process in self._processes:
                wait([process.sentinel])
            self._lifeline.close()
            self._pool = self._lifeline = None
            self._processes.clear()


def finished(calls: dict[Future[Result], int]) -> Iterator[tuple[int, Result]]:
    """Yield the index and the result of each call in the order in which the calls end.

    Args:
        calls: index of each submitted call, by its future.
    """
    for call in as_completed(calls):
        yield calls[call], call.result()


def call_safely(function: Callable[[Argument], Result], argument: Argument) -> Result:
    """Call a function with one linear-algebra thread. Errors that cannot be pickled are converted
    to errors that can.

    Args:
        function: the function.
        argument: its argument.
    """
    try:
        with one_thread():
            return function(argument)
    except DualArmError as error:
        raise DualArmError(str(error)) from None
    except Exception:
        raise RuntimeError(traceback.format_exc()) from None


def warm_up(*modules: str) -> None:
    """Start the server process that forks workers, with modules loaded in advance.

    Without this call, each worker loads its own modules.

    Args:
        modules: names of the modules to load.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(list(modules))
    with _without_interrupts():
        forkserver.ensure_running()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from processes that are started in the `with` block, and from their children.

    A terminal sends Ctrl-C to all processes of a group, but the parent alone decides how to end the
    work. Children inherit the blocked signal from their first moment on.
    """
    # Lifts the mask when it starts for the first time.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Delay Ctrl-C until the end of the `with` block, so that a process cannot be lost while it is
    started."""
    if current_thread() is not main_thread():
        yield
        return
    heard = list[int]()
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if heard:
        raise KeyboardInterrupt


def _live(lifeline: Connection) -> None:
    """Start a thread, in a new worker process, that ends the process when the pool or the parent
    process ends.

    Args:
        lifeline: connection whose other end closes when the pool or the parent process ends.
    """
    Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    """End this process, even during a call, as soon as the other end of the connection `lifeline`
    is closed.
    """
    with suppress(EOFError, OSError):
        lifeline.recv()
    os._exit(1)
