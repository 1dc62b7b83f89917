"""Independent calls on the workers of a Dask cluster, see `hybrid_opt.workers`."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from contextlib import ExitStack, contextmanager
from threading import Lock
from typing import Any

from hybrid_opt.errors import WorkerError
from hybrid_opt.workers import (
    RESUME_HINT,
    Argument,
    Result,
    Workers,
    call_safely,
)
from symbolic.errors import DualArmError, SettingsError

CONNECT_SECONDS = 15.0
"""Time that the scheduler, and then a first worker, may take to answer."""

LOST_SECONDS = 10.0
"""Time without its scheduler after which the work is given up."""

_CONNECTION_INTERVAL = 1.0
"""Interval at which the connection is looked at [s]."""

_CONNECTED = "running"
"""Dask's name for a client that has its scheduler."""

_alone = Lock()
"""Held during a call: what workers load serves one thread at a time."""

Environment = Mapping[str, str]


class DaskWorkers(Workers):
    """Makes calls on the workers of a Dask cluster, which repeats calls lost with a worker.

    Workers need this package and its dependencies in the same versions, and a C compiler.
    """

    def __init__(self, address: str, environment: Callable[[], Environment]) -> None:
        """Connect to nothing yet.

        Args:
            address: of the scheduler.
            environment: describes the software of the process that it is called in; workers whose
                software differs are refused.
        """
        self._address, self._environment = address, environment
        self._resources = ExitStack()
        self._client: Any = None

    def _results(
        self, function: Callable[[Argument], Result], arguments: Sequence[Argument]
    ) -> Iterator[tuple[int, Result]]:
        """Yield index and result of each call as it ends.

        Raises:
            SettingsError: Dask is not installed, or no scheduler or worker answers.
            WorkerError: the software of a worker differs, or workers were lost.
        """
        if not arguments:
            return
        self._connect()
        executor, wanted = self._client.get_executor(pure=False), dict(self._environment())
        calls = {
            executor.submit(_call, self._environment, wanted, function, argument): index
            for index, argument in enumerate(arguments)
        }
        left, connected = set(calls), time.monotonic()
        while left:
            done, left = wait(left, _CONNECTION_INTERVAL, FIRST_COMPLETED)
            for call in done:
                yield calls[call], self._result(call)
            if self._client.status == _CONNECTED:
                connected = time.monotonic()
            elif time.monotonic() - connected > LOST_SECONDS or self._client.status == "closed":
                self._give_up("does not answer any more")

    def close(self) -> None:
        """Disconnect; calls that are not finished are cancelled."""
        with self._resources:
            self._client = None

    def _result(self, call: Any) -> Any:
        try:
            return call.result()
        except (DualArmError, RuntimeError):
            raise
        except CancelledError:
            self._give_up("does not answer any more")
        except Exception as error:
            self._give_up(f"lost a task ({type(error).__name__}: {error})")

    def _give_up(self, why: str) -> None:
        raise WorkerError(f"the scheduler at {self._address} {why}; {RESUME_HINT}")

    def _connect(self) -> None:
        if self._client is not None:
            return
        try:
            import distributed
        except ImportError as error:
            raise SettingsError(
                'Dask is not installed; install it with: pip install "dual-arm-carry[dask]"'
            ) from error
        _require_address(self._address)
        connect: Any = distributed.Client  # untyped
        try:
            client = connect(self._address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            told = f"no Dask scheduler answers at {self._address} ({error})"
            raise SettingsError(told, code="no-scheduler") from error
        with ExitStack() as opened:
            opened.enter_context(_without_tracebacks())
            opened.enter_context(client)
            try:
                client.wait_for_workers(1, timeout=CONNECT_SECONDS)
            except TimeoutError as error:
                told = f"the scheduler at {self._address} has no workers"
                raise SettingsError(told, code="no-workers") from error
            self._resources = opened.pop_all()
        self._client = client


def _require_address(address: str) -> None:
    """Refuse an invalid address: a client without a valid one waits, and complains when it ends."""
    from distributed.comm import addressing

    host_port: Any = addressing.get_address_host_port  # untyped
    try:
        host_port(address)
    except (ValueError, NotImplementedError) as error:
        said = str(error) if len(address) < 200 else "it is too long"
        raise SettingsError(
            f"{address[:200]!a} is no address of a Dask scheduler ({said}); give tcp://HOST:8786",
            code="address",
        ) from error


@contextmanager
def _without_tracebacks() -> Iterator[None]:
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


def _call(
    environment: Callable[[], Environment],
    wanted: Environment,
    function: Callable[[Argument], Result],
    argument: Argument,
) -> Result:
    """Call a function on a worker, after comparing its software with the wanted one."""
    found = environment()
    for name in sorted({*found, *wanted}):
        if found.get(name) != wanted.get(name):
            from distributed import get_worker

            raise DualArmError(
                f"worker {get_worker().address} has {name} {found.get(name)}, this campaign "
                f"{wanted.get(name)}; install the same versions there"
            )
    with _alone:
        return call_safely(function, argument)
