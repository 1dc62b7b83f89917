"""Which joints of a workcell are redundant, their bounds and first values, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from symbolic.errors import WorkcellError
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.read.redundancy import best_conditioned, posture_path
from symbolic.records.task import (
    decision_of,
    extended_waypoints,
    initial_decision,
    straight_line,
    waypoints_of,
)
from tests.machines import SINGLE, single_cell
from tests.redundant_cells import free_pandas, rack_on_rail
from tests.symbolic.read.samples import RACK


def test_the_tool_chooses_joints_bounds_and_a_path_within_the_limits(tmp_path: Path) -> None:
    cell = free_pandas(tmp_path)
    assert [joint.drives for joint in cell.task.redundant] == [(2, -1), (-1, 2)]
    for joint, robot in zip(cell.task.redundant, cell.robots, strict=True):
        assert joint.name == f"{robot.name}/panda_joint3"
        assert robot.redundant_joints == ("panda_joint3",)
        np.testing.assert_array_equal(joint.lower, robot.position_lower[2])
        np.testing.assert_array_equal(joint.upper, robot.position_upper[2])
        assert np.all((joint.lower < joint.initial) & (joint.initial < joint.upper))


def test_the_chosen_joint_leaves_the_others_conditioned_best(tmp_path: Path) -> None:
    cell = free_pandas(tmp_path)
    path = posture_path(cell.robots[0], cell.contacts[0], cell.task, {})
    assert path is not None
    least = [
        min(np.linalg.svd(np.delete(J, k, axis=1), compute_uv=False)[-1] for J in path.jacobian)
        for k in range(7)
    ]
    assert best_conditioned(path, 7, ()) == (int(np.argmax(least)),)
    assert best_conditioned(path, 7, (5,)) == (5,)


def test_what_the_file_says_holds(tmp_path: Path) -> None:
    entry = "lower = [0.1, -0.5, -0.6], upper = [0.1, 0.5, 0.6], initial = 0.1"
    task = free_pandas(tmp_path, entry).task
    assert task.n_var == 6 + 4
    np.testing.assert_array_equal(task.lower[6:], [-0.5, -0.6] * 2)
    x = np.concatenate([task.initial.ravel(), [0.2, 0.3, -0.2, -0.3]])
    points = extended_waypoints(task, x)
    np.testing.assert_array_equal(points[:, 6], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(points[:, 7], [0.1, -0.2, -0.3])
    np.testing.assert_array_equal(points[:, :6], waypoints_of(task, x))
    np.testing.assert_array_equal(decision_of(task, points), x)
    np.testing.assert_array_equal(initial_decision(task)[6:], 0.1)
    np.testing.assert_array_equal(straight_line(task)[6:], 0.1)


def test_a_slide_is_redundant_by_itself(tmp_path: Path) -> None:
    cell = rack_on_rail(tmp_path, 0.3)
    assert cell.robots[0].redundant_joints == ("slide",)
    assert cell.robots[1].redundant_joints == ()
    assert [str(j.shortname()) for j in arm_model(cell.robots[0]).joints[1:2]] == ["JointModelPX"]
    assert cell.task.n_var == load(RACK).task.n_var


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("lower = 1.0, upper = 0.5", "lower <= initial <= upper"),
        ("upper = 3.5", "beyond the joint's limits"),
        ("initial = [0.1, 0.2]", "array of 3 numbers"),
        ("joints = 3", "unknown key"),
    ],
)
def test_wrong_entries_are_told(tmp_path: Path, entry: str, told: str) -> None:
    with pytest.raises(WorkcellError, match=r"task\.redundant") as error:
        free_pandas(tmp_path, entry)
    assert told in str(error.value)


def test_an_unknown_joint_is_told_with_those_there_are(tmp_path: Path) -> None:
    path = single_cell(SINGLE["panda"], tmp_path, {})
    text = path.read_text()
    path.write_text(text.replace('"samples" =', '"redundant" = [{joint = "elbow"}], "samples" ='))
    with pytest.raises(WorkcellError, match="left/panda_joint3, right/panda_joint3"):
        load(path)


def test_redundant_joints_are_as_many_as_there_are_beyond_six(tmp_path: Path) -> None:
    path = single_cell(SINGLE["panda"], tmp_path, {})
    named = '"redundant_joints" = ["panda_joint1", "panda_joint3"], "base" ='
    path.write_text(path.read_text().replace('"base" =', named))
    with pytest.raises(WorkcellError, match=r"redundant_joints: found 2 names; allowed are 1"):
        load(path)
    path.write_text(path.read_text().replace('"panda_joint1", "panda_joint3"', '"panda_joint5"'))
    assert load(path).robots[0].redundant_joints == ("panda_joint5",)


def test_an_arm_with_five_joints_is_refused(tmp_path: Path) -> None:
    arm = SINGLE["ur5"]
    with pytest.raises(WorkcellError, match="allowed are 6 or more"):
        load(single_cell(replace(arm, locked={}), tmp_path, {"elbow_joint": 1.6}))
