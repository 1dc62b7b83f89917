"""Arms read from URDF: conventions, derivatives, and gravity on a tilted base."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from symbolic.array import Array
from symbolic.errors import RobotModelError
from symbolic.robot.model import RobotModel, build_robot_model
from tests.robots import GOFA_URDF, robot_record, ur10_urdf

angles = st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6).map(np.array)
rates = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)


@pytest.fixture(scope="module", params=["gofa12", "ur10"])
def urdf(request: pytest.FixtureRequest) -> Path:
    return GOFA_URDF if request.param == "gofa12" else ur10_urdf()


@pytest.fixture(scope="module")
def arm(urdf: Path) -> RobotModel:
    return build_robot_model(robot_record(urdf))


@pytest.fixture(scope="module")
def gofa() -> RobotModel:
    return build_robot_model(robot_record(GOFA_URDF))


def flange_pose(arm: RobotModel, q: Array) -> tuple[Array, Array]:
    rotation, position = arm.placement(q)
    return np.array(rotation), np.array(position)[:, 0]


@given(q=angles)
def test_jacobian_is_the_derivative_of_the_placement(arm: RobotModel, q: Array) -> None:
    step = 1e-6
    jacobian = np.array(arm.jacobian(q))
    rotation, _ = flange_pose(arm, q)
    for joint in range(6):
        ahead = flange_pose(arm, q + step * np.eye(6)[joint])
        behind = flange_pose(arm, q - step * np.eye(6)[joint])
        linear = (ahead[1] - behind[1]) / (2 * step)
        spin = (ahead[0] - behind[0]) / (2 * step) @ rotation.T
        angular = [spin[2, 1], spin[0, 2], spin[1, 0]]
        assert_allclose(jacobian[:, joint], [*linear, *angular], rtol=0, atol=1e-8)


@given(q=angles, v=rates)
def test_drift_is_the_rate_of_the_jacobian(arm: RobotModel, q: Array, v: Array) -> None:
    step = 1e-6
    change = np.array(arm.jacobian(q + step * v)) - np.array(arm.jacobian(q - step * v))
    drift = np.array(arm.drift(q, v))[:, 0]
    assert_allclose(drift, change / (2 * step) @ v, rtol=0, atol=1e-6)


@given(q=angles, v=rates, a=rates, roll=st.floats(-np.pi, np.pi), pitch=st.floats(-1.5, 1.5))
def test_torque_on_a_tilted_base(q: Array, v: Array, a: Array, roll: float, pitch: float) -> None:
    """The same arm, hung in Pinocchio onto a tilted fixed joint under upright gravity."""
    T_world_base = np.eye(4)
    T_world_base[:3, :3] = pin.rpy.rpyToMatrix(roll, pitch, 0.3)
    T_world_base[:3, 3] = 1.0, -2.0, 0.5
    arm = build_robot_model(robot_record(GOFA_URDF, T_world_base))
    upright = build_robot_model(robot_record(GOFA_URDF)).model
    tilted = upright.copy()
    tilted.jointPlacements[1] = pin.SE3(T_world_base) * upright.jointPlacements[1]
    expected = pin.rnea(tilted, tilted.createData(), q, v, a)
    torque = np.array(arm.inverse_dynamics(q, v, a))[:, 0]
    assert_allclose(torque, expected, rtol=0, atol=1e-10)


def test_locked_joints_leave_other_than_six() -> None:
    robot = replace(robot_record(GOFA_URDF), locked_joints=(("joint_6", 0.0),))
    with pytest.raises(RobotModelError, match="gofa12"):
        build_robot_model(robot)


def test_unknown_flange() -> None:
    robot = replace(robot_record(GOFA_URDF), flange="tool1")
    with pytest.raises(RobotModelError, match=r"'tool1'.*'tool0'"):
        build_robot_model(robot)


def test_missing_urdf() -> None:
    with pytest.raises(RobotModelError, match=r"absent\.urdf"):
        build_robot_model(robot_record(Path("absent.urdf")))
