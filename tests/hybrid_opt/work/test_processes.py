"""Workers in processes: deaths, hangs, Ctrl-C and the end of the parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from hybrid_opt.errors import WorkerError
from hybrid_opt.work.service import (
    KILLED,
    MAX_DEATHS,
    SILENT,
    Executor,
    LocalExecutor,
    Service,
    answer_all,
    give_up,
)
from symbolic.errors import DualArmError
from tests.hybrid_opt.work import services
from tests.hybrid_opt.work.services import MessageLedger, run
from tests.waiting import HANGS, soon, until

EXECUTORS: list[Executor] = [LocalExecutor(), LocalExecutor(2, apart=True), LocalExecutor(3)]


@pytest.mark.parametrize("executor", EXECUTORS)
def test_messages_in_order_and_answers_complete(executor: Any) -> None:
    found = run(executor, services.echo, [3, 0, 5, 1, 2])
    assert [answer[0] for answer in found.answers] == [3, 0, 5, 1, 2]
    for index, request in enumerate([3, 0, 5, 1, 2]):
        assert found.messages[index] == [bytes([number]) for number in range(request)]
    # A context serves several requests.
    assert max(answer[1] for answer in found.answers) > 1


@pytest.mark.parametrize("executor", EXECUTORS)
def test_no_requests_no_work(executor: Any) -> None:
    assert run(executor, services.echo, []).answers == []


@pytest.mark.parametrize("executor", EXECUTORS)
def test_errors_end_the_work(executor: Any) -> None:
    with pytest.raises(DualArmError, match="this cannot be done"):
        run(executor, services.misuse, [1, 2, 3])
    with pytest.raises((OSError, RuntimeError), match="a file of the request's own is missing"):
        run(executor, services.mistake, [1, 2, 3])


def test_who_works_changes_no_bit() -> None:
    first, *others = [run(executor, services.numbers, [1, 2, 3, 4, 5]) for executor in EXECUTORS]
    for other in others:
        assert other.answers == first.answers
        assert other.messages == first.messages


def test_a_list_is_answered_in_order_and_every_answer_told() -> None:
    told: dict[int, Any] = {}
    service = Service(services.context, services.echo)
    answers = answer_all(LocalExecutor(3, apart=True), service, [4, 3, 2, 1], told.__setitem__)
    assert [answer[0] for answer in answers] == [4, 3, 2, 1]
    assert [told[k] for k in range(4)] == answers


@pytest.mark.parametrize(
    ("reason", "text"),
    [(KILLED, "died 3 times over one task .*__main__.* --resume"), (SILENT, "too long")],
)
def test_what_is_lost_is_told(reason: str, text: str) -> None:
    with pytest.raises(WorkerError, match=text):
        give_up(reason)


def threads() -> list[int]:
    """Of every linear algebra library that is loaded."""
    np.linalg.norm(np.eye(2))
    return [int(found["num_threads"]) for found in threadpool_info() if found["user_api"] == "blas"]


def test_a_request_is_answered_in_one_thread_and_the_others_return() -> None:
    before = threads()
    assert before
    service: Service[None, None, list[int]] = Service(
        lambda: None, lambda context, request, emit: threads()
    )
    assert service.answer(None, None, lambda message: None) == [1] * len(before)
    assert threads() == before


ROOT = Path(__file__).parents[3]


def test_a_killed_worker_is_replaced_and_its_request_repeated(tmp_path: Path) -> None:
    requests = [tmp_path / "a", tmp_path / "b"]
    requests[1].touch()
    found = run(LocalExecutor(2, apart=True), services.killed_once, requests)
    assert found.answers == ["alive", "alive"]
    assert found.messages == {0: [b"begun", b"begun"], 1: [b"begun"]}
    assert found.losses == []


def test_deaths_with_progress_in_between_lose_nothing() -> None:
    class Progressing(MessageLedger):
        def request(self, index: int) -> Any:
            return len(self.messages[index])

    ledger = Progressing([None])
    LocalExecutor(1, apart=True).run(
        Service(services.context, services.killed_step_by_step), ledger
    )
    assert ledger.answers == [5] > [MAX_DEATHS]
    assert ledger.losses == []


def test_a_request_that_kills_its_workers_is_lost_and_no_other() -> None:
    found = run(
        LocalExecutor(2, apart=True), services.moody, ["a", "die", "b", "c"], instead="instead"
    )
    assert found.answers == ["a", "instead", "b", "c"]
    assert found.losses == [(1, KILLED)]
    with pytest.raises(WorkerError, match="died 3 times"):
        answer_all(
            LocalExecutor(2, apart=True), Service(services.context, services.moody), ["die", "a"]
        )


@pytest.mark.parametrize("processes", [1, 2])
def test_a_hung_request_is_given_up_and_no_other(processes: int) -> None:
    executor = LocalExecutor(processes)
    with soon():
        found = run(executor, services.moody, ["hang", "a"], patience=0.3, instead="instead")
    assert found.answers == ["instead", "a"]
    assert found.losses == [(0, SILENT)]


def test_only_what_must_be_given_up_needs_a_process_of_its_own() -> None:
    assert run(LocalExecutor(1), services.process, [1, 2]).answers == [os.getpid()] * 2
    assert run(LocalExecutor(8), services.process, [1]).answers == [os.getpid()]
    assert os.getpid() not in run(LocalExecutor(1), services.process, [1], patience=60.0).answers
    assert run(LocalExecutor(0), services.process, [1]).answers == [os.getpid()]
    assert os.getpid() not in run(LocalExecutor(1, apart=True), services.process, [1]).answers


def test_no_worker_is_left_behind() -> None:
    run(LocalExecutor(2, apart=True), services.echo, [1, 2, 3])
    assert not [child for child in multiprocessing.active_children() if child.name == "worker"]


PROGRAM = """
import sys, time
from hybrid_opt.work.service import Service
from hybrid_opt.work.service import LocalExecutor, warm_up
from tests.hybrid_opt.work import services
warm_up("tests.hybrid_opt.work.services")
ledger = services.MessageLedger(["hang", "hang"])
print("started", flush=True)
try:
    LocalExecutor(2, apart=True).run(Service(services.context, services.moody), ledger)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize(
    "moment", [0.4, *(pytest.param(at, marks=pytest.mark.slow) for at in (0.0, 1.5))]
)
def test_ctrl_c_reaches_the_parent_alone(moment: float) -> None:
    process = started()
    time.sleep(moment)
    os.killpg(process.pid, signal.SIGINT)
    told, complaints = process.communicate(timeout=HANGS)
    assert told == "interrupted\n"
    assert complaints == ""
    wait_for_the_end_of_all(process.pid)


def test_workers_end_with_a_killed_parent() -> None:
    process = started()
    time.sleep(1.0)
    process.kill()
    process.communicate()
    wait_for_the_end_of_all(process.pid)


def started() -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    return process


def wait_for_the_end_of_all(group: int) -> None:
    def ended() -> bool:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        return False

    until(ended)
