"""Whole jobs of the other cells that ship: over a wall, two Pandas with redundant elbows, and
pads of every kind."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.extras.bundles import TARGETS, BundleOptions, export
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.targets import target_for
from hybrid_opt.job.plan import JobModel
from hybrid_opt.robust.force import subsample
from hybrid_opt.robust.squeeze import largest_commanded
from hybrid_opt.timing.jerk import driven_timing, without_jumps
from hybrid_opt.timing.records import JerkLimits
from symbolic.errors import SettingsError
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.bundles.bundles import driven
from tests.hybrid_opt.job.jobs import planned
from tests.symbolic.cells import RACK

SHIPPED = sorted(path.stem for path in RACK.parent.glob("*.toml"))
FREE = ("data", "torque")
"""Targets that are nobody's own."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_every_cell_that_ships_has_a_job(name: str) -> None:
    """With the forces that a recommendation knows sooner."""
    cell = shipped(name).drivable()
    timing = driven_timing(cell.timing_model, cell.initial)
    model = JobModel(cell.compiled, cell.timing_model)
    job = model.plan(timing)
    assert all(phase.certificate.is_free for phase in job.phases)
    carry, doubt = timing.driven, cell.workcell.uncertainty
    rows, motion = subsample(carry)
    sooner = largest_commanded(cell.workcell, motion, carry.normal_force[rows], doubt, 0)
    forces = job.phase("carry").force.normal.max(axis=0)
    np.testing.assert_allclose(sooner, forces, rtol=0.01)


def test_pads_that_do_not_face_one_another_keep_limits_on_jerk() -> None:
    shipping = shipped("fork").drivable()
    first, second = (
        replace(robot, jerk_max=np.full(6, 50.0)) for robot in shipping.workcell.robots
    )
    cell = Cell(replace(shipping.workcell, robots=(first, second)), DRIVABLE_OBJECTIVES)
    timing = driven_timing(cell.timing_model, cell.initial)
    jerk = np.diff(timing.driven.stack_arms("q_second"), axis=0)
    jerk /= np.diff(timing.driven.time)[:, None]
    assert 45.0 < np.abs(jerk).max() <= 50.0 * 1.005
    jerk_limits = JerkLimits.from_workcell(cell.workcell)
    assert without_jumps(cell.timing_model, timing, jerk_limits) is timing, "as jobs drive it"


def test_bundles_hold_every_joint(tmp_path: Path) -> None:
    job = planned("pandas")
    joints = sum(map(len, job.joint_names))
    for target in FREE:
        assert export(job, target, tmp_path, options=BundleOptions(step=0.1))[0].exists()
    document = prepared(job, "data", BundleOptions(step=0.1)).document
    assert len({n for robot in document["robots"] for n in robot["ros_joints"]}) == joints
    for robot in document["robots"]:
        for name in ("position", "velocity", "effort_with_gravity", "hold_effort_with_gravity"):
            assert {len(row) for row in robot[name]} == {joints // 2}


def test_a_seventh_axis_is_an_external_one_to_rapid() -> None:
    """ABB counts the axes of a YuMi 1, 2, 7, 3, 4, 5, 6 along its chain."""
    job, target = driven(planned("pandas")), TARGETS["abb-egm"]
    with pytest.raises(SettingsError, match=r"panda\.urdf.* ABB"):
        target.refuse(job, "abb-egm", any_arm=False)
    target.refuse(job, "abb-egm", any_arm=True)
    sheet = prepared(job, "abb-egm", BundleOptions(step=0.02, any_arm=True))
    files = target.files(sheet)
    names = ("T_ROB_L/CarryEgm1.mod", "T_ROB_R/CarryEgm2.mod")
    assert set(names) < set(files)
    for arm, name in enumerate(names):
        text = str(files[name])
        (first,) = re.findall(r"jointtarget carryFirst := (\S+);", text)
        robot, external = map(np.array, json.loads(first))
        degrees = np.rad2deg(sheet.sampled.arm(arm, sheet.sampled.q))
        np.testing.assert_allclose(robot, degrees[0, [0, 1, 3, 4, 5, 6]], atol=1e-6)
        np.testing.assert_allclose(external, [degrees[0, 2], *[9e9] * 5], atol=1e-6)
        check = text.split("PROC CarryCheckStart")[1]
        assert len(re.findall(r"Abs\(here\.", check)) == 7
        assert "here.extax.eax_a" in check
    with pytest.raises(SettingsError, match=r"7 .*ur-script.* 6"):
        TARGETS["ur-script"].refuse(job, "ur-script", any_arm=True)


def test_franka_takes_the_pandas() -> None:
    """Called as franka_ros2 calls them."""
    job = driven(planned("pandas"))
    north, south = (tuple(n.replace("panda", "fr3") for n in own) for own in job.joint_names)
    job = replace(job, joint_names=(north, south))
    target = target_for("torque", job.workcell)
    target.refuse(job, "torque", any_arm=False)
    sheet = prepared(job, "torque", BundleOptions(step=0.05))
    files = target.files(sheet)
    config = json.loads(files["config/cell.json"])
    arguments = [each["arguments"] for each in config["launch"]]
    assert [each["robot_type"] for each in arguments] == ["fr3", "fr3"]
    for arm, name in enumerate(("north", "south")):
        # franka_description puts an underscore behind the prefix.
        assert arguments[arm]["arm_prefix"] == name
        controllers = yaml.safe_load(files[f"config/controllers_{arm + 1}.yaml"])["/**"]
        known = controllers["carry_controller"]["ros__parameters"]
        assert known["command_interfaces"] == ["effort"]
        assert list(known["gains"]) == known["joints"] == sheet.ros_joints(arm)
        assert known["joints"][0] == f"{name}_fr3_joint1"
        state = controllers["franka_robot_state_broadcaster"]["ros__parameters"]
        assert state == {"robot_type": "fr3", "arm_prefix": name}
