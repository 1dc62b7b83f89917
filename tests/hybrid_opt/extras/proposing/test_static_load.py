"""Torques of an arm that holds the box at rest, from the energy of its masses and of the load."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from hybrid_opt.extras.proposing.holding import HoldQuery, find_holds
from hybrid_opt.extras.proposing.kinematics import ArmKinematics
from hybrid_opt.extras.proposing.static_load import StaticLoad
from symbolic.array import Array
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.records.poses import box_placement
from tests.symbolic.read.samples import RACK


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("end", ["start", "goal"])
def test_torques_at_rest_are_the_slope_of_the_energy(arm: int, end: str) -> None:
    """With m g / (2 mu) as normal force, and joints that are weak."""
    cell = load(RACK)
    weak = [replace(robot, torque_max=0.2 * robot.torque_max) for robot in cell.robots]
    cell = replace(cell, robots=(weak[0], weak[1]))
    ends = cell.task.waypoints[0].lower, cell.task.waypoints[-1].lower
    robot, model, contact = cell.robots[arm], arm_model(cell.robots[arm]), cell.contacts[arm]
    kinematics, weight = ArmKinematics(cell, arm), cell.payload.mass * 9.81
    query = HoldQuery(*ends, np.array([0.0, 0.7]), None, starts=96, guides=1)
    holds = find_holds(query, kinematics, np.random.default_rng(1)).holds
    hold = max(holds, key=lambda one: one.spin)
    q, pose = (hold.q_start, ends[0]) if end == "start" else (hold.q_goal, ends[1])
    T_box_joint, data = kinematics.held(hold.spin), model.createData()
    T_joint_pad = np.linalg.inv(T_box_joint) @ contact.T_box_pad
    R_world_box = box_placement(cell.task.orientation, pose)[:3, :3]
    normal = R_world_box @ contact.T_box_pad[:3, 2]
    force = -weight / (2.0 * contact.friction) * normal - [0.0, 0.0, weight / 2.0]

    def energy(q: Array) -> float:
        centre = pin.centerOfMass(model, data, q)
        masses = sum(one.mass for one in list(model.inertias)[1:])
        T_world_pad = robot.T_world_base @ data.oMi[-1].homogeneous @ T_joint_pad
        height = (robot.T_world_base[:3, :3] @ centre)[2]
        return float(9.81 * masses * height - force @ T_world_pad[:3, 3])

    steps = 1e-5 * np.eye(len(q))
    slope = np.array([energy(q + step) - energy(q - step) for step in steps]) / 2e-5
    loaded = StaticLoad(cell, arm)
    assert loaded.checked
    found = loaded.share(pose[None], q[None], T_box_joint)
    np.testing.assert_allclose(found, np.abs(slope / robot.torque_max).max(), rtol=1e-5)


@pytest.mark.parametrize("share", [1.0, np.inf], ids=["strong", "unknown"])
def test_torques_of_strong_arms_and_unknown_ones_are_not_limited(share: float) -> None:
    cell = load(RACK)
    robot = replace(cell.robots[0], torque_max=share * cell.robots[0].torque_max)
    found = StaticLoad(replace(cell, robots=(robot, cell.robots[1])), 0)
    assert not found.checked
    np.testing.assert_array_equal(found.share(np.zeros((2, 6)), np.zeros((2, 6)), np.eye(4)), 0.0)
