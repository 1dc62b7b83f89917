"""Calls in forked children: order, errors, deaths."""

from __future__ import annotations

import os
import signal
import time
from functools import partial

import pytest

from hybrid_opt.errors import WorkerError
from hybrid_opt.work.children import in_children
from studies.errors import ReportError
from symbolic.errors import DualArmError

JOBS = 3


def slowly(value: int) -> tuple[int, int]:
    """The value, the later the smaller it is, and the process that it comes from."""
    time.sleep(0.02 * (5 - value))
    return value, os.getpid()


def refused() -> int:
    raise ReportError("no room in the figure")


def broken() -> int:
    raise ZeroDivisionError


def killed() -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def idle() -> int:
    return 1


def test_results_come_in_order_from_several_processes() -> None:
    told: list[int] = []
    results = in_children([partial(slowly, k) for k in range(5)], JOBS, lambda: told.append(1))
    assert [value for value, _ in results] == list(range(5))
    assert os.getpid() not in {process for _, process in results}
    assert len({process for _, process in results}) > 1
    assert len(told) == 5


@pytest.mark.parametrize(("count", "jobs"), [(3, 1), (1, JOBS), (0, JOBS)])
def test_one_process_is_this_one(count: int, jobs: int) -> None:
    results = in_children([partial(slowly, 5)] * count, jobs)
    assert results == [(5, os.getpid())] * count


def test_calls_need_not_be_picklable() -> None:
    texts = ["a", "b", "c"]
    assert in_children([lambda: "".join(texts), lambda: texts[0]], JOBS) == ["abc", "a"]


def test_what_a_call_raises_is_raised() -> None:
    with pytest.raises(DualArmError, match="no room in the figure"):
        in_children([refused, idle], JOBS)
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        in_children([broken, idle], JOBS)


def test_a_death_is_told() -> None:
    with pytest.raises(WorkerError, match="killed"):
        in_children([killed, idle], JOBS)
