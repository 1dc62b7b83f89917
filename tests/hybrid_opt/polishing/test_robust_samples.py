"""Robust forces in the smooth problem: values of the robust model, slopes of differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.polishing.functions import polish_functions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.layout import ForceRow, Row
from hybrid_opt.polishing.placed_carry import CarryReader
from hybrid_opt.polishing.point import PolishSolver, SolveStart
from hybrid_opt.polishing.program import SmoothProgram
from hybrid_opt.polishing.robust_samples import RobustSamples
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.smooth_cell import SmoothCell
from hybrid_opt.polishing.targets import balance
from symbolic.records.task import initial_decision
from tests.hybrid_opt.polishing.test_program import TARGET, evaluator
from tests.hybrid_opt.robust.test_force import SET
from tests.symbolic.cells import hand_cell
from tests.symbolic.read.samples import RACK

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
    robust, grid = RobustSamples(judge.workcell), Grid(judge.workcell.task)
    functions = polish_functions(judge.compiled)
    cell = SmoothCell(judge.workcell, functions, grid, robust)
    x = initial_decision(judge.workcell.task)
    carry = CarryReader(judge, grid, functions.rows, robust).read(x)
    np.testing.assert_allclose(carry.peak, judge.evaluate(x).objectives[0], rtol=1e-9)
    rows: list[Row] = [ForceRow(robot, 0, sample) for robot in (0, 1) for sample in (10, 55, 90)]
    program = SmoothProgram(cell, dict.fromkeys(rows, 0.0), TARGET, carry, x, 1.0)
    values, jacobian = program.constraints(program.start)
    force, slope = robust.first(x)
    for k, row in enumerate(program.layout.force_rows):
        unit = judge.workcell.task.reference_force[row.robot] * TARGET.span[row.robot]
        phi = program.start[program.layout.peaks][row.robot]
        wanted = force[row.sample, row.robot] / unit
        wanted -= TARGET.anchor[row.robot] / TARGET.span[row.robot] + phi
        assert values[k] == pytest.approx(wanted, abs=1e-8)
        by_x = slope[row.sample, row.robot] * cell.unit.half / unit
        np.testing.assert_allclose(jacobian[k, program.layout.decision], by_x, atol=1e-8)


def test_a_carry_is_polished_for_its_robust_forces() -> None:
    """From the hand-made path: the balanced middle of the true robust forces comes down."""
    judge = unsure()
    functions = polish_functions(judge.compiled)
    settings = PolishSettings(rounds=6)
    x = initial_decision(judge.workcell.task)
    start = judge.evaluate(x).objectives[0]
    target = balance(start, np.full(2, 0.01))
    found = PolishSolver(judge, functions, settings).solve(SolveStart(x, target))
    after = judge.evaluate(found.x)
    assert after.feasible[0]
    assert after.objectives[0].max() < start.max() - 0.005
    assert after.objectives[0].sum() < start.sum() - 0.01
