"""One drivable point: driven better, judged by independent timings, stationary, and hardly to be
bettered by a direct transcription of the same problem."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.drive import DriveStepMethod
from hybrid_opt.polishing.front import Solution
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.timing.model import REFINEMENT, TimingModel
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from tests.hybrid_opt.polishing.cells import (
    disbelieved,
    drivable_rack,
    drive_method,
    drive_method_of,
    evaluator,
    solved,
    start,
    start_in,
)
from tests.hybrid_opt.polishing.transcription import (
    INTERVALS,
    Guess,
    Transcription,
    without_obstacles,
)
from tests.hybrid_opt.timing.cells import by_toppra


@cache
def answer(force: float) -> Solution:
    return solved(drive_method(), start(force))


@cache
def timing_model() -> TimingModel:
    return TimingModel(evaluator().compiled, 100)


def duration(x: np.ndarray) -> float:
    return by_toppra(timing_model(), x, TimingLimits(force=float(x[-1]))).duration


def test_the_least_duration_at_a_force_is_far_below_the_hand_made() -> None:
    solution = answer(52.0)
    assert solution.x[-1] == 52.0
    assert duration(solution.x) < 0.85 * duration(start(52.0))


def test_answers_are_feasible_certified_and_believed_by_the_independent_timing() -> None:
    x = answer(52.0).x
    found = evaluator().certified(evaluator().evaluate(x))
    assert found.feasible[0]
    assert disbelieved(evaluator().driver, timing_model(), x) == ""


def test_an_answer_is_nearly_stationary() -> None:
    solution = answer(52.0)
    assert solution.residuals.stationarity < 5e-3
    assert solution.residuals.feasibility < 2e-2


@pytest.mark.slow
def test_most_points_end_stationary() -> None:
    """In what is recomputed from the program, whichever way they came there."""
    forces = (50.0, 51.0, 53.0)
    residuals = [answer(force).residuals for force in forces]
    worst = sorted(max(r.stationarity, r.complementarity) for r in residuals)
    assert worst[1] <= 1e-4


def test_a_start_that_cannot_be_driven_is_told() -> None:
    x = np.append(evaluator().lower[:-1], 52.0)
    assert not np.isfinite(drive_method().driver.time_candidate(np.append(x[:-1], 52.0)).duration)
    solution = solved(drive_method(), x)
    assert not solution.usable
    assert solution.message
    np.testing.assert_array_equal(solution.x, x)


def test_a_climb_that_is_left_goes_on_as_if_it_had_not_been() -> None:
    whole, parts = drive_method().solve_from(start(55.0)), drive_method().solve_from(start(55.0))
    whole.run(6)
    parts.run(2)
    parts.run(4)
    np.testing.assert_array_equal(whole.best.x, parts.best.x)
    assert whole.solution.rounds == parts.solution.rounds


COARSE = 0.015
"""Of the duration, on the same coarse grid."""

GAIN = 0.005
"""Share of the duration that the transcription's path may gain on the polished one."""


@cache
def compiled() -> CompiledCell:
    return CompiledCell(without_obstacles(drivable_rack()))


@cache
def open_way() -> DriveStepMethod:
    evaluator = CandidateEvaluator(compiled().workcell, DRIVABLE_OBJECTIVES, compiled=compiled())
    return drive_method_of(make_polisher(evaluator, PolishSettings()))


@cache
def coarse() -> TimingModel:
    return TimingModel(compiled(), INTERVALS)


@cache
def transcription() -> Transcription:
    return Transcription(compiled().model)


def guess(x: Array, force: float) -> Guess:
    """A driven path on the coarse grid, slower than it is driven."""
    motion = coarse().path_motion(x)
    driven = by_toppra(coarse(), x, TimingLimits(force=force)).grid_speed
    assert driven is not None
    at = motion.at(np.arange(0, len(motion.parameter), REFINEMENT))
    return Guess(x, 0.9 * driven, at.q, at.q_first, at.q_second)


def compiled_duration(path: Array, force: float) -> float:
    """Of the compiled timing with every limit, on its finer grid."""
    return open_way().driver.time_candidate(np.append(path, force)).duration


@pytest.mark.slow
@pytest.mark.parametrize(
    ("force", "seed", "polished_first"),
    [(51.0, 0, True), (52.0, 0, True), (52.0, 1, False), (53.0, 1, True), (55.0, 2, True)],
)
def test_least_duration_at_a_force(force: float, seed: int, polished_first: bool) -> None:
    x = start_in(compiled().workcell, force, seed)
    polished = solved(open_way(), x).x
    other = transcription().solve(guess(polished if polished_first else x, force), force)
    ours = compiled_duration(polished[:-1], force)
    assert ours < 0.9 * compiled_duration(x[:-1], force)
    assert compiled_duration(other.path, force) > ours * (1.0 - GAIN)
    on_coarse = by_toppra(coarse(), polished, TimingLimits(force=force)).duration
    assert other.duration == pytest.approx(on_coarse, rel=COARSE)
