"""Polished drivable carries against a direct transcription of the same problem by another route.

The rack without its obstacles: bounds, reach, joints, payload and forces bind. The transcription
begins with the polished carry, or with the path that the polish began with.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.drive import DriveWay
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.timing.model import REFINEMENT, TimingModel
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from tests.hybrid_opt.polishing.cells import drivable_rack, solved, start_in, way_of
from tests.hybrid_opt.polishing.transcription import (
    INTERVALS,
    Guess,
    Transcription,
    without_obstacles,
)

pytestmark = pytest.mark.slow

COARSE = 0.015
"""Of the duration, on the same coarse grid."""

GAIN = 0.005
"""Share of the duration that the transcription's path may gain on the polished one."""


@cache
def compiled() -> CompiledCell:
    return CompiledCell(without_obstacles(drivable_rack()))


@cache
def way() -> DriveWay:
    evaluator = CandidateEvaluator(compiled().workcell, DRIVABLE_OBJECTIVES, compiled=compiled())
    return way_of(Polisher(evaluator, PolishSettings()))


@cache
def coarse() -> TimingModel:
    return TimingModel(compiled(), INTERVALS)


@cache
def transcription() -> Transcription:
    return Transcription(compiled().model)


def guess(x: Array, force: float) -> Guess:
    """A driven path on the coarse grid, slower than it is driven."""
    motion = coarse().path_motion(x)
    driven = time_path(coarse(), x, TimingLimits(force=force), motion).grid_speed
    assert driven is not None
    at = motion.at(np.arange(0, len(motion.parameter), REFINEMENT))
    return Guess(x, 0.9 * driven, at.q, at.q_first, at.q_second)


def duration(path: Array, force: float) -> float:
    """Of the compiled timing with every limit, on its finer grid."""
    return way().paths.timed(path, force).duration


@pytest.mark.parametrize(
    ("force", "seed", "polished_first"),
    [(51.0, 0, True), (52.0, 0, True), (52.0, 1, False), (53.0, 1, True), (55.0, 2, True)],
)
def test_least_duration_at_a_force(force: float, seed: int, polished_first: bool) -> None:
    x = start_in(compiled().workcell, force, seed)
    polished = solved(way(), x).x
    other = transcription().solve(guess(polished if polished_first else x, force), force)
    ours = duration(polished[:-1], force)
    assert ours < 0.9 * duration(x[:-1], force)
    assert duration(other.path, force) > ours * (1.0 - GAIN)
    on_coarse = time_path(coarse(), polished, TimingLimits(force=force)).duration
    assert other.duration == pytest.approx(on_coarse, rel=COARSE)
