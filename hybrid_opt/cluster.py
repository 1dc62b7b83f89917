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
"""Time that the scheduler may take to answer, and then a first worker [s]."""

LOST_SECONDS = 10.0
"""Time without a connection to the scheduler after which the work is given up [s]."""

_CONNECTION_INTERVAL = 1.0
"""Time between two checks of the connection [s]."""

_CONNECTED = "running"
"""Dask's name for the status of a client that is connected to its scheduler."""

_alone = Lock()
"""Held during a call: what workers load serves one thread at a time."""

Environment = Mapping[str, str]


class DaskWorkers(Workers):
    """Workers of a Dask cluster that call functions in parallel. Dask repeats the calls of a lost
    worker.

    The workers need this package and its dependencies in the same versions, and a C compiler.
    """

    def __init__(self, address: str, environment: Callable[[], Environment]) -> None:
        """Store the address; the connection is made by the first call.

        Args:
            address: address of the scheduler, as tcp://HOST:8786.
            environment: function that describes the software of the process in which it is called;
                workers with other software are refused.
        """
        self._address, self._environment = address, environment
        self._resources = ExitStack()
        self._client: Any = None

    def _results(
        self, function: Callable[[Argument], Result], arguments: Sequence[Argument]
    ) -> Iterator[tuple[int, Result]]:
        """Call a function once per argument on the cluster.

        Args:
            function: function of one argument.
            arguments: one argument for each call.

        Yields:
            Index and result of each call, in the order in which the calls end.

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
        """Disconnect from the cluster and cancel unfinished calls."""
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
        text = f"the scheduler at {self._address} {why}; {RESUME_HINT}"
        raise WorkerError(text, code="cluster")

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
    """Check the form of a scheduler's address. A Dask client with an invalid address would wait,
    and print errors when it ends.

    Raises:
        SettingsError: the address is invalid.
    """
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
    """Suppress inside the `with` block the tracebacks that Dask logs when the connection is lost.
    This project reports the loss by its own error.
    """
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
    """Call a function on a worker, after a check of the worker's software.

    Args:
        environment: function that describes the software of the process in which it is called.
        wanted: description that the worker's software has to equal.
        function: function of one argument.
        argument: the argument.

    Raises:
        DualArmError: the software differs.
    """
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
