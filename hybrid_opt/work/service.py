"""Interface of independent work: services, executors, ledgers; and work in this process.

A service makes a context once per worker (say, the loaded evaluator) and answers one request at a
time with it. While it works it may emit messages. Answers do not depend on who works, or in which
order. A ledger holds the requests and takes what comes back; all of its methods are called in the
process that asked. A worker that dies is replaced and its request is given out again.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from threadpoolctl import ThreadpoolController

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
        f"worker processes died {MAX_DEATHS} times over one task (killed from outside, or out of "
        "memory?)"
        if reason == KILLED
        else "a task said nothing for too long and was given up"
    )
    raise WorkerError(
        f"{what}; what was computed is kept: continue with --resume, perhaps with fewer --jobs"
    )


class ListLedger(Generic[Request, Answer]):
    """Requests of a list, answers in a list; a lost request ends the run.

    Attributes:
        answers: in the order of the requests.
    """

    def __init__(
        self, requests: Sequence[Request], done: Callable[[], None] = lambda: None
    ) -> None:
        """done: called after every answer."""
        self._requests, self._done = requests, done
        self.answers: list[Any] = [None] * len(requests)

    def __len__(self) -> int:
        return len(self._requests)

    def request(self, index: int) -> Request:
        """See `Ledger`."""
        return self._requests[index]

    def heard(self, index: int, message: bytes) -> None:
        """Messages are left out."""

    def answered(self, index: int, answer: Answer) -> None:
        """See `Ledger`."""
        self.answers[index] = answer
        self._done()

    def lost(self, index: int, reason: str) -> None:
        """See `Ledger`."""
        give_up(reason)


def answer_all(
    executor: Executor,
    service: Service[Context, Request, Answer],
    requests: Sequence[Request],
    done: Callable[[], None] = lambda: None,
) -> list[Answer]:
    """The answers to independent requests, in their order.

    Args:
        executor: who does it.
        service: what to do.
        requests: can be pickled.
        done: called in this process after every answer.

    Raises:
        DualArmError: a request failed with this text, or was lost.
    """
    ledger: ListLedger[Request, Answer] = ListLedger(requests, done)
    executor.run(service, ledger)
    return ledger.answers


def called(context: Context, call: Callable[[Context], Answer], emit: Emit) -> Answer:
    """The work of a service whose requests are calls on its context."""
    return call(context)


def nothing() -> None:
    """The context of work that needs none."""


@dataclass(frozen=True)
class Attempted:
    """Outcome of a request on a worker; failures are texts, as not every exception can be
    pickled.

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


def attempt(call: Callable[[], Any]) -> Attempted:
    """Outcome of a call, a result or a failure."""
    try:
        return Attempted("answer", call())
    except DualArmError as error:
        return Attempted("error", str(error))
    except Exception:
        return Attempted("failure", traceback.format_exc())


class SerialExecutor:
    """Answers all requests in this process, which nothing shields from what the work does."""

    def run(
        self, service: Service[Context, Request, Answer], ledger: Ledger[Request, Answer]
    ) -> None:
        """See `hybrid_opt.work.service.Executor`."""
        if len(ledger) == 0:
            return
        context = service.make_context()
        for index in range(len(ledger)):
            answer = service.answer(context, ledger.request(index), partial(ledger.heard, index))
            ledger.answered(index, answer)


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
