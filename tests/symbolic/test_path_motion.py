"""The geometry along the path against finite differences, Pinocchio and the timed load."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from symbolic.array import Array
from symbolic.contact.load import LOAD_OUTPUTS, load_function
from symbolic.path_motion import path_motion_function
from symbolic.records.poses import inverse, pose_matrix
from tests.symbolic.cells import call, hand_cell, hand_model, with_payload

SAMPLES = 401
WEIGHT = np.array([0.0, 0.0, -9.81])


@cache
def motion(centre: tuple[float, float, float] = (0.02, -0.01, 0.03)) -> dict[str, Array]:
    cell = with_payload(hand_cell(), centre_of_mass=np.array(centre))
    x = cell.task.initial.copy()
    x[:, 3:] = [[0.1, -0.05, 0.08], [-0.06, 0.1, 0.02], [0.03, 0.05, -0.1]]
    return call(path_motion_function(hand_model(cell), SAMPLES), x.reshape(-1))


def differences(values: Array, order: int) -> Array:
    """Central differences of fourth order by u, ends left out."""
    h = 1.0 / (SAMPLES - 1)
    a, b, c, d, e = (values[k : len(values) - 4 + k] for k in range(5))
    if order == 1:
        return (a - 8.0 * b + 8.0 * d - e) / (12.0 * h)
    return (-a + 16.0 * b - 30.0 * c + 16.0 * d - e) / (12.0 * h**2)


@pytest.mark.parametrize(
    ("value", "first", "second"),
    [
        ("pose", "pose_first", "pose_second"),
        ("q_1", "q_first_1", "q_second_1"),
        ("q_2", "q_first_2", "q_second_2"),
    ],
)
def test_derivatives_match_finite_differences(value: str, first: str, second: str) -> None:
    m = motion()
    # Away from the knots, where the fourth derivative of the path has kinks.
    far = np.abs((np.linspace(0, 1, SAMPLES)[2:-2] * 4 + 0.5) % 1.0 - 0.5) > 0.06
    for order, name in ((1, first), (2, second)):
        exact = m[name][2:-2]
        error = np.abs(differences(m[value], order) - exact)[far]
        assert error.max() < 2e-6 * np.abs(exact).max() * 10 ** (2 * (order - 1))


def test_both_arms_stay_on_the_box() -> None:
    cell, m = hand_cell(), motion()
    for i, robot in enumerate(cell.robots):
        model = pin.buildModelFromUrdf(str(robot.urdf))
        data = model.createData()
        flange = model.getFrameId(robot.flange)
        for k in range(0, SAMPLES, 40):
            pin.framesForwardKinematics(model, data, m[f"q_{i + 1}"][k])
            T_world_pad = robot.T_world_base @ data.oMf[flange].homogeneous @ robot.T_flange_pad
            T_world_box = pose_matrix(m["pose"][k, :3], m["pose"][k, 3:])
            wanted = T_world_box @ cell.contacts[i].T_box_pad
            np.testing.assert_allclose(T_world_pad, wanted, atol=1e-9)
    assert not m["lost_1"].any()
    assert not m["lost_2"].any()


def test_own_torque_is_affine_with_pinocchios_inverse_dynamics() -> None:
    cell, m = hand_cell(), motion()
    rng = np.random.default_rng(3)
    for i, robot in enumerate(cell.robots):
        model = pin.buildModelFromUrdf(str(robot.urdf))
        data = model.createData()
        for k in rng.integers(0, SAMPLES, 20):
            speed, acceleration = rng.uniform(0.0, 2.0), rng.uniform(-3.0, 3.0)
            q, first, second = (m[f"{n}_{i + 1}"][k] for n in ("q", "q_first", "q_second"))
            v, a = first * speed, second * speed**2 + first * acceleration
            affine = (
                m[f"torque_by_acceleration_{i + 1}"][k] * acceleration
                + m[f"torque_by_speed_{i + 1}"][k] * speed**2
                + m[f"torque_at_rest_{i + 1}"][k]
            )
            np.testing.assert_allclose(affine, pin.rnea(model, data, q, v, a), atol=1e-8)


def test_wrench_torque_is_the_transposed_contact_jacobian() -> None:
    cell, m = hand_cell(), motion()
    rng = np.random.default_rng(4)
    for i, robot in enumerate(cell.robots):
        model = pin.buildModelFromUrdf(str(robot.urdf))
        data = model.createData()
        flange = model.getFrameId(robot.flange)
        T_flange_contact = robot.T_flange_pad
        for k in rng.integers(0, SAMPLES, 10):
            q, wrench = m[f"q_{i + 1}"][k], rng.normal(size=6)
            jacobian = pin.computeFrameJacobian(
                model, data, q, flange, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            )
            pin.framesForwardKinematics(model, data, q)
            R = robot.T_world_base[:3, :3]
            lever = data.oMf[flange].rotation @ T_flange_contact[:3, 3]
            force, moment = R.T @ wrench[:3], R.T @ wrench[3:]
            at_flange = np.concatenate([force, moment + np.cross(lever, force)])
            matrix = m[f"wrench_torque_{i + 1}"][k].reshape(6, 6)
            np.testing.assert_allclose(matrix @ wrench, jacobian.T @ at_flange, atol=1e-9)
            assert np.allclose(
                inverse(robot.T_world_base)[:3, :3], R.T
            )  # the root's axes, as Pinocchio sees them


def test_affine_force_and_moment_agree_with_the_timed_load() -> None:
    centre = (0.02, -0.01, 0.03)
    cell, m = with_payload(hand_cell(), centre_of_mass=np.array(centre)), motion(centre)
    load = load_function(cell)
    rng = np.random.default_rng(5)
    for k in rng.integers(0, SAMPLES, 30):
        speed, acceleration = rng.uniform(0.0, 2.0), rng.uniform(-3.0, 3.0)
        rate = m["pose_first"][k] * speed
        second = m["pose_second"][k] * speed**2 + m["pose_first"][k] * acceleration
        values = dict(zip(LOAD_OUTPUTS, load(m["pose"][k], rate, second), strict=True))
        total = np.array(values["contact_force"]).reshape(2, 3).sum(axis=0)
        force = (
            m["force_by_acceleration"][k] * acceleration
            + m["force_by_speed"][k] * speed**2
            - cell.payload.mass * WEIGHT
        )
        np.testing.assert_allclose(force, total, atol=1e-8)
        moment = m["moment_by_acceleration"][k] * acceleration + m["moment_by_speed"][k] * speed**2
        np.testing.assert_allclose(
            moment, np.array(values["required_moment"]).reshape(-1), atol=1e-9
        )
        np.testing.assert_allclose(
            m["angular_first"][k] * acceleration + m["angular_second"][k] * speed**2,
            np.array(values["angular_acceleration"]).reshape(-1),
            atol=1e-9,
        )


def test_rotation_and_normal_belong_to_the_pose() -> None:
    cell, m = hand_cell(), motion()
    for k in (0, 77, 200, 400):
        R = m["rotation"][k].reshape(3, 3)
        np.testing.assert_allclose(R, pose_matrix([0, 0, 0], m["pose"][k, 3:])[:3, :3], atol=1e-12)
        np.testing.assert_allclose(m["normal"][k], R @ cell.contacts[0].T_box_pad[:3, 2])
