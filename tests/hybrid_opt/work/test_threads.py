"""Linear algebra while a request is answered."""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_info

from hybrid_opt.work.job import Job


def threads() -> list[int]:
    """Of every linear algebra library that is loaded."""
    np.linalg.norm(np.eye(2))
    return [int(found["num_threads"]) for found in threadpool_info() if found["user_api"] == "blas"]


def test_a_request_is_answered_in_one_thread_and_the_others_return() -> None:
    before = threads()
    assert before
    job: Job[None, None, list[int]] = Job(lambda: None, lambda context, request, emit: threads())
    assert job.answer(None, None, lambda message: None) == [1] * len(before)
    assert threads() == before
