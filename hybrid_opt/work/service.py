"""Independent work: services, ledgers, and executors in this process or several of this machine.

A service makes a context once per worker (say, the loaded evaluator) and answers one request at a
time with it. While it works it may emit messages. Answers do not depend on who works, or in which
order. A ledger holds the requests and takes what comes back; all of its methods are called in the
process that asked. A worker that dies is replaced and its request is given out again.

`multiprocessing` starts workers, from its fork server: a process without threads that holds the
loaded libraries, so that a worker is there within milliseconds. Its pools, those of
`concurrent.futures` and loky are not used, because one death ends them without telling whose it
was, their workers share a channel that a dying one can block, and they cannot give up a single
request. Here each worker talks over a pipe of its own, and ends with it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from threadpoolctl import ThreadpoolController

from codegen.function import available_cores
from hybrid_opt.errors import WorkerError
from symbolic.errors import DualArmError

Context = TypeVar("Context")
Request = TypeVar("Request")
Answer = TypeVar("Answer")
RequestOut = TypeVar("RequestOut", covariant=True)
AnswerIn = TypeVar("AnswerIn", contravariant=True)
Emit = Callable[[bytes], None]

MAX_DEATHS = 3
"""Deaths of workers over one request, with no message in between, after which it is lost."""

KILLED, SILENT = "killed", "timeout"
"""Why a request is lost: its workers died, or it said nothing for too long."""


@dataclass(frozen=True)
class Service(Generic[Context, Request, Answer]):
    """Work to do; both functions can be pickled.

    Attributes:
        make_context: called once per worker.
        work: answers a request with the context; may emit messages.
        patience: seconds without a message after which a request counts as hung, None for any
            number. With it the work is done in processes of its own, so that it can be given up.
    """

    make_context: Callable[[], Context]
    work: Callable[[Context, Request, Emit], Answer]
    patience: float | None = None

    def answer(self, context: Context, request: Request, emit: Emit) -> Answer:
        """The answer to a request."""
        with one_thread():
            return self.work(context, request, emit)


class Ledger(Protocol[RequestOut, AnswerIn]):
    """The requests 0 to len - 1 of a service, and what became of them."""

    def __len__(self) -> int:
        """Number of requests."""

    def request(self, index: int) -> RequestOut:
        """A request; asked for whenever it is given out."""

    def heard(self, index: int, message: bytes) -> None:
        """Takes the messages of each request in order.

        A request that is given out again emits what the request then asked for emits; where it was
        not asked for again, what came before is left out.
        """

    def answered(self, index: int, answer: AnswerIn) -> None:
        """Takes a request's answer; no message of that request follows."""

    def lost(self, index: int, reason: str) -> None:
        """Takes note that a request cannot be done as it is; it is then asked for once more.

        Args:
            index: which one.
            reason: `KILLED` or `SILENT`.

        Raises:
            WorkerError: it makes no sense to go on, see `give_up`.
        """


class Executor(Protocol):
    """Carries out a service."""

    def run(
        self, service: Service[Context, Request, Answer], ledger: Ledger[Request, Answer]
    ) -> None:
        """Return when all requests are answered.

        Raises:
            DualArmError: a request failed with this text, or was lost.
        """


def give_up(reason: str) -> NoReturn:
    """End a run over a lost request.

    Raises:
        WorkerError: always.
    """
    what = (
        f"worker processes died {MAX_DEATHS} times over one task (killed from outside, out of "
        "memory, or started by a script without `if __name__ == '__main__':`?)"
        if reason == KILLED
        else "a task said nothing for too long and was given up"
    )
    raise WorkerError(
        f"{what}; what was computed is kept: continue with --resume, perhaps with fewer --jobs"
    )


