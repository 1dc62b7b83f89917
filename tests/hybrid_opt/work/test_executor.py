"""Tasks in this process and in others: same messages, same results, same errors."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from hybrid_opt.work.executor import Emit, Job, ProcessExecutor, SerialExecutor, local_executor
from symbolic.errors import DualArmError

EXECUTORS = [SerialExecutor(), ProcessExecutor(2)]


def context() -> dict[str, int]:
    return {"tasks": 0}


def echo(context: dict[str, int], task: int, emit: Emit) -> tuple[int, int]:
    context["tasks"] += 1
    for number in range(task):
        emit(bytes([number]))
    return task, context["tasks"]


def die_once(context: dict[str, int], task: Path, emit: Emit) -> str:
    emit(b"begun")
    if not task.exists():
        task.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def misuse(context: dict[str, int], task: int, emit: Emit) -> None:
    raise DualArmError("this cannot be done")


def mistake(context: dict[str, int], task: int, emit: Emit) -> None:
    raise OSError("a file of the task's own is missing")


def run(executor: Any, work: Any, tasks: list[Any]) -> tuple[dict[int, list[bytes]], list[Any]]:
    messages: dict[int, list[bytes]] = {index: [] for index in range(len(tasks))}
    results: list[Any] = [None] * len(tasks)
    executor.run(
        Job(context, work),
        len(tasks),
        tasks.__getitem__,
        lambda index, message: messages[index].append(message),
        results.__setitem__,
    )
    return messages, results


@pytest.mark.parametrize("executor", EXECUTORS)
def test_messages_in_order_and_results_complete(executor: Any) -> None:
    messages, results = run(executor, echo, [3, 0, 5, 1, 2])
    assert [result[0] for result in results] == [3, 0, 5, 1, 2]
    for index, task in enumerate([3, 0, 5, 1, 2]):
        assert messages[index] == [bytes([number]) for number in range(task)]
    # A context serves several tasks.
    assert max(result[1] for result in results) > 1


@pytest.mark.parametrize("executor", EXECUTORS)
def test_no_tasks_no_work(executor: Any) -> None:
    assert run(executor, echo, []) == ({}, [])


@pytest.mark.parametrize("executor", EXECUTORS)
def test_errors_end_the_work(executor: Any) -> None:
    with pytest.raises(DualArmError, match="this cannot be done"):
        run(executor, misuse, [1, 2, 3])
    with pytest.raises((OSError, RuntimeError), match="a file of the task's own is missing"):
        run(executor, mistake, [1, 2, 3])


def test_a_dead_worker_is_replaced(tmp_path: Path) -> None:
    tasks = [tmp_path / "a", tmp_path / "b"]
    tasks[1].touch()
    messages, results = run(ProcessExecutor(2), die_once, tasks)
    assert results == ["alive", "alive"]
    assert messages == {0: [b"begun", b"begun"], 1: [b"begun"]}


def test_one_job_needs_no_further_process() -> None:
    assert isinstance(local_executor(1), SerialExecutor)
    assert isinstance(local_executor(3), ProcessExecutor)
