"""Robust forces in the joint program of path and timing: slopes, curvature's bearer, a point."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.drivable.certified import second_opinion
from hybrid_opt.polishing.drivable.front import DrivablePolisher
from hybrid_opt.polishing.drivable.intervals import IntervalGrid
from hybrid_opt.polishing.drivable.point import DriveStart
from hybrid_opt.polishing.drivable.robust_rows import CASES, ROBUST_ROWS
from hybrid_opt.polishing.drivable.timed import Goal
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.robust.path_force import PathPoints, robust_path
from hybrid_opt.timing import TimingModel
from symbolic.records import Uncertainty, Workcell
from tests.hybrid_opt.polishing.drivable.cells import drivable_rack, functions, start, start_in
from tests.hybrid_opt.polishing.drivable.test_program import Programs, direction

FORCE = 52.0


@cache
def unsure_rack() -> Workcell:
    ranges = Uncertainty(0.1, 0.05, np.full(3, 0.005), 0.003, np.full(3, 0.2))
    return replace(drivable_rack(), uncertainty=ranges)


def programs() -> Programs:
    """The planned forces' timing, its program with the robust forces' rows."""
    found = Programs(start(FORCE))
    found.intervals = IntervalGrid(unsure_rack(), 100, robust=True)
    return found


def test_rows_are_those_of_the_robust_forces_with_their_slopes() -> None:
    made = programs()
    program, d, h = made.at(), direction(made.at(), 4), 3e-5
    rows = slice(program.rows.shape[1] - ROBUST_ROWS, None)
    path = made.intervals.path(made.x)
    begins = made.timed.squared[:-1]
    a = np.diff(made.timed.squared) * len(begins) / 2.0
    pose, first, second = (np.ascontiguousarray(part[:-1, :6]) for part in path)
    force, _ = robust_path(unsure_rack()).at(PathPoints(pose, first, second, a, begins))
    largest = program.rows[::2, rows].reshape(-1, 2, CASES).max(axis=2)
    np.testing.assert_allclose(largest, force / FORCE - 1.0, atol=1e-6)
    difference = (made.at(h * d).rows - made.at(-h * d).rows)[:, rows] / (2.0 * h)
    foretold = (program.predicted(d) - program.rows)[:, rows]
    # Cases that exchange their places within the step have neither's slope.
    near = np.abs(difference - foretold) < 5e-3 * np.abs(foretold).max()
    assert near.mean() > 0.99


def test_robust_rows_bend_as_the_planned_force_that_rules() -> None:
    made = programs()
    forces = made.intervals.robust
    assert forces is not None
    value = np.random.default_rng(1).normal(size=(4, made.intervals.layout.size + ROBUST_ROWS))
    weight = np.zeros_like(value)
    weight[2, -1] = 0.7
    found = forces.as_planned(weight, value)
    branches = made.intervals.kinds.mix[made.intervals.kinds.is_force][5:10]
    branches = branches[:, : made.intervals.layout.size]
    ruling = branches[np.argmax(branches @ value[2, :-ROBUST_ROWS])]
    np.testing.assert_allclose(found[2], 0.7 * ruling)
    assert not found[[0, 1, 3]].any()


@pytest.mark.slow
def test_a_point_is_driven_faster_within_robust_forces_and_believed() -> None:
    cell, force = unsure_rack(), 64.15
    evaluator = CandidateEvaluator(cell, ROBUST_DRIVABLE_OBJECTIVES, compiled=CompiledCell(cell))
    settings = PolishSettings(attempts=1, drivable=DrivableSettings(rounds=16))
    polisher = DrivablePolisher(evaluator, settings, functions())
    driver = evaluator.driver
    assert driver is not None
    assert 60.0 < polisher.drivable.judge.force_limit[0] < 63.0
    begin = start_in(cell, force, 0)
    solution = polisher.drivable.solve(DriveStart(begin, Goal("duration", force), 0.3))
    before, after = driver.timings(np.array([begin, solution.x]))
    assert after.duration < 0.8 * before.duration
    assert after.robust_force is not None
    assert after.robust_force.max() == pytest.approx(force, rel=2e-4)
    assert second_opinion(driver, TimingModel(evaluator.compiled, 100), solution.x) == ""
