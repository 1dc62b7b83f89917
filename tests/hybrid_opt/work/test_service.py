"""What holds for whoever does the work: same messages, same answers, same errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from hybrid_opt.errors import WorkerError
from hybrid_opt.work.processes import LocalExecutor, ProcessExecutor
from hybrid_opt.work.service import (
    KILLED,
    SILENT,
    Executor,
    SerialExecutor,
    Service,
    answer_all,
    give_up,
)
from symbolic.errors import DualArmError
from tests.hybrid_opt.work import services
from tests.hybrid_opt.work.services import run

EXECUTORS: list[Executor] = [SerialExecutor(), ProcessExecutor(2), LocalExecutor(3)]


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
    told: list[int] = []
    service = Service(services.context, services.echo)
    answers = answer_all(ProcessExecutor(3), service, [4, 3, 2, 1], lambda: told.append(1))
    assert [answer[0] for answer in answers] == [4, 3, 2, 1]
    assert len(told) == 4


@pytest.mark.parametrize(
    ("reason", "text"), [(KILLED, "died 3 times over one task .* --resume"), (SILENT, "too long")]
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