class _RequestList(Generic[Request, Answer]):
    """Requests of a list, answers in a list; a lost request ends the run."""

    def __init__(
        self, requests: Sequence[Request], answered: Callable[[int, Answer], None]
    ) -> None:
        self.requests, self.answers = requests, list[Any]([None] * len(requests))
        self._answered = answered

    def __len__(self) -> int:
        return len(self.requests)

    def request(self, index: int) -> Request:
        return self.requests[index]

    def heard(self, index: int, message: bytes) -> None:
        """Messages are left out."""

    def answered(self, index: int, answer: Answer) -> None:
        self.answers[index] = answer
        self._answered(index, answer)

    def lost(self, index: int, reason: str) -> None:
        give_up(reason)


def answer_all(
    executor: Executor,
    service: Service[Context, Request, Answer],
    requests: Sequence[Request],
    answered: Callable[[int, Answer], None] = lambda index, answer: None,
) -> list[Answer]:
    """The answers to independent requests, in their order.

    Args:
        executor: who does it.
        service: what to do.
        requests: can be pickled.
        answered: takes every answer as it comes, with the index of its request, in this process.

    Raises:
        DualArmError: a request failed with this text, or was lost.
    """
    ledger = _RequestList(requests, answered)
    executor.run(service, ledger)
    return ledger.answers


def called(context: Context, call: Callable[[Context], Answer], emit: Emit) -> Answer:
    """The work of a service whose requests are calls on its context."""
    return call(context)


def nothing() -> None:
    """The context of work that needs none."""


@dataclass(frozen=True)
class Reply:
    """A worker's reply to a request; failures are texts, as not every exception can be pickled.

    Attributes:
        kind: 'answer', 'error' for one raised on purpose, 'failure' for one that was not.
        content: the answer, or the text.
    """

    kind: str
    content: Any

    def answer(self) -> Any:
        """The answer.

        Raises:
            DualArmError: raised on purpose on the worker.
            RuntimeError: raised there, and not on purpose; the text is the traceback.
        """
        if self.kind == "answer":
            return self.content
        raise DualArmError(self.content) if self.kind == "error" else RuntimeError(self.content)


def attempt(call: Callable[[], Any]) -> Reply:
    """The reply to a call: its result or its failure."""
    try:
        return Reply("answer", call())
    except DualArmError as error:
        return Reply("error", str(error))
    except Exception:
        return Reply("failure", traceback.format_exc())


def one_thread() -> AbstractContextManager[object]:
    """Linear algebra in one thread, to be used with `with`.

    Workers fill the cores, and on matrices as small as ours several threads wait for one another:
    without it a drivable front of two attempts took 18.4 core-seconds in place of 9.3.
    """
    limited: AbstractContextManager[object]
    limited = _controller(len(sys.modules)).limit(limits=1, user_api="blas")
    return limited


@lru_cache(maxsize=1)
def _controller(modules: int) -> ThreadpoolController:
    """Controller of the libraries loaded with this number of modules: a new one takes 4 ms."""
    return ThreadpoolController()


_TICK = 1.0
"""Longest wait [s]; while this process is stopped, patience does not run out."""


def warm_up(*modules: str) -> None:
    """Start the server that workers come from, and let it load modules meanwhile.

    For programs; without it, each worker loads what it needs.
    """
    _server.set_forkserver_preload(list(modules))
    with _shielded():
        forkserver.ensure_running()


@dataclass(frozen=True)
class LocalExecutor:
    """Works on this machine: in this process, which nothing shields from what the work does, where
    one worker is enough, else in several fresh processes.

    Attributes:
        jobs: most workers, 0 for one per core.
        apart: whether one worker alone is a process of its own, too.
    """

    jobs: int = 1
    apart: bool = False

    def run(
        self, service: Service[Context, Request, Answer], ledger: Ledger[Request, Answer]
    ) -> None:
        """See `Executor`."""
        count = min(self.jobs or available_cores(), len(ledger))
        if count > 1 or self.apart or service.patience is not None:
            workforce = _Workforce(service, ledger, count)
            try:
                workforce.run()
            finally:
                workforce.end()
        elif count:
            context = service.make_context()
            for index in range(len(ledger)):
                heard = partial(ledger.heard, index)
                ledger.answered(index, service.answer(context, ledger.request(index), heard))


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
        if isinstance(word, Reply):
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
        connection: this side's end of the pipe.
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
