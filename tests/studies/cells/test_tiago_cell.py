"""The cell that ships of a machine with both arms in one URDF and a lift below them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from studies.run import main
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.symbolic.read.samples import RACK

TIAGO = RACK.with_name("tiago.toml")


@pytest.fixture(scope="module")
def workcell() -> Workcell:
    return load(TIAGO)


def test_the_lift_is_one_joint_of_both_arms(workcell: Workcell) -> None:
    lift, left, right = workcell.task.redundant
    assert (lift.name, lift.drives) == ("left/torso_lift_joint", (0, 0))
    assert (left.name, left.drives) == ("left/arm_left_3_joint", (3, -1))
    assert (right.name, right.drives) == ("right/arm_right_3_joint", (-1, 3))
    assert workcell.task.n_var == 3 * 6 + 3 * 5
    assert workcell.robots[0].urdf == workcell.robots[1].urdf


def test_the_lift_carries_most_of_the_height(workcell: Workcell) -> None:
    start, goal = (w.lower for w in (workcell.task.waypoints[0], workcell.task.waypoints[-1]))
    lift = workcell.task.redundant[0].initial
    assert np.all(np.diff(lift) > 0.0)
    assert lift[-1] - lift[0] > 0.75 * (goal[2] - start[2])


@pytest.mark.slow
def test_the_hand_made_trajectory_is_feasible_and_the_bounds_searchable(workcell: Workcell) -> None:
    cell = Cell(workcell)
    initial = cell.evaluate(cell.initial)
    assert cell.evaluator.certified(initial).feasible.all()
    share = cell.evaluate(cell.random(1000, np.random.default_rng(1))).feasible.mean()
    assert 0.02 <= share <= 0.2


@pytest.mark.slow
def test_both_arms_stand_on_one_lift(workcell: Workcell) -> None:
    cell = Cell(workcell)
    x = cell.random(50, np.random.default_rng(2))
    outputs = cell.evaluator.outputs(x)
    followed = (outputs["lost_1"][:, -1] + outputs["lost_2"][:, -1]).ravel() == 0.0
    assert followed.any()
    np.testing.assert_array_equal(
        outputs["q_1"][followed][:, :, 0], outputs["q_2"][followed][:, :, 0]
    )


@pytest.mark.slow
def test_a_small_study_goes_through(tmp_path: Path) -> None:
    output = tmp_path / "results"
    arguments = [str(TIAGO), "--output", str(output), "--replicas", "1", "--evaluations", "120"]
    small = ["--no-polish", "--no-report", "--no-drivable", "--jobs", "1", "--quiet"]
    assert main([*arguments, *small]) == 0
    assert (output / "summary.json").exists()
