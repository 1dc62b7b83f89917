"""Redundant joints in the joint program: exact derivatives by their values, and better carries."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.drive_front import second_opinion
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.timing.model import TimingModel
from tests.hybrid_opt.polishing.cells import driven, solved, start_in, way_of
from tests.hybrid_opt.polishing.test_joint_program import Programs, assert_curvature, assert_slopes
from tests.hybrid_opt.polishing.transcription import without_obstacles
from tests.redundant_cells import rack_on_rail

pytestmark = pytest.mark.slow

FORCE = 52.0


@pytest.fixture(scope="module")
def rail(tmp_path_factory: pytest.TempPathFactory) -> Polisher:
    """The rack without its obstacles, its left robot on a slide that may move half a metre in all:
    with them the robot's base, which moves, would touch what it stands on."""
    cell = without_obstacles(driven(rack_on_rail(tmp_path_factory.mktemp("rail"), 0.4, 0.25)))
    evaluator = CandidateEvaluator(cell, DRIVABLE_OBJECTIVES, compiled=CompiledCell(cell))
    settings = PolishSettings(attempts=3, drivable=DrivableSettings(rounds=12))
    return Polisher(evaluator, settings)


def test_derivatives_are_exact(rail: Polisher) -> None:
    cell = rail.evaluator.workcell
    x = start_in(cell, FORCE, 0)
    assert Programs(x, rail).at().n_path == 18 + len(cell.task.waypoints)
    assert_slopes(Programs(x, rail), 0)
    assert_curvature(Programs(x, rail))


def test_a_carry_with_a_redundant_joint_is_driven_better_and_believed(rail: Polisher) -> None:
    evaluator, way = rail.evaluator, way_of(rail)
    x = start_in(evaluator.workcell, FORCE, 0)
    begun = way.paths.timed(x[:-1], FORCE).duration
    found = solved(way, x)
    assert way.paths.timed(found.x[:-1], FORCE).duration < 0.9 * begun
    # The slide's values are used, not only the box's path.
    assert np.abs(found.x[18:-1] - x[18:-1]).max() > 1e-3
    assert evaluator.certified(evaluator.evaluate(found.x)).feasible[0]
    timings = TimingModel(evaluator.compiled, way.driver.timer.intervals)
    assert second_opinion(way.driver, timings, found.x) == ""
