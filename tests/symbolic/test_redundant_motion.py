"""Timing and polish functions of arms with redundant joints, against differences and Pinocchio."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.path_motion import path_motion_function
from symbolic.records.task import initial_decision
from symbolic.smooth.places import closure_functions, closure_name
from tests.redundant_cells import free_pandas

SAMPLES = 201


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    return build_cell_model(free_pandas(tmp_path_factory.mktemp("pandas"), "initial = 0.1"))


@pytest.fixture(scope="module")
def motion(model: CellModel) -> dict[str, Array]:
    x = initial_decision(model.workcell.task)
    x[6:] = [0.1, 0.3, 0.6, 0.2, 0.0, -0.3]
    function = path_motion_function(model, SAMPLES)
    return {
        name: np.array(value).T
        for name, value in zip(function.name_out(), function(ca.DM(x)), strict=True)
    }


@pytest.mark.parametrize("arm", [1, 2])
def test_derivatives_of_all_joints_are_those_of_differences(
    motion: dict[str, Array], arm: int
) -> None:
    q = motion[f"q_{arm}"]
    u = np.linspace(0.0, 1.0, SAMPLES)
    first = np.gradient(q, u, axis=0, edge_order=2)
    inner = slice(2, -2)
    np.testing.assert_allclose(motion[f"q_first_{arm}"][inner], first[inner], atol=2e-3)
    second = np.gradient(motion[f"q_first_{arm}"], u, axis=0, edge_order=2)
    np.testing.assert_allclose(motion[f"q_second_{arm}"][inner], second[inner], atol=2e-2)


@pytest.mark.parametrize("arm", [1, 2])
def test_own_torques_are_pinocchios(model: CellModel, motion: dict[str, Array], arm: int) -> None:
    robot = model.robots[arm - 1].model
    data = robot.createData()
    speed, acceleration = 0.7, -0.4
    for k in range(0, SAMPLES, 40):
        q, first, second = (motion[f"{name}_{arm}"][k] for name in ("q", "q_first", "q_second"))
        expected = pin.rnea(robot, data, q, first * speed, second * speed**2 + first * acceleration)
        found = (
            motion[f"torque_by_acceleration_{arm}"][k] * acceleration
            + motion[f"torque_by_speed_{arm}"][k] * speed**2
            + motion[f"torque_at_rest_{arm}"][k]
        )
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("arm", [0, 1])
def test_the_closure_has_exact_derivatives_by_the_extended_pose(model: CellModel, arm: int) -> None:
    functions = closure_functions(model, arm)
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
    # The curvature of one joint along any direction, by the formula of `symbolic.smooth.places`.
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
