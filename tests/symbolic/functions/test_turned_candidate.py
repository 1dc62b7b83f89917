"""A box that is turned over, by rotation vectors: against the plain reference, against roll, pitch
and yaw where these can say the same, and the path's derivatives against differences."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from studies.research.plain.candidate import PlainEvaluator
from symbolic.array import Array
from symbolic.functions import candidate_function
from symbolic.path_motion import path_motion_function
from symbolic.records.cell import Workcell
from symbolic.records.poses import box_rotation
from symbolic.records.task import TimeLaw
from symbolic.smooth.places import closure_functions, closure_name
from tests.symbolic.cells import hand_model, start_posture
from tests.turned_cells import pitched_cell, random_x, turned_cell


def outputs(function: ca.Function, x: Array) -> dict[str, Array]:
    return {
        name: np.array(value).T
        for name, value in zip(function.name_out(), function(ca.DM(x)), strict=True)
    }


def candidate(cell: Workcell, x: Array) -> dict[str, Array]:
    return outputs(candidate_function(hand_model(cell)), x)


@pytest.mark.parametrize("time_law", ["constant", "ramped"])
def test_candidates_are_those_of_the_plain_reference(time_law: TimeLaw) -> None:
    cell = turned_cell(time_law)
    plain = PlainEvaluator(cell, start_posture(cell))
    for seed in (1, 2):
        x = random_x(cell, seed)
        found, expected = candidate(cell, x), plain(x).outputs
        assert not expected["violation"].any(), "the arms follow the box to its end"
        for name, values in expected.items():
            np.testing.assert_allclose(
                np.squeeze(found[name]), np.squeeze(values), rtol=1e-8, atol=1e-8, err_msg=name
            )


def test_about_one_axis_it_is_the_carry_of_roll_pitch_yaw() -> None:
    cell, other = turned_cell(about_one_axis=True), pitched_cell()
    x = random_x(cell, 2)
    same = x - (cell.task.lower - other.task.lower)
    found, expected = candidate(cell, x), candidate(other, same)
    for name in set(expected) - {"pose"}:
        np.testing.assert_allclose(found[name], expected[name], atol=1e-8, err_msg=name)
    np.testing.assert_allclose(
        box_rotation(cell.task.orientation, found["pose"]),
        box_rotation(other.task.orientation, expected["pose"]),
        atol=1e-12,
    )


def test_derivatives_along_the_path_are_those_of_differences() -> None:
    cell, n = turned_cell(), 401
    motion = outputs(path_motion_function(hand_model(cell), n), random_x(cell, 3))
    u = np.linspace(0.0, 1.0, n)
    turned = motion["rotation"].reshape(n, 3, 3)
    steps = Rotation.from_matrix(turned[2:] @ np.swapaxes(turned[:-2], 1, 2)).as_rotvec()
    np.testing.assert_allclose(steps * (n - 1) / 2.0, motion["angular_first"][1:-1], atol=2e-3)
    inner = slice(2, -2)
    for first, second in (("angular_first", "angular_second"), ("q_first_1", "q_second_1")):
        slopes = np.gradient(motion[first], u, axis=0, edge_order=2)
        np.testing.assert_allclose(motion[second][inner], slopes[inner], atol=0.02)
    slopes = np.gradient(motion["q_2"], u, axis=0, edge_order=2)
    np.testing.assert_allclose(motion["q_first_2"][inner], slopes[inner], atol=6e-3)


@pytest.mark.parametrize("arm", [0, 1])
def test_joints_follow_rotation_vectors_with_exact_derivatives(arm: int) -> None:
    model = hand_model(turned_cell())
    functions = closure_functions(model, arm)
    first, second = (functions[closure_name(arm, order)] for order in ("first", "second"))
    away = np.array([-0.1, 0.0, 0.02, 0.05, 0.3, -0.05])
    pose = model.workcell.task.waypoints[0].lower + away
    q, follow, pull = (np.array(value) for value in first(pose, model.start[arm]))

    def joints(at: Array) -> Array:
        return np.array(first(at, q)[0]).ravel()

    width = 1e-6
    slopes = [(joints(pose + d) - joints(pose - d)) / (2 * width) for d in width * np.eye(6)]
    np.testing.assert_allclose(follow, np.array(slopes).T, atol=1e-7)
    direction = np.random.default_rng(arm).normal(size=6)
    T, h = np.vstack([np.eye(6), follow]), 1e-4
    ends = [joints(pose + sign * h * direction) for sign in (1, 0, -1)]
    measured = (ends[0] - 2 * ends[1] + ends[2]) / h**2
    for joint in range(6):
        hessian = T.T @ np.array(second(pose, q, pull.T @ np.eye(6)[joint])) @ T
        curvature = direction @ hessian @ direction
        assert curvature == pytest.approx(measured[joint], rel=1e-3, abs=1e-3)
