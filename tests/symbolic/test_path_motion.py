"""The motion of a cell along its path, redundant joints, and what limits its timing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.contact.load import LOAD_OUTPUTS, load_function
from symbolic.limit_coefficients import (
    PATH_OUTPUTS,
    force_functions,
    path_function,
    ratio_functions,
    sample_limits_function,
)
from symbolic.limits import limit_layout
from symbolic.path_motion import path_motion_function
from symbolic.records import Workcell
from symbolic.records.poses import pose_matrix
from symbolic.records.task import initial_decision
from symbolic.smooth.path_points import closure_functions, closure_name
from tests.odd_cells import free_pandas
from tests.symbolic.cells import call, hand_cell, hand_model, with_contacts, with_payload

SAMPLES = 401
TIMING_BARRIER_WEIGHT = np.array([0.0, 0.0, -9.81])


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


@pytest.fixture(scope="module")
def pandas(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    """Two arms with a redundant joint each."""
    return build_cell_model(free_pandas(tmp_path_factory.mktemp("pandas"), "initial = 0.1"))


@pytest.fixture(scope="module", params=["hand", "pandas"])
def moved(request: pytest.FixtureRequest, pandas: CellModel) -> tuple[CellModel, dict[str, Array]]:
    """A cell's model, and its motion."""
    if request.param == "hand":
        return hand_model(hand_cell()), motion()
    x = initial_decision(pandas.workcell.task)
    x[6:] = [0.1, 0.3, 0.6, 0.2, 0.0, -0.3]
    return pandas, call(path_motion_function(pandas, SAMPLES), x)


@pytest.mark.parametrize(
    ("value", "first", "second"),
    [
        ("pose", "pose_first", "pose_second"),
        ("q_1", "q_first_1", "q_second_1"),
        ("q_2", "q_first_2", "q_second_2"),
    ],
)
def test_derivatives_match_finite_differences(
    moved: tuple[CellModel, dict[str, Array]], value: str, first: str, second: str
) -> None:
    m = moved[1]
    # Away from the knots, where the fourth derivative of the path has kinks.
    far = np.abs((np.linspace(0, 1, SAMPLES)[2:-2] * 4 + 0.5) % 1.0 - 0.5) > 0.06
    for order, name in ((1, first), (2, second)):
        exact = m[name][2:-2]
        error = np.abs(differences(m[value], order) - exact)[far]
        assert error.max() < 2e-6 * np.abs(exact).max() * 10 ** (2 * (order - 1)) + 1e-10


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


def test_own_torque_is_affine_with_pinocchios_inverse_dynamics(
    moved: tuple[CellModel, dict[str, Array]],
) -> None:
    cell, m = moved
    rng = np.random.default_rng(3)
    for i, arm in enumerate(cell.robots):
        model = arm.model
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
            - cell.payload.mass * TIMING_BARRIER_WEIGHT
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


PLACES = 21


def uneven() -> Workcell:
    """The hand cell with nothing symmetric about its contacts and its payload."""
    cell = with_payload(hand_cell(), centre_of_mass=np.array([0.004, -0.01, 0.02]))
    return with_contacts(cell, friction=(0.9, 1.1), patch_radius=(0.02, 0.04))


@cache
def outputs() -> tuple[dict[str, Array], dict[str, Array]]:
    """Packed limits and the path's motion of a tilted trajectory."""
    model = hand_model(uneven())
    rng = np.random.default_rng(2)
    x = model.workcell.task.initial.reshape(-1) + 0.05 * rng.uniform(-1.0, 1.0, 18)
    path = call(path_function(model, PLACES), x)
    rows = sample_limits_function(model).map(PLACES)(*[path[name].T for name in PATH_OUTPUTS])
    motion = call(path_motion_function(model, PLACES), x)
    np.testing.assert_allclose(path["q_1"], motion["q_1"], atol=1e-12)
    return {"limits": np.array(rows.T)}, motion


def block(name: str) -> Array:
    layout = limit_layout(uneven())
    start = layout.offsets[name]
    return outputs()[0]["limits"][:, start : start + layout.sizes[name]]


def both(name: str) -> Array:
    motion = outputs()[1]
    return np.concatenate([motion[f"{name}_{i}"] for i in (1, 2)], axis=1)


def limits_of(name: str) -> Array:
    return np.concatenate([getattr(robot, name) for robot in uneven().robots])


