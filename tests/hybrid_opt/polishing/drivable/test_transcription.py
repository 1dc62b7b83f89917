"""Polished drivable carries against a direct transcription of the same problem by another route.

The rack without its obstacles: bounds, reach, joints, payload and forces bind. Both begin with the
same path; then the transcription begins with the polished one as well, and finds next to nothing to
gain.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.drivable.front import DrivablePolisher
from hybrid_opt.polishing.drivable.point import DriveTask
from hybrid_opt.polishing.drivable.timed import Goal
from hybrid_opt.polishing.functions import polish_functions
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.timing import TimingLimits, TimingModel, time_path
from symbolic.array import Array
from tests.hybrid_opt.polishing.drivable.cells import drivable_rack, start_in
from tests.hybrid_opt.polishing.drivable.transcription import (
    STAGES,
    Guess,
    Transcription,
    without_obstacles,
)

pytestmark = pytest.mark.slow

COARSE = 0.02
"""Of the duration: what grids of 20 and of 100 stages differ by."""

GAIN = 0.005
"""Share that the transcription may find to gain on a polished carry."""


@cache
def compiled() -> CompiledCell:
    return CompiledCell(without_obstacles(drivable_rack()))


@cache
def polisher() -> DrivablePolisher:
    evaluator = CandidateEvaluator(compiled().workcell, DRIVABLE_OBJECTIVES, compiled=compiled())
    return DrivablePolisher(evaluator, PolishSettings(), polish_functions(compiled()))


@cache
def timings() -> TimingModel:
    return TimingModel(compiled(), 100)


@cache
def transcription() -> Transcription:
    return Transcription(compiled().model)


def guess(x: Array, force: float) -> Guess:
    """A driven path on the coarse grid, slower than it is driven."""
    motion = timings().path_motion(x)
    driven = time_path(timings(), x, TimingLimits(force=force), motion).grid_speed
    assert driven is not None
    at = np.linspace(0, len(motion.parameter) - 1, STAGES + 1).round().astype(int)
    coarse = motion.at(at)
    fine = np.linspace(0.0, 1.0, len(driven))
    speed = 0.9 * np.interp(coarse.parameter, fine, driven)
    return Guess(x, speed, coarse.q, coarse.q_first, coarse.q_second)


def duration(path: Array, force: float) -> float:
    """Of the compiled timing with every limit."""
    return polisher().drivable.judge.timed(path, Goal("duration", force)).duration


@pytest.mark.parametrize(("force", "seed"), [(50.0, 0), (52.0, 0), (52.0, 1), (55.0, 2)])
def test_least_duration_at_a_force(force: float, seed: int) -> None:
    x = start_in(compiled().workcell, force, seed)
    polished = polisher().drivable.solve(DriveTask(x, Goal("duration", force), 0.3)).x[:-1]
    ours = duration(polished, force)
    for begin in (x, np.append(polished, force)):
        other = transcription().solve(guess(begin, force), force)
        assert duration(other.path, force) > ours * (1.0 - GAIN)
        assert other.duration == pytest.approx(ours, rel=COARSE)


def test_least_force_in_a_time() -> None:
    wanted = 2.2
    x = start_in(compiled().workcell, 60.0, 0)
    polished = polisher().drivable.solve(DriveTask(x, Goal("force", wanted), 0.3)).x
    other = transcription().solve(guess(polished, float(polished[-1])), None, wanted)
    # What counts is what a force leaves above that of holding the box still.
    still = 49.05
    assert other.force - still == pytest.approx(polished[-1] - still, rel=0.1)
    assert duration(polished[:-1], float(polished[-1])) <= wanted * 1.001
