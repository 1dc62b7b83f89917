"""Redundant joints in the joint program: exact derivatives by their values, and better carries."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.drivable.certified import second_opinion
from hybrid_opt.polishing.drivable.front import DrivablePolisher
from hybrid_opt.polishing.drivable.point import DriveStart
from hybrid_opt.polishing.drivable.timed import Goal
from hybrid_opt.polishing.functions import polish_functions
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.timing import TimingModel
from tests.hybrid_opt.polishing.drivable.cells import driven, start_in
from tests.hybrid_opt.polishing.drivable.test_program import (
    PolishedCell,
    Programs,
    assert_curvature,
    assert_slopes,
)
from tests.hybrid_opt.polishing.drivable.transcription import without_obstacles
from tests.redundant_cells import rack_on_rail

pytestmark = pytest.mark.slow

FORCE = 52.0


@pytest.fixture(scope="module")
def rail(tmp_path_factory: pytest.TempPathFactory) -> PolishedCell:
    """The rack without its obstacles, its left robot on a slide that may move half a metre in all:
    with them the robot's base, which moves, would touch what it stands on."""
    cell = without_obstacles(driven(rack_on_rail(tmp_path_factory.mktemp("rail"), 0.4, 0.25)))
    evaluator = CandidateEvaluator(cell, DRIVABLE_OBJECTIVES, compiled=CompiledCell(cell))
    functions = polish_functions(evaluator.compiled)
    settings = PolishSettings(attempts=3, drivable=DrivableSettings(rounds=12))
    return DrivablePolisher(evaluator, settings, functions), functions


def test_derivatives_are_exact(rail: PolishedCell) -> None:
    cell = rail[0].evaluator.workcell
    x = start_in(cell, FORCE, 0)
    assert Programs(x, of=rail).at().n_path == 18 + len(cell.task.waypoints)
    assert_slopes(Programs(x, of=rail), 0)
    assert_curvature(Programs(x, of=rail), None)


def test_a_carry_with_a_redundant_joint_is_driven_better_and_believed(rail: PolishedCell) -> None:
    polisher = rail[0]
    evaluator, solver = polisher.evaluator, polisher.drivable
    x = start_in(evaluator.workcell, FORCE, 0)
    begun = solver.judge.timed(x[:-1], Goal("duration", FORCE)).duration
    found = solver.solve(DriveStart(x, Goal("duration", FORCE), 0.3))
    assert solver.judge.timed(found.x[:-1], Goal("duration", FORCE)).duration < 0.9 * begun
    # The slide's values are used, not only the box's path.
    assert np.abs(found.x[18:-1] - x[18:-1]).max() > 1e-3
    assert evaluator.certified(evaluator.evaluate(found.x)).feasible[0]
    timings = TimingModel(evaluator.compiled, solver.driver.timer.intervals)
    assert second_opinion(solver.driver, timings, found.x) == ""
