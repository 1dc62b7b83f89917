"""How many files of the project one operation runs through, and how deep its calls are nested: each
count may fall, and no change may raise it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho

ROOT = str(Path(ho.__file__).resolve().parents[1])


def traced(call: Callable[[], Any]) -> tuple[int, int]:
    """Files of the project that a call runs through, and the depth of its frames there, after the
    call has run once: then nothing is built or loaded any more."""
    call()
    files, deepest, local = set[str](), [0], threading.local()

    def profile(frame: FrameType, event: str, _: Any) -> None:
        name = frame.f_code.co_filename
        if not name.startswith(ROOT) or ".venv" in name or "/tests/" in name:
            return
        depth = getattr(local, "depth", 0)
        if event == "call":
            files.add(name)
            local.depth = depth + 1
            deepest[0] = max(deepest[0], depth + 1)
        elif event == "return":
            local.depth = max(depth - 1, 0)

    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return len(files), deepest[0]


@cache
def cell() -> ho.Cell:
    return ho.example("rack")


@cache
def driven() -> ho.Cell:
    return cell().drivable()


@cache
def front() -> ho.Front:
    return ho.search(driven(), "nsga2", evaluations=300, rng=np.random.default_rng(1))


ONE_ATTEMPT = ho.PolishSettings(attempts=1)


@cache
def polished() -> ho.Front:
    return ho.polish(front(), rng=np.random.default_rng(2), settings=ONE_ATTEMPT)


def search() -> ho.Front:
    return ho.search(driven(), "nsga2", evaluations=80, rng=np.random.default_rng(3))


@pytest.mark.parametrize(
    ("operation", "files", "depth"),
    [
        (lambda: cell().evaluate(cell().initial), 5, 7),
        (lambda: ho.time_path(cell(), cell().initial, ho.TimingLimits(force=60.0)), 9, 11),
        pytest.param(search, 15, 12, marks=pytest.mark.slow),
        pytest.param(lambda: polished.__wrapped__(), 25, 15, marks=pytest.mark.slow),
        pytest.param(lambda: ho.recommend(polished()), 28, 15, marks=pytest.mark.slow),
    ],
)
def test_an_operation_runs_through_few_files(
    operation: Callable[[], Any], files: int, depth: int
) -> None:
    found = traced(operation)
    assert found[0] <= files
    assert found[1] <= depth
