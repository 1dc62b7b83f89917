"""Solves in child processes, so that a solver that crashes or hangs costs one attempt only.

Children are forked: they inherit the loaded functions and start at once, also from the worker
processes of a campaign. Which child does a task has no influence on its result.
"""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Protocol

import casadi

from hybrid_opt.polishing.solver import Solution, SolveTask


class Solver(Protocol):
    """What a child does."""

    def solve(self, task: SolveTask) -> Solution:
        """See `hybrid_opt.polishing.solver.PolishSolver`."""


@dataclass(frozen=True)
class Lost:
    """A task without a solution; reason: killed, timeout, or what was raised."""

    reason: str


class SolverPool:
    """Child processes that solve; to be used in a `with` statement."""

    def __init__(self, solver: Solver, jobs: int, max_seconds: float) -> None:
        """max_seconds: wall time after which a task is given up and its child killed."""
        self._solver, self._jobs, self._max_seconds = solver, max(1, jobs), max_seconds
        self._children: list[_Child] = []

    def __enter__(self) -> SolverPool:
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children:
            child.end()
        self._children.clear()

    def solve(self, tasks: Sequence[SolveTask]) -> list[Solution | Lost]:
        """Solve all tasks; the answers are in their order."""
        answers: list[Solution | Lost] = [Lost("not done")] * len(tasks)
        waiting = deque(range(len(tasks)))
        while waiting or any(child.task is not None for child in self._children):
            while waiting and self._idle() is not None:
                child = self._idle()
                assert child is not None
                index = waiting.popleft()
                child.give(index, tasks[index])
            busy = [child for child in self._children if child.task is not None]
            patience = min(child.since for child in busy) + self._max_seconds - time.monotonic()
            ready = set(wait([child.connection for child in busy], max(0.0, patience)))
            for child in busy:
                assert child.task is not None
                late = time.monotonic() - child.since > self._max_seconds
                if child.connection in ready:
                    try:
                        answers[child.task] = child.connection.recv()
                        child.task = None
                    except (EOFError, OSError):
                        self._replace(child, answers, "killed")
                elif late:
                    self._replace(child, answers, "timeout")
        return answers

    def _idle(self) -> _Child | None:
        for child in self._children:
            if child.task is None:
                return child
        if len(self._children) < self._jobs:
            self._children.append(_Child(self._solver))
            return self._children[-1]
        return None

    def _replace(self, child: _Child, answers: list[Solution | Lost], reason: str) -> None:
        assert child.task is not None
        answers[child.task] = Lost(reason)
        child.end()
        self._children.remove(child)


class _Child:
    """A forked process and this side of its pipe; task: the index it has, None without one."""

    def __init__(self, solver: Solver) -> None:
        self.connection, theirs = Pipe()
        self.task: int | None = None
        self.since = 0.0
        self._pid = os.fork()
        if self._pid == 0:
            # Never returns into the parent's code, whatever happens.
            try:
                self.connection.close()
                _serve(theirs, solver)
            finally:
                os._exit(0)
        theirs.close()

    def give(self, index: int, task: SolveTask) -> None:
        self.task, self.since = index, time.monotonic()
        # A child that died already is found when it is listened to.
        with suppress(OSError):
            self.connection.send(task)

    def end(self) -> None:
        self.connection.close()
        with suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(self._pid, 0)


def _serve(connection: Connection, solver: Solver) -> None:
    """A child's life: ends with its pipe, that is at the latest with the parent."""
    # Ctrl-C reaches the whole group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _use_one_thread()
    with suppress(EOFError, OSError):
        while True:
            task = connection.recv()
            try:
                connection.send(solver.solve(task))
            except Exception as error:
                connection.send(Lost(f"{type(error).__name__}: {error}".splitlines()[0]))


def _use_one_thread() -> None:
    """Keep the linear solver's BLAS from spinning on cores that other children use: its matrices
    are too small for threads."""
    for library in Path(casadi.__file__).parent.glob("*openblas*.so*"):
        with suppress(OSError, AttributeError):
            ctypes.CDLL(str(library)).openblas_set_num_threads(1)
