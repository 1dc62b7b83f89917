"""toppra behind its adapter: closed-form answers, and failures as records without a log line."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from hybrid_opt.timing.topp_ra import LinearLimits, SolverFailure, fastest_speed


def rows(n: int, *limits: tuple[float, float, float]) -> LinearLimits:
    """The same rows a u'' + b u'^2 <= bound on every interval."""
    a, b, bound = (np.tile(column, (n, 1)) for column in np.array(limits).T)
    return LinearLimits(a, b, bound)


def duration(squared: np.ndarray, grid: np.ndarray) -> float:
    speed = np.sqrt(squared)
    return float(np.sum(2.0 * np.diff(grid) / (speed[:-1] + speed[1:])))


ACCELERATION = (1.0, 0.0, 3.0), (-1.0, 0.0, 3.0)


@pytest.mark.parametrize(
    ("speed", "time"), [((), 2.0 * np.sqrt(2.0 / 3.0)), (((0.0, 1.0, 1.0),), 2.0 + 1.0 / 3.0)]
)
def test_bounded_motion_takes_the_time_of_a_triangle_or_trapezoid(
    speed: tuple[tuple[float, float, float], ...], time: float
) -> None:
    grid = np.linspace(0.0, 2.0, 401)
    found = fastest_speed(rows(400, *ACCELERATION, *speed), grid)
    assert isinstance(found, np.ndarray)
    assert duration(found, grid) == pytest.approx(time, rel=1e-3 if speed else 1e-4)


def test_contradicting_rows_fail_at_their_interval(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    limits = rows(50, *ACCELERATION)
    limits.bound[20, 0] = -4.0  # at most -4 and at least -3
    with caplog.at_level(logging.DEBUG):
        found = fastest_speed(limits, np.linspace(0.0, 1.0, 51))
    assert isinstance(found, SolverFailure)
    assert found.interval == 20
    assert found.reason
    assert caplog.records == []
    assert capfd.readouterr().err == ""
    limits = rows(50, *ACCELERATION, (0.0, -1.0, -0.5))  # cannot be left from rest
    assert isinstance(fastest_speed(limits, np.linspace(0.0, 1.0, 51)), SolverFailure)
