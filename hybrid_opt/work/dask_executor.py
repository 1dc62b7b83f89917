"""Carrying out independent tasks on a Dask cluster.

Messages travel as Dask events while a task runs. A task that Dask repeats, because its worker
died, sends them again; they are the same to the bit, and what came before is left out.
"""

from __future__ import annotations

import queue
import threading
import traceback
import uuid
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from hybrid_opt.errors import WorkerError
from hybrid_opt.work.executor import Job
from symbolic.errors import DualArmError, SettingsError

Context = TypeVar("Context")
Task = TypeVar("Task")
Result = TypeVar("Result")

CONNECT_SECONDS = 30.0
"""So long the scheduler, and then a first worker, may take to answer."""

_contexts = threading.local()


class DaskExecutor:
    """Does tasks on the workers of a Dask cluster.

    Workers need this package and its dependencies in the same versions, and a C compiler.

    Attributes:
        address: of the scheduler.
        environment: what a worker's environment has to be, as `probe` tells it there.
        probe: a function of the package, called on the workers.
    """

    def __init__(
        self, address: str, environment: Mapping[str, str], probe: Callable[[], Mapping[str, str]]
    ) -> None:
        self.address = address
        self.environment = dict(environment)
        self.probe = probe

    def run(
        self,
        job: Job[Context, Task, Result],
        count: int,
        task_of: Callable[[int], Task],
        on_message: Callable[[int, bytes], None],
        on_result: Callable[[int, Result], None],
    ) -> None:
        """See `hybrid_opt.work.executor.Executor`.

        Raises:
            SettingsError: Dask is not installed, or no scheduler or worker answers.
            WorkerError: workers do not fit or were lost.
        """
        if count == 0:
            return
        try:
            import distributed
        except ImportError as error:
            raise SettingsError(
                'Dask is not installed; install it with: pip install "dual-arm-carry[dask]"'
            ) from error
        connect: Any = distributed.Client  # untyped
        try:
            client = connect(self.address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SettingsError(f"no Dask scheduler answers at {self.address} ({error})") from error
        with client:
            try:
                client.wait_for_workers(1, timeout=CONNECT_SECONDS)
            except TimeoutError as error:
                raise SettingsError(f"the scheduler at {self.address} has no workers") from error
            self._run(client, job, count, task_of, on_message, on_result)

    def _run(
        self,
        client: Any,
        job: Job[Context, Task, Result],
        count: int,
        task_of: Callable[[int], Task],
        on_message: Callable[[int, bytes], None],
        on_result: Callable[[int, Result], None],
    ) -> None:
        topic = f"dual-arm-carry-{uuid.uuid4().hex}"
        news: queue.SimpleQueue[tuple[int, int | None, Any]] = queue.SimpleQueue()

        def hear(event: tuple[float, tuple[int, int, bytes]]) -> None:
            news.put(tuple(event[1]))  # type: ignore[arg-type]

        client.subscribe_topic(topic, hear)
        futures = []
        for index in range(count):
            future = client.submit(
                _work, job, index, task_of(index), topic, self.environment, self.probe, pure=False
            )
            future.add_done_callback(lambda done, k=index: news.put((k, None, done)))
            futures.append(future)
        expected = dict.fromkeys(range(count), 0)
        try:
            while expected:
                index, number, content = news.get()
                if number is None:
                    on_result(index, _outcome(content, self.address))
                    del expected[index]
                elif expected.get(index) == number:
                    expected[index] += 1
                    on_message(index, content)
        finally:
            client.cancel(futures)
            client.unsubscribe_topic(topic)


def _outcome(future: Any, address: str) -> Any:
    try:
        kind, content = future.result()
    except Exception as error:
        raise WorkerError(
            f"the cluster at {address} lost a task ({type(error).__name__}: {error}); what was "
            "computed is kept: continue with --resume"
        ) from error
    if kind == "result":
        return content
    raise DualArmError(content) if kind == "error" else RuntimeError(content)


def _work(
    job: Job[Context, Task, Result],
    index: int,
    task: Task,
    topic: str,
    environment: Mapping[str, str],
    probe: Callable[[], Mapping[str, str]],
) -> tuple[str, Any]:
    """A task on a worker; failures come back as text, as not every exception can be pickled."""
    from distributed import get_worker

    worker = get_worker()
    number = 0

    def emit(message: bytes) -> None:
        nonlocal number
        worker.log_event(topic, (index, number, message))
        number += 1

    try:
        _check_environment(probe(), environment, str(worker.address))
        # Per thread: a context may hold what only one thread at a time can use.
        if getattr(_contexts, "maker", None) != job.make_context:
            _contexts.context = job.make_context()
            _contexts.maker = job.make_context
        return "result", job.work(_contexts.context, task, emit)
    except DualArmError as error:
        return "error", str(error)
    except Exception:
        return "failure", traceback.format_exc()


def _check_environment(found: Mapping[str, str], wanted: Mapping[str, str], worker: str) -> None:
    for name in sorted({*found, *wanted}):
        if found.get(name) != wanted.get(name):
            raise WorkerError(
                f"worker {worker} has {name} {found.get(name)}, this campaign "
                f"{wanted.get(name)}; install the same versions there"
            )
