"""Child processes: crashes, hangs and exceptions cost one task, nothing more."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.polishing.pool import Lost, SolverPool
from hybrid_opt.polishing.records import UNKNOWN
from hybrid_opt.polishing.solver import Solution, SolveTask
from hybrid_opt.polishing.targets import pascoletti_serafini

TARGET = pascoletti_serafini(np.zeros(2), np.ones(2))


class Moody:
    """Does with a task what its first number says."""

    def solve(self, task: SolveTask) -> Solution:
        mood = task.x[0]
        if mood == 1.0:
            os.kill(os.getpid(), signal.SIGKILL)
        if mood == 2.0:
            time.sleep(60.0)
        if mood == 3.0:
            raise ValueError("no good")
        return Solution(task.x * 2.0, "fine", True, True, UNKNOWN, 1, 1, 0)


def tasks(*moods: float) -> list[SolveTask]:
    return [SolveTask(np.array([mood, k]), TARGET) for k, mood in enumerate(moods)]


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_answers_come_in_the_order_of_the_tasks(jobs: int) -> None:
    with SolverPool(Moody(), jobs, 30.0) as pool:
        answers = pool.solve(tasks(0.0, 0.0, 0.0, 0.0, 0.0))
    assert [answer.x[1] for answer in answers if isinstance(answer, Solution)] == [0, 2, 4, 6, 8]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_killed_child_loses_its_own_task_only(jobs: int) -> None:
    with SolverPool(Moody(), jobs, 30.0) as pool:
        answers = pool.solve(tasks(0.0, 1.0, 0.0, 3.0, 0.0))
    assert answers[1] == Lost("killed")
    assert answers[3] == Lost("ValueError: no good")
    assert all(isinstance(answers[k], Solution) for k in (0, 2, 4))


def test_a_task_that_takes_too_long_is_given_up() -> None:
    begin = time.monotonic()
    with SolverPool(Moody(), 1, 0.3) as pool:
        answers = pool.solve(tasks(2.0, 0.0))
    assert answers[0] == Lost("timeout")
    assert isinstance(answers[1], Solution)
    assert time.monotonic() - begin < 20.0


def test_nothing_to_do_starts_nothing() -> None:
    with SolverPool(Moody(), 2, 1.0) as pool:
        assert pool.solve([]) == []


def test_no_child_is_left_behind() -> None:
    before = children()
    with SolverPool(Moody(), 2, 30.0) as pool:
        pool.solve(tasks(0.0, 0.0))
        assert children() > before
    assert children() == before


def children() -> set[str]:
    """Process numbers of this process's children."""
    lists = Path("/proc/self/task").glob("*/children")
    return {number for path in lists for number in path.read_text().split()}
