"""One drivable point: driven better, judged by independent timings, stationary."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.polishing.drivable.certified import second_opinion
from hybrid_opt.polishing.drivable.point import Climb, DrivableSolver, DriveStart
from hybrid_opt.polishing.drivable.timed import DriveAim, Goal
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.timing import TimingLimits, TimingModel, time_path
from tests.hybrid_opt.polishing.drivable.cells import evaluator, functions, polisher, start

RADIUS = 0.3


@cache
def solved(aim: DriveAim, limit: float) -> Solution:
    return polisher().drivable.solve(DriveStart(start(limit), Goal(aim, limit), RADIUS))


@cache
def timing_model() -> TimingModel:
    return TimingModel(evaluator().compiled, 100)


def duration(x: np.ndarray) -> float:
    return time_path(timing_model(), x, TimingLimits(force=float(x[-1]))).duration


def test_the_least_duration_at_a_force_is_far_below_the_hand_made() -> None:
    solution = solved("duration", 52.0)
    assert solution.x[-1] == 52.0
    assert duration(solution.x) < 0.85 * duration(start(52.0))


def test_answers_are_feasible_certified_and_believed_by_the_independent_timing() -> None:
    x = solved("duration", 52.0).x
    found = evaluator().certified(evaluator().evaluate(x))
    assert found.feasible[0]
    driver = evaluator().driver
    assert driver is not None
    assert second_opinion(driver, timing_model(), x) == ""


def test_an_answer_is_nearly_stationary() -> None:
    solution = solved("duration", 52.0)
    assert solution.residuals.stationarity < 5e-3
    assert solution.residuals.feasibility < 2e-2


def test_most_points_end_stationary() -> None:
    """In what is recomputed from the program, whichever way they came there."""
    forces = (50.0, 51.0, 53.0)
    residuals = [
        polisher().drivable.solve(DriveStart(start(f), Goal("duration", f), RADIUS)).residuals
        for f in forces
    ]
    worst = sorted(max(r.stationarity, r.complementarity) for r in residuals)
    assert worst[1] <= 1e-4


@pytest.mark.parametrize(("worth", "goes_on"), [(1.0, False), (1e-6, True)])
def test_a_point_goes_on_while_that_brings_much(worth: float, goes_on: bool) -> None:
    driven = DrivableSettings(rounds=2, worth=worth, turn=1, most_rounds=5)
    solver = DrivableSolver(evaluator(), functions(), PolishSettings(drivable=driven))
    climb = Climb(solver, start(53.0), Goal("duration", 53.0), RADIUS)
    climb.finish()
    assert 3 <= climb.solution.rounds <= 6 if goes_on else climb.solution.rounds == 2


def test_least_force_and_least_duration_are_two_sides_of_one_front() -> None:
    fast = solved("duration", 52.0)
    gentle = polisher().drivable.solve(DriveStart(fast.x, Goal("force", duration(fast.x)), RADIUS))
    assert gentle.x[-1] == pytest.approx(52.0, rel=2e-3)
    assert duration(gentle.x) <= duration(fast.x) * 1.002


def test_a_start_that_cannot_be_driven_is_told() -> None:
    x = start(52.0)
    solution = polisher().drivable.solve(DriveStart(x, Goal("force", 0.5), RADIUS))
    assert not solution.usable
    assert solution.message == "the start has no timing"
    np.testing.assert_array_equal(solution.x[:-1], x[:-1])


@pytest.mark.parametrize("wanted", [3.0, 4.0])
def test_the_least_force_of_a_path_takes_the_wanted_time(wanted: float) -> None:
    judge, path = polisher().drivable.judge, start(52.0)[:-1]
    timed = judge.timed(path, Goal("force", wanted))
    assert timed.duration <= wanted * (1.0 + 1e-9)
    less = judge.timed(path, Goal("duration", timed.force * 0.999))
    assert less.duration > wanted
