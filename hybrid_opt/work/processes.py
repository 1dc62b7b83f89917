"""Work in several processes of this machine.

`multiprocessing` starts them, from its fork server: a process without threads that holds the loaded
libraries, so that a worker is there within milliseconds. Its pools, those of `concurrent.futures`
and loky are not used, because one death ends them without telling whose it was, their workers
share a channel that a dying one can block, and they cannot give up a single request. Here each
worker talks over a pipe of its own, and ends with it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import Any

from codegen.function import available_cores
from hybrid_opt.work.service import (
    KILLED,
    MAX_DEATHS,
    SILENT,
    Answer,
    Attempted,
    Context,
    Executor,
    Ledger,
    Request,
    SerialExecutor,
    Service,
    attempt,
)

_TICK = 1.0
"""Longest wait [s]; while this process is stopped, patience does not run out."""


def warm_up(*modules: str) -> None:
    """Start the server that workers come from, and let it load modules meanwhile.

    For programs; without it, each worker loads what it needs.
    """
    _server.set_forkserver_preload(list(modules))
    with _shielded():
        forkserver.ensure_running()


def local_executor(jobs: int) -> Executor:
    """An executor with this number of processes on this machine; 0 for one per core."""
    return LocalExecutor(jobs or available_cores())


class LocalExecutor:
    """Works in this process where one is enough, else in several."""

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs

    def run(
        self, service: Service[Context, Request, Answer], ledger: Ledger[Request, Answer]
    ) -> None:
        """See `hybrid_opt.work.service.Executor`."""
        count = min(self.jobs, len(ledger))
        alone = count <= 1 and service.patience is None
        executor: Executor = SerialExecutor() if alone else ProcessExecutor(count)
        executor.run(service, ledger)


class ProcessExecutor:
    """Works in several fresh processes."""

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs

    def run(
        self, service: Service[Context, Request, Answer], ledger: Ledger[Request, Answer]
    ) -> None:
        """See `hybrid_opt.work.service.Executor`."""
        workforce = _Workforce(service, ledger, self.jobs)
        try:
            workforce.run()
        finally:
            workforce.end()


class _Workforce:
    """The workers of one run."""

    def __init__(
        self, service: Service[Any, Any, Any], ledger: Ledger[Any, Any], jobs: int
    ) -> None:
        self._service, self._ledger, self._jobs = service, ledger, jobs
        self._waiting = deque(range(len(ledger)))
        self._deaths: Counter[int] = Counter()
        self._workers: list[_Worker] = []

    def run(self) -> None:
        while self._waiting or self._busy():
            self._give_out()
            before = time.monotonic()
            ready = set(wait([worker.connection for worker in self._workers], self._tick()))
            passed = min(time.monotonic() - before, _TICK)
            for worker in list(self._workers):
                if worker.connection in ready:
                    self._listen(worker)
                else:
                    self._be_patient(worker, passed)

    def end(self) -> None:
        for worker in self._workers:
            worker.end()

    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.index is not None]

    def _tick(self) -> float | None:
        return None if self._service.patience is None else min(_TICK, self._service.patience)

    def _give_out(self) -> None:
        while self._waiting and len(self._workers) < self._jobs:
            if len(self._busy()) < len(self._workers):
                break
            worker = _Worker(self._service)
            self._workers.append(worker)
            self._give(worker)
        for worker in self._workers:
            if self._waiting and worker.index is None:
                self._give(worker)

    def _give(self, worker: _Worker) -> None:
        index = self._waiting.popleft()
        worker.give(index, self._ledger.request(index))

    def _listen(self, worker: _Worker) -> None:
        try:
            word = worker.connection.recv()
        except (EOFError, OSError):
            self._bury(worker)
            return
        worker.silence = 0.0
        index = worker.index
        assert index is not None
        if isinstance(word, Attempted):
            worker.index, worker.working = None, False
            self._ledger.answered(index, word.answer())
        elif word is None:
            worker.working = True
        else:
            del self._deaths[index]
            self._ledger.heard(index, word)

    def _be_patient(self, worker: _Worker, passed: float) -> None:
        if self._service.patience is None or not worker.working:
            return
        worker.silence += passed
        if worker.silence > self._service.patience:
            index = self._dismiss(worker)
            assert index is not None
            self._ledger.lost(index, SILENT)

    def _bury(self, worker: _Worker) -> None:
        index = self._dismiss(worker)
        if index is None:
            return
        self._deaths[index] += 1
        if self._deaths[index] >= MAX_DEATHS:
            del self._deaths[index]
            self._ledger.lost(index, KILLED)

    def _dismiss(self, worker: _Worker) -> int | None:
        """End a worker; what it worked on, if anything, waits again."""
        self._workers.remove(worker)
        worker.end()
        if worker.index is not None:
            self._waiting.appendleft(worker.index)
        return worker.index


class _Worker:
    """A process and this side of its pipe.

    Attributes:
        connection: to it.
        index: the request that it has, None without one.
        working: whether its context is made and it works on the request.
        silence: seconds since it was heard.
    """

    def __init__(self, service: Service[Any, Any, Any]) -> None:
        self.connection, theirs = _server.Pipe()
        self.index: int | None = None
        self.working = False
        self.silence = 0.0
        self._process = _server.Process(
            target=_serve, args=(theirs, service), name="worker", daemon=True
        )
        with _shielded():
            self._process.start()
        theirs.close()

    def give(self, index: int, request: object) -> None:
        self.index, self.working, self.silence = index, False, 0.0
        # A worker that died already is found when it is listened to.
        with suppress(OSError):
            self.connection.send(request)

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        self.connection.close()


_server = multiprocessing.get_context("forkserver")


@contextmanager
def _shielded() -> Iterator[None]:
    """Ctrl-C does not reach processes that are started in the `with` block.

    It is sent to the whole group, but the parent alone decides what it means. The mask is
    inherited, so that it holds from a process's first moment.
    """
    # Lifts the mask when it starts for the first time.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection, service: Service[Any, Any, Any]) -> None:
    """A worker's life: ends with its pipe, that is at the latest with the parent."""
    Thread(target=_end_with_parent, daemon=True).start()
    context = cache(service.make_context)

    def answer(request: Any) -> Any:
        held = context()
        connection.send(None)
        return service.answer(held, request, connection.send)

    with suppress(EOFError, OSError):
        while True:
            connection.send(attempt(partial(answer, connection.recv())))


def _end_with_parent() -> None:
    """Also in the midst of work, for which nobody waits any more."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
