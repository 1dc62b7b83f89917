"""Work on a Dask cluster.

Messages travel as Dask events while a request is worked on. A request that Dask repeats, because
its worker died, sends them again; they are the same to the bit, and what came before is left out.
"""

from __future__ import annotations

import itertools
import logging
import os
import pickle
import queue
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from hybrid_opt.errors import WorkerError
from hybrid_opt.work.service import (
    KILLED,
    MAX_DEATHS,
    SILENT,
    Answer,
    Context,
    Ledger,
    Request,
    Service,
    attempt,
)
from symbolic.errors import SettingsError

CONNECT_SECONDS = 15.0
"""Time that the scheduler, and then a first worker, may take to answer."""

LOST_SECONDS = 10.0
"""Time without its scheduler after which the work is given up."""

_TICK = 1.0
"""Longest wait for news [s]."""

_CONNECTED = "running"
"""Dask's name for a client that has its scheduler."""

_contexts = threading.local()


class DaskExecutor:
    """Works on the workers of a Dask cluster.

    Workers need this package and its dependencies in the same versions, and a C compiler. Those
    that hang can be given up only where Dask restarts them, that is, with its nannies (default).

    Attributes:
        address: of the scheduler.
        environment: what a worker's environment has to be, as `probe` reports it there.
        probe: a function of the package, called on the workers.
    """

    def __init__(
        self, address: str, environment: Mapping[str, str], probe: Callable[[], Mapping[str, str]]
    ) -> None:
        self.address = address
        self.environment = dict(environment)
        self.probe = probe

    def run(
        self, service: Service[Context, Request, Answer], ledger: Ledger[Request, Answer]
    ) -> None:
        """See `hybrid_opt.work.service.Executor`.

        Raises:
            SettingsError: Dask is not installed, or no scheduler or worker answers.
            WorkerError: workers do not fit or were lost.
        """
        if len(ledger) == 0:
            return
        try:
            import distributed
        except ImportError as error:
            raise SettingsError(
                'Dask is not installed; install it with: pip install "dual-arm-carry[dask]"'
            ) from error
        _require_address(self.address)
        connect: Any = distributed.Client  # untyped
        try:
            client = connect(self.address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SettingsError(f"no Dask scheduler answers at {self.address} ({error})") from error
        with _hushed(), client:
            try:
                client.wait_for_workers(1, timeout=CONNECT_SECONDS)
            except TimeoutError as error:
                raise SettingsError(f"the scheduler at {self.address} has no workers") from error
            _Session(self, client, service, ledger).run()


def _require_address(address: str) -> None:
    """A client that is given none of these is not made, but waits and complains when it goes."""
    from distributed.comm import addressing

    host_port: Any = addressing.get_address_host_port  # untyped
    try:
        host_port(address)
    except (ValueError, NotImplementedError) as error:
        said = str(error) if len(address) < 200 else "it is too long"
        raise SettingsError(
            f"{address[:200]!a} is no address of a Dask scheduler ({said}); give tcp://HOST:8786"
        ) from error


@contextmanager
def _hushed() -> Iterator[None]:
    """Keep Dask from logging tracebacks of a lost connection, which an error of ours reports."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@dataclass
class _Order:
    """A request on the cluster.

    Attributes:
        index: which request.
        future: Dask's.
        expected: number of the next event; beyond 1 once a message was heard.
        worker: address of the worker that has it, empty while it waits.
        silence: seconds since its worker was heard.
    """

    index: int
    future: Any
    expected: int = 0
    worker: str = ""
    silence: float = 0.0


class _Session:
    """One run on the cluster. Every order has a number, so that news of cancelled ones is known."""

    def __init__(
        self,
        executor: DaskExecutor,
        client: Any,
        service: Service[Any, Any, Any],
        ledger: Ledger[Any, Any],
    ) -> None:
        self._executor, self._client, self._service, self._ledger = (
            executor,
            client,
            service,
            ledger,
        )
        self._topic = f"dual-arm-carry-{uuid.uuid4().hex}"
        self._news: queue.SimpleQueue[tuple[int, int, Any]] = queue.SimpleQueue()
        self._numbers = itertools.count()
        self._deaths: Counter[int] = Counter()
        self._orders: dict[int, _Order] = {}
        self._connected = time.monotonic()
        # Goes along with every request: shared data would be lost with the worker that holds it,
        # and would draw the requests to one worker, to be blamed for one another's deaths.
        self._pickled = pickle.dumps(service)

    def run(self) -> None:
        self._client.subscribe_topic(self._topic, lambda event: self._news.put(tuple(event[1])))
        try:
            for index in range(len(self._ledger)):
                self._submit(index)
            while self._orders:
                self._listen()
        finally:
            if self._client.status == _CONNECTED:  # else this would wait for an answer
                self._client.cancel([order.future for order in self._orders.values()])
                self._client.unsubscribe_topic(self._topic)

    def _require_scheduler(self) -> None:
        """Without it no news comes, not even that of a loss."""
        now = time.monotonic()
        if self._client.status == _CONNECTED:
            self._connected = now
        elif now - self._connected > LOST_SECONDS or self._client.status == "closed":
            raise WorkerError(
                f"the scheduler at {self._executor.address} does not answer any more; what was "
                "computed is kept: continue with --resume"
            )

    def _submit(self, index: int) -> None:
        number = next(self._numbers)
        future = self._client.submit(
            _work,
            self._pickled,
            self._ledger.request(index),
            _Return(number, self._topic, self._executor.environment, self._executor.probe),
            pure=False,
        )
        self._orders[number] = _Order(index, future)
        future.add_done_callback(lambda done: self._news.put((number, -1, done)))

    def _listen(self) -> None:
        self._require_scheduler()
        before = time.monotonic()
        try:
            number, event, content = self._news.get(timeout=_TICK)
        except queue.Empty:
            self._be_patient(_TICK)
            return
        self._be_patient(min(time.monotonic() - before, _TICK))
        order = self._orders.get(number)
        if order is None:
            return
        order.silence = 0.0
        if event < 0:
            self._finish(number, order)
            return
        if event == 0:
            order.worker = content
        if event == order.expected:
            order.expected += 1
            if event > 0:
                del self._deaths[order.index]
                self._ledger.heard(order.index, content)

    def _finish(self, number: int, order: _Order) -> None:
        del self._orders[number]
        try:
            reply = order.future.result()
        except Exception as error:
            # Dask repeats what a death interrupts, until it happens too often.
            died_often = type(error).__name__ == "KilledWorker" and order.expected <= 1
            self._deaths[order.index] += MAX_DEATHS if died_often else 1
            if self._deaths[order.index] >= MAX_DEATHS:
                del self._deaths[order.index]
                self._give_up(order.index, error)
            self._submit(order.index)
            return
        self._ledger.answered(order.index, reply.answer())

    def _give_up(self, index: int, error: Exception) -> None:
        try:
            self._ledger.lost(index, KILLED)
        except WorkerError as given_up:
            raise WorkerError(
                f"the cluster at {self._executor.address} lost a task ({type(error).__name__}: "
                f"{error}); what was computed is kept: continue with --resume"
            ) from given_up

    def _be_patient(self, passed: float) -> None:
        """Count silence [s]; those who exceed the patience lose their worker."""
        if self._service.patience is None:
            return
        for number, order in list(self._orders.items()):
            order.silence += passed if order.worker else 0.0
            if order.silence > self._service.patience:
                del self._orders[number]
                self._client.cancel([order.future])
                self._client.run(_end, workers=[order.worker], wait=False, on_error="ignore")
                self._ledger.lost(order.index, SILENT)
                self._submit(order.index)


@dataclass(frozen=True)
class _Return:
    """Address to which a worker sends its news, and what it has to be."""

    number: int
    topic: str
    environment: Mapping[str, str]
    probe: Callable[[], Mapping[str, str]]


def _work(pickled: bytes, request: Any, to: _Return) -> Any:
    """A request on a worker."""
    from distributed import get_worker

    worker = get_worker()
    address = str(worker.address)
    events = itertools.count()

    def send(content: object) -> None:
        worker.log_event(to.topic, (to.number, next(events), content))

    def answer() -> Any:
        _check_environment(to.probe(), to.environment, address)
        # Per thread: a context may hold what only one thread at a time can use.
        if getattr(_contexts, "service", None) != pickled:
            _contexts.made = pickle.loads(pickled)
            _contexts.context = _contexts.made.make_context()
            _contexts.service = pickled
        send(address)
        return _contexts.made.answer(_contexts.context, request, send)

    return attempt(answer)


async def _end() -> None:
    """End the worker, as nothing else ends what hangs; its nanny starts another."""
    os._exit(1)


def _check_environment(found: Mapping[str, str], wanted: Mapping[str, str], worker: str) -> None:
    for name in sorted({*found, *wanted}):
        if found.get(name) != wanted.get(name):
            raise WorkerError(
                f"worker {worker} has {name} {found.get(name)}, this campaign "
                f"{wanted.get(name)}; install the same versions there"
            )
