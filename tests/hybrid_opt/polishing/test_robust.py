"""Robust forces in the polish: values of the robust model, slopes of differences, a point of both
kinds."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_DRIVABLE_OBJECTIVES, ROBUST_OBJECTIVES
from hybrid_opt.polishing.cell import CarryReader
from hybrid_opt.polishing.force import ForceProgram, ForceSolver, balanced_scalarisation
from hybrid_opt.polishing.intervals import IntervalGrid
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.robust import GOVERNING_CASES, ROBUST_ROWS, RobustSamples
from hybrid_opt.polishing.rows import ForceRow, Row
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.robust.path_force import PathPoints, robust_path
from hybrid_opt.timing.model import TimingModel
from symbolic.records.cell import Uncertainty, Workcell
from symbolic.records.task import initial_decision
from tests.hybrid_opt.polishing.cells import (
    disbelieved,
    drivable_rack,
    drive_method_of,
    functions,
    smooth_cell,
    solved,
    start,
    start_in,
)
from tests.hybrid_opt.polishing.test_force import TARGET, evaluator
from tests.hybrid_opt.polishing.test_joint_program import Programs, direction
from tests.hybrid_opt.robust.test_force import SET
from tests.symbolic.cells import RACK, hand_cell

FORCE = 52.0
STEP = 1e-6


def test_slopes_by_the_decision_vector_are_those_of_differences() -> None:
    robust = RobustSamples(replace(hand_cell(), uncertainty=SET))
    x = initial_decision(hand_cell().task)
    x = x + np.random.default_rng(3).normal(scale=0.01, size=len(x))
    value, slope = robust.first(x)
    assert value.shape == (hand_cell().task.samples, 2)
    assert slope.shape == (*value.shape, len(x))
    for j, step in enumerate(STEP * np.eye(len(x))):
        change = (robust.first(x + step)[0] - robust.first(x - step)[0]) / (2.0 * STEP)
        np.testing.assert_allclose(slope[:, :, j], change, atol=1e-4)


def unsure(objectives: tuple[str, ...] = ROBUST_OBJECTIVES) -> CandidateEvaluator:
    """The rack, whose functions know nothing of what is uncertain."""
    known = evaluator(RACK)
    workcell = replace(known.workcell, uncertainty=replace(SET, pad_position=0.0))
    return CandidateEvaluator(workcell, objectives, compiled=known.compiled)


def test_rows_agree_with_the_robust_forces_to_first_order() -> None:
    judge = unsure()
    cell = smooth_cell(judge)
    robust = cell.robust
    assert robust is not None
    x = initial_decision(judge.workcell.task)
    carry = CarryReader(cell).read(x)
    np.testing.assert_allclose(carry.peak, judge.evaluate(x).objectives[0], rtol=1e-9)
    rows: list[Row] = [ForceRow(robot, 0, sample) for robot in (0, 1) for sample in (10, 55, 90)]
    program = ForceProgram(cell, dict.fromkeys(rows, 0.0), TARGET, carry, x, 1.0)
    values, jacobian = program.rows(program.start)
    force, slope = robust.first(x)
    for k, row in enumerate(program.layout.force_rows):
        unit = judge.workcell.task.reference_force[row.robot] * TARGET.span[row.robot]
        phi = program.start[-3:][row.robot]
        wanted = force[row.sample, row.robot] / unit
        wanted -= TARGET.anchor[row.robot] / TARGET.span[row.robot] + phi
        assert -values[k] == pytest.approx(wanted, abs=1e-8)
        by_x = slope[row.sample, row.robot] * cell.half / unit
        np.testing.assert_allclose(-jacobian[k, : len(x)], by_x, atol=1e-8)


def test_a_carry_is_polished_for_its_robust_forces() -> None:
    """From the hand-made path: the balanced middle of the true robust forces comes down."""
    judge = unsure()
    solver = ForceSolver(smooth_cell(judge), PolishSettings(rounds=6))
    x = initial_decision(judge.workcell.task)
    start = judge.evaluate(x).objectives[0]
    target = balanced_scalarisation(start, np.full(2, 0.01))
    found = solver.solve(x, target, 1.0)
    after = judge.evaluate(found.x)
    assert after.feasible[0]
    assert after.objectives[0].max() < start.max() - 0.005
    assert after.objectives[0].sum() < start.sum() - 0.01


@cache
def unsure_rack() -> Workcell:
    ranges = Uncertainty(0.1, 0.05, np.full(3, 0.005), 0.003, np.full(3, 0.2))
    return replace(drivable_rack(), uncertainty=ranges)


def programs() -> Programs:
    """The planned forces' timing, its program with the robust forces' rows."""
    found = Programs(start(FORCE))
    found.intervals = IntervalGrid(unsure_rack(), 100, found.intervals.spread, robust=True)
    return found


def test_rows_are_those_of_the_robust_forces_with_their_slopes() -> None:
    made = programs()
    program, d, h = made.at(), direction(made.at(), 4), 3e-5
    rows = slice(program.rows.shape[1] - ROBUST_ROWS, None)
    path = made.intervals.path(made.cell.waypoints(made.x))
    begins = made.timed.squared[:-1]
    a = np.diff(made.timed.squared) * len(begins) / 2.0
    pose, first, second = (np.ascontiguousarray(part[:-1, :6]) for part in path)
    force, _ = robust_path(unsure_rack()).at(PathPoints(pose, first, second, a, begins))
    largest = program.rows[::2, rows].reshape(-1, 2, GOVERNING_CASES).max(axis=2)
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
    found = forces.planned_weights(weight, value)
    branches = made.intervals.kinds.mix[made.intervals.kinds.is_force][5:10]
    branches = branches[:, : made.intervals.layout.size]
    ruling = branches[np.argmax(branches @ value[2, :-ROBUST_ROWS])]
    np.testing.assert_allclose(found[2], 0.7 * ruling)
    assert not found[[0, 1, 3]].any()


@pytest.mark.slow
def test_a_point_is_driven_faster_within_robust_forces_and_believed() -> None:
    cell, force = unsure_rack(), 64.15
    evaluator = CandidateEvaluator(cell, ROBUST_DRIVABLE_OBJECTIVES, compiled=CompiledCell(cell))
    drive_method = drive_method_of(make_polisher(evaluator, PolishSettings(), functions()))
    driver = evaluator.driver
    assert driver is not None
    assert 60.0 < drive_method.force_limit[0] < 63.0
    begin = start_in(cell, force, 0)
    solution = solved(drive_method, begin, 24)
    before, after = (driver.time_candidate(each).timing for each in (begin, solution.x))
    assert after.duration < 0.8 * before.duration
    assert after.robust_force is not None
    assert after.robust_force.max() == pytest.approx(force, rel=2e-4)
    assert disbelieved(driver, TimingModel(evaluator.compiled, 100), solution.x) == ""
