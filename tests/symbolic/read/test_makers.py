"""What makers' descriptions hold beside the arms, and arms that are fast, light or without data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.proposing.problem import read_problem
from hybrid_opt.extras.proposing.redundancy import redundancy
from hybrid_opt.extras.simulation.arms import CellSimulation
from symbolic.errors import OutsideError, WorkcellError
from symbolic.read.arms import RobotModelWarning, _warn_left_out
from symbolic.read.cell import load
from symbolic.read.robots import _warn_unjudged, named_robot
from symbolic.records import Workcell
from tests.refusals import refused
from tests.symbolic.cells import RACK
from tests.torso import Torso

WHEEL = """
<link name="wheel"/>
<joint name="wheel_joint" type="{kind}">
  <parent link="foot"/><child link="wheel"/><origin xyz="0.2 0.3 0.1"/><axis xyz="0 1 0"/>{limit}
</joint>
"""


def cell(torso: Torso, folder: Path, **changes: Any) -> Workcell:
    return read_problem(torso.problem(folder, **changes)).workcell()


@pytest.mark.parametrize(
    ("kind", "limit"),
    [
        ("continuous", '<limit velocity="5"/>'),
        ("continuous", ""),
        ("revolute", '<limit lower="-1" upper="1"/>'),
        ("prismatic", ""),
    ],
)
def test_joints_that_no_arm_moves_need_no_limits(kind: str, limit: str, tmp_path: Path) -> None:
    found = cell(Torso(more=WHEEL.format(kind=kind, limit=limit)), tmp_path)
    assert [len(robot.torque_max) for robot in found.robots] == [7, 7]


def test_joints_that_arms_move_need_theirs(tmp_path: Path) -> None:
    text = Torso().urdf()
    limit = '<limit lower="-3.0" upper="3.0" effort="15.0" velocity="2.5"/>'
    assert text.count(limit) == 2
    path = Torso().problem(tmp_path)
    for wanted, told in (
        ('<limit lower="-3.0" upper="3.0" velocity="2.5"/>', r"torque_max: .*joint 5"),
        ("", r"position_lower\[4\]: found 0 rad .*'left_joint_3'"),
    ):
        (tmp_path / "torso.urdf").write_text(text.replace(limit, wanted), encoding="utf-8")
        with pytest.raises(WorkcellError, match=told):
            read_problem(path).workcell()


MIMIC = """
<link name="marker">{inertial}</link>
<joint name="marker_joint" type="revolute">
  <parent link="{parent}"/><child link="marker"/><axis xyz="0 0 1"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/>
  <mimic joint="torso_joint_0" multiplier="-1" offset="0.25"/>
</joint>
"""
INERTIAL = """<inertial><mass value="0.1"/>
<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>"""


@pytest.mark.parametrize("parent", ["chest", "foot"])
def test_empty_links_that_mimic_a_moving_joint_are_left_out_with_a_note(
    parent: str, tmp_path: Path
) -> None:
    """In front of the joint and behind it; each is said once."""
    _warn_left_out.cache_clear()
    torso = Torso(more=MIMIC.format(parent=parent, inertial=""))
    with pytest.warns(RobotModelWarning, match="'marker_joint' .*'torso_joint_0'"):
        found = cell(torso, tmp_path)
    plain = cell(Torso(), tmp_path)
    for robot, other in zip(found.robots, plain.robots, strict=True):
        np.testing.assert_array_equal(robot.position_upper, other.position_upper)


def test_links_with_mass_that_mimic_a_moving_joint_are_refused(tmp_path: Path) -> None:
    torso = Torso(more=MIMIC.format(parent="chest", inertial=INERTIAL))
    with refused(WorkcellError, "workcell", "'marker_joint'", "'torso_joint_0'"):
        cell(torso, tmp_path)


def test_a_torso_may_have_as_many_joints_as_it_likes(tmp_path: Path) -> None:
    """Seven below arms of six: thirteen joints move each flange, seven of them both."""
    axes = ("1 0 0", "0 1 0", "0 1 0", "0 1 0", "1 0 0", "0 0 1", "0 1 0")
    found = cell(Torso(axes), tmp_path)
    assert [len(robot.position_lower) for robot in found.robots] == [13, 13]
    chosen = read_problem(tmp_path / "torso.toml")
    complete = chosen.workcell(redundancy(chosen, found))
    assert [joint.drives for joint in complete.task.redundant] == [(k, k) for k in range(7)]


def test_efforts_of_zero_are_no_torques_until_the_file_says_unknown(tmp_path: Path) -> None:
    torso = Torso(effort=0.0)
    told = r'torque_max: .*joint 2.* torque_max = "unknown"'
    with pytest.raises(WorkcellError, match=told):
        cell(torso, tmp_path)
    _warn_unjudged.cache_clear()
    with pytest.warns(RobotModelWarning, match="'left' .*torque_max"):
        found = cell(torso, tmp_path, robots=[{"torque_max": "unknown"}] * 2)
    for robot in found.robots:
        np.testing.assert_array_equal(robot.torque_max, np.full(7, np.inf))


def test_arms_of_unknown_torques_are_not_simulated() -> None:
    cell = load(RACK)
    unknown = [replace(robot, torque_max=np.full(6, np.inf)) for robot in cell.robots]
    free = replace(cell, robots=(unknown[0], unknown[1]))
    with refused(SimulationError, "unknown-torques", "torque_max"):
        CellSimulation(free)


def test_fast_wrists_and_light_squeezes_are_no_other_units(tmp_path: Path) -> None:
    """200 revolutions a minute; arms that press with 15 N."""
    speed = 200.0 * 2.0 * np.pi / 60.0
    found = cell(Torso(wrist_speed=speed), tmp_path, task={"reference_force": 15.0})
    assert found.robots[0].velocity_max[-1] == pytest.approx(speed)
    assert found.task.reference_force.tolist() == [15.0, 15.0]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"robots": [{"velocity_max": 120.0}, {}]}, " 2.0944 rad/s"),
        ({"robots": [{"velocity_max": 5000.0}, {}]}, " 50 rad/s"),
        ({"task": {"reference_force": 0.5}}, " 4.90332 N"),
        ({"task": {"reference_force": 0.05}}, " 100000 N"),
    ],
)
def test_hints_stand_where_the_other_unit_is_plausible(
    changes: dict[str, Any], told: str, tmp_path: Path
) -> None:
    with pytest.raises(WorkcellError) as error:
        cell(Torso(), tmp_path, **changes)
    lines = str(error.value).splitlines()
    assert any(line.endswith(told) for line in lines), lines


def test_a_file_without_links_is_passed_over() -> None:
    assert named_robot("ur3").path.name == "ur3_robot.urdf"
    assert named_robot("ur5").path.name == "ur5_robot.urdf"
    with refused(OutsideError, "unknown-description"):
        named_robot("ur4")
