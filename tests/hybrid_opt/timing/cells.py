"""Timing models of hand-written cells, built once per test process."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import Timing, TimingLimits, TimingStatus
from hybrid_opt.timing.solve import time_by_programs, time_path
from symbolic.array import Array
from symbolic.records import Workcell
from tests.symbolic.cells import hand_cell, hand_model

INTERVALS = 200


@cache
def hand_timing(intervals: int = INTERVALS) -> TimingModel:
    """The hand-written cell, to be timed."""
    return timing_of(hand_cell(), intervals)


def timing_of(cell: Workcell, intervals: int = INTERVALS) -> TimingModel:
    """A cell of the hand-written kind, to be timed."""
    return TimingModel(CompiledCell(cell, model=hand_model(cell)), intervals)


def with_robots(cell: Workcell, **factors: float) -> Workcell:
    """The cell with some of its robots' limits multiplied."""
    first, second = (
        replace(robot, **{name: getattr(robot, name) * f for name, f in factors.items()})
        for robot in cell.robots
    )
    return replace(cell, robots=(first, second))


def initial() -> Array:
    """(n_var,) the hand-made trajectory."""
    return hand_cell().task.initial.reshape(-1)


def near_initial(rng: np.random.Generator, count: int, size: float = 1.0) -> Array:
    """(count, n_var) random trajectories around the hand-made one that both arms can follow."""
    model = hand_timing()
    found: list[Array] = []
    spread = size * np.tile([0.04, 0.02, 0.04, 0.06, 0.06, 0.06], 3)
    while len(found) < count:
        x = initial() + spread * rng.uniform(-1.0, 1.0, len(spread))
        motion = model.path_motion(x)
        if not motion.lost.any() and motion.manipulability.min() > 0.01:
            found.append(x)
    return np.array(found)


def by_toppra(model: TimingModel, x: Array, limits: TimingLimits) -> Timing:
    """The fastest timing by TOPP-RA, which shares no method with the passes; errors of the path and
    at rest are those of `time_path`."""
    timing = time_path(model, x, limits)
    if timing.ok or timing.status in (TimingStatus.SOLVER_FAILED, TimingStatus.NOT_CONVERGED):
        return time_by_programs(model, model.path_motion(x), limits)
    return timing