def test_speeds_and_accelerations_are_the_paths_over_their_limits() -> None:
    motion, cell = outputs()[1], uneven()
    speed = np.linalg.norm(motion["pose_first"][:, :3], axis=1)
    turn = np.linalg.norm(motion["angular_first"], axis=1)
    np.testing.assert_allclose(
        block("speed"),
        np.column_stack(
            [
                both("q_first") / limits_of("velocity_max"),
                speed / cell.payload.velocity_max,
                turn / cell.payload.angular_velocity_max,
                speed / cell.task.reference_speed,
                turn / cell.task.reference_angular_speed,
            ]
        ),
        atol=1e-10,
    )
    np.testing.assert_allclose(
        block("acceleration"),
        np.hstack([both("q_first"), both("q_second")]) / np.tile(limits_of("acceleration_max"), 2),
        atol=1e-9,
    )
    linear = np.hstack([motion["pose_first"][:, :3], motion["pose_second"][:, :3]])
    angular = np.hstack([motion["angular_first"], motion["angular_second"]])
    cones = np.hstack([linear / cell.payload.acceleration_max, angular / 10.0])
    np.testing.assert_allclose(block("cone"), cones, atol=1e-10)


@pytest.mark.parametrize("allocation", ["paper", "soft-finger"])
def test_torques_and_shifts_are_those_of_the_load_and_the_arms(allocation: str) -> None:
    """The other route: contact forces in the world frame, then each arm's own torques."""
    motion, cell = outputs()[1], uneven()
    cell = replace(cell, task=replace(cell.task, allocation=allocation))
    (forces, _), (ratios, ratio_slopes) = force_functions(cell), ratio_functions(cell)

    def values(row: Array, a: float, w: float) -> tuple[Array, Array, ca.DM]:
        """Ratios, normal forces, and what was solved for them."""
        normal, solved = forces(row[:15], a, w)
        flat = (np.array(part).reshape(-1) for part in (ratios(row, a, w, solved), normal))
        return *flat, solved

    rng = np.random.default_rng(3)
    load = load_function(cell)
    packed = np.hstack([block(name) for name in ("force", "moment", "torque", "wrench")])
    for k in range(PLACES):
        a, w = rng.normal(scale=0.3), rng.uniform(0.0, 0.4)
        found, normal, solved = values(packed[k], a, w)
        rate = motion["pose_first"][k] * np.sqrt(w)
        second = motion["pose_second"][k] * w + motion["pose_first"][k] * a
        loads = dict(zip(LOAD_OUTPUTS, load(motion["pose"][k], rate, second), strict=True))
        torques = []
        for i in (1, 2):
            wrench = motion[f"wrench_torque_{i}"][k].reshape(6, 6)
            own = motion[f"torque_by_acceleration_{i}"][k] * a
            own = own + motion[f"torque_by_speed_{i}"][k] * w + motion[f"torque_at_rest_{i}"][k]
            torques.append(own + wrench @ np.array(loads[f"wrench_{i}"]).reshape(-1))
        shifts = np.array(loads["pressure_shift"]).reshape(-1) / [0.02, 0.04]
        expected = np.concatenate([np.concatenate(torques) / limits_of("torque_max"), shifts])
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(normal, np.array(loads["normal_force"]).reshape(-1), rtol=1e-9)

        sloping = ratio_slopes(packed[k], a, w, solved)
        same, by_a, by_w = (np.array(part).reshape(-1) for part in sloping)
        np.testing.assert_allclose(same, found, atol=1e-14 if allocation == "paper" else 1e-8)
        step = 1e-5
        for slope, da, dw in ((by_a, step, 0.0), (by_w, 0.0, step)):
            ahead = values(packed[k], a + da, w + dw)[0]
            behind = values(packed[k], a - da, w - dw)[0]
            np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * step), atol=2e-5)


@pytest.mark.parametrize("arm", [0, 1])
def test_the_closure_has_exact_derivatives_by_the_extended_pose(
    pandas: CellModel, arm: int
) -> None:
    model, functions = pandas, closure_functions(pandas, arm)
    first, second = (functions[closure_name(arm, order)] for order in ("first", "second"))
    x = initial_decision(model.workcell.task)
    pose = np.concatenate([model.workcell.task.waypoints[0].lower, [0.15, 0.05]])
    assert len(x) == 12
    q, follow, pull = (np.array(value) for value in first(pose, model.start[arm]))
    width = 1e-6
    columns = []
    for k in range(8):
        step = np.eye(8)[k] * width
        ends = [np.array(first(pose + sign * step, q)[0]).ravel() for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * width))
    np.testing.assert_allclose(follow, np.array(columns).T, atol=1e-7)
    # One joint's curvature along any direction, by the formula of `symbolic.smooth.path_points`.
    direction = np.random.default_rng(arm).normal(size=8)
    T = np.vstack([np.eye(8), follow])
    for joint in range(7):
        nu = pull.T @ np.eye(7)[joint]
        hessian = T.T @ np.array(second(pose, q, nu)) @ T
        h = 1e-4
        ends = [
            np.array(first(pose + sign * h * direction, q)[0]).ravel()[joint] for sign in (1, 0, -1)
        ]
        measured = (ends[0] - 2 * ends[1] + ends[2]) / h**2
        assert direction @ hessian @ direction == pytest.approx(measured, rel=1e-3, abs=2e-4)
