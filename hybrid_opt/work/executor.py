"""Carrying out independent tasks: in this process or in several processes of this machine.

A job makes a context once per worker (say, the loaded evaluator) and does one task at a time with
it. While it works it may emit messages. Results do not depend on who works, or in which order.
A worker that dies is replaced and its task is given out again.
"""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.process import BaseProcess
from typing import Any, Generic, Protocol, TypeVar

from codegen.function import available_cores
from hybrid_opt.errors import WorkerError
from symbolic.errors import DualArmError

Context = TypeVar("Context")
Task = TypeVar("Task")
Result = TypeVar("Result")
Emit = Callable[[bytes], None]

MAX_DEATHS = 3
"""So often may workers die over one task before the job is given up."""


@dataclass(frozen=True)
class Job(Generic[Context, Task, Result]):
    """What to do; both functions can be pickled.

    Attributes:
        make_context: called once per worker.
        work: does a task with the context; may emit messages.
    """

    make_context: Callable[[], Context]
    work: Callable[[Context, Task, Emit], Result]


class Executor(Protocol):
    """Carries out the tasks 0 to count - 1 of a job."""

    def run(
        self,
        job: Job[Context, Task, Result],
        count: int,
        task_of: Callable[[int], Task],
        on_message: Callable[[int, bytes], None],
        on_result: Callable[[int, Result], None],
    ) -> None:
        """Return when all tasks are done.

        Args:
            job: what to do.
            count: number of tasks.
            task_of: a task by its number, asked for whenever it is given out.
            on_message: takes the messages of each task in order. A task that is given out again
                emits what the task then asked for emits; where it was not asked for again, what
                came before is left out.
            on_result: takes each task's result; no message of that task follows.

        Raises:
            DualArmError: a task failed with this text, or workers died.
        """


class SerialExecutor:
    """Does all tasks in this process."""

    def run(
        self,
        job: Job[Context, Task, Result],
        count: int,
        task_of: Callable[[int], Task],
        on_message: Callable[[int, bytes], None],
        on_result: Callable[[int, Result], None],
    ) -> None:
        """See `Executor`."""
        if count == 0:
            return
        context = job.make_context()
        for index in range(count):
            on_result(index, job.work(context, task_of(index), partial(on_message, index)))


class ProcessExecutor:
    """Does tasks in several fresh processes; each talks to this one over a pipe of its own, so
    that the death of one harms no other."""

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs

    def run(
        self,
        job: Job[Context, Task, Result],
        count: int,
        task_of: Callable[[int], Task],
        on_message: Callable[[int, bytes], None],
        on_result: Callable[[int, Result], None],
    ) -> None:
        """See `Executor`."""
        waiting = deque(range(count))
        deaths: Counter[int] = Counter()
        workers: list[_Worker] = []
        try:
            while waiting or any(worker.index is not None for worker in workers):
                while waiting and len(workers) < self.jobs and not _idle(workers):
                    workers.append(_Worker(job))
                for worker in _idle(workers):
                    if waiting:
                        given = waiting.popleft()
                        worker.give(given, task_of(given))
                ready = set(wait([worker.connection for worker in workers]))
                for worker in [w for w in workers if w.connection in ready]:
                    index = worker.index
                    try:
                        kind, content = worker.connection.recv()
                    except (EOFError, OSError):
                        workers.remove(worker)
                        worker.end()
                        if index is not None:
                            deaths[index] += 1
                            _check_deaths(deaths[index])
                            waiting.appendleft(index)
                        continue
                    assert index is not None
                    if kind == "message":
                        on_message(index, content)
                    elif kind == "result":
                        worker.index = None
                        on_result(index, content)
                    else:
                        raise DualArmError(content) if kind == "error" else RuntimeError(content)
        finally:
            for worker in workers:
                worker.end()


def local_executor(jobs: int) -> Executor:
    """Executor for so many processes of this machine; 0 for one per core."""
    jobs = jobs or available_cores()
    return SerialExecutor() if jobs == 1 else ProcessExecutor(jobs)


def start_shielded(process: BaseProcess) -> None:
    """Start a process that Ctrl-C does not reach.

    It is sent to the whole group, but the parent alone decides what it means. The mask is
    inherited, so that it holds from the process's first moment.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """A process and this side of its pipe; index: the task it has, None without one."""

    def __init__(self, job: Job[Any, Any, Any]) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.connection, theirs = spawn.Pipe()
        self.index: int | None = None
        self._process: SpawnProcess = spawn.Process(
            target=_serve, args=(theirs, job), name="campaign worker", daemon=True
        )
        start_shielded(self._process)
        theirs.close()

    def give(self, index: int, task: object) -> None:
        self.index = index
        # A worker that died already is found when it is listened to.
        with suppress(OSError):
            self.connection.send(task)

    def end(self) -> None:
        self._process.terminate()
        self._process.join()
        self.connection.close()


def _serve(connection: Connection, job: Job[Any, Any, Any]) -> None:
    """A worker's life: ends with its pipe, that is at the latest with the parent."""
    context: Any = None
    made = False
    with suppress(EOFError, OSError):
        while True:
            task = connection.recv()
            try:
                if not made:
                    context, made = job.make_context(), True
                answer = ("result", job.work(context, task, lambda m: _tell(connection, m)))
            except DualArmError as error:
                answer = ("error", str(error))
            except Exception:
                answer = ("failure", traceback.format_exc())
            connection.send(answer)


def _tell(connection: Connection, message: bytes) -> None:
    try:
        connection.send(("message", message))
    except OSError as error:
        raise SystemExit(1) from error  # the parent is gone, and nobody waits for this task


def _idle(workers: list[_Worker]) -> list[_Worker]:
    return [worker for worker in workers if worker.index is None]


def _check_deaths(deaths: int) -> None:
    if deaths >= MAX_DEATHS:
        raise WorkerError(
            f"worker processes died {deaths} times over one task (killed from outside, or out of "
            "memory?); what was computed is kept: continue with --resume, perhaps with fewer --jobs"
        )
