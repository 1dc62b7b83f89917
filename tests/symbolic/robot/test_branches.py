"""Start branches of arms, and those of the GoFa by its geometry and by an exact list.

All but joint 6 in closed form, joint 6 by a root search: axes 4 and 5 meet; given q6, that point
and axis 5 are known from the flange. The point fixes q1 (two choices) and q2, q3 (a planar
two-link arm, two choices); axis 4 must then be at right angles to axis 5, one equation in q6.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import brentq

from symbolic.array import Array
from symbolic.cell_model import build_cell_model
from symbolic.errors import WorkcellError
from symbolic.read.arms import reduced_model
from symbolic.read.urdf import read_urdf
from symbolic.records import Robot
from symbolic.records.poses import rotation_from_rpy
from symbolic.robot.branches import inverse_kinematics, start_branches
from symbolic.robot.model import RobotModel, build_robot_model
from tests.machines import robot_record, ur10_urdf
from tests.symbolic.cells import fixed, rack_cell, rack_model, with_task
from tests.symbolic.read.samples import GOFA


@pytest.fixture(scope="module")
def gofa() -> tuple[Robot, RobotModel]:
    model = build_robot_model(robot_record(GOFA))
    robot = replace(
        robot_record(GOFA),
        position_lower=np.array(model.model.lowerPositionLimit),
        position_upper=np.array(model.model.upperPositionLimit),
    )
    return robot, model


def flange(model: RobotModel, q: Array) -> Array:
    """Flange placement (4, 4) by numeric Pinocchio."""
    data = model.model.createData()
    pin.framesForwardKinematics(model.model, data, q)
    return np.array(data.oMf[model.flange_id].homogeneous)


def one_turn(q: Array) -> Array:
    """Rows with every joint in [-pi, pi), sorted, full turns apart merged."""
    wrapped = np.round(np.remainder(np.atleast_2d(q) + np.pi, 2 * np.pi) - np.pi, 5)
    return np.unique(np.where(wrapped == np.round(np.pi, 5), -wrapped, wrapped), axis=0)


POSES = 15


def test_finds_every_branch_of_random_poses(gofa: tuple[Robot, RobotModel]) -> None:
    robot, model = gofa
    rng = np.random.default_rng(7)
    found_all = 0
    expected_all = 0
    for _ in range(POSES):
        q = rng.uniform(robot.position_lower, robot.position_upper)
        target = flange(model, q)
        found = inverse_kinematics(robot, model, target)
        for row in found:
            np.testing.assert_allclose(flange(model, row), target, atol=1e-9)
            assert np.all((row >= robot.position_lower) & (row <= robot.position_upper))
        ours = one_turn(found)
        exact = one_turn(gofa_branches(robot, target))
        missing = [
            row
            for row in exact
            if not any(np.allclose(np.exp(1j * row), np.exp(1j * o), atol=1e-3) for o in ours)
        ]
        found_all += len(exact) - len(missing)
        expected_all += len(exact)
        assert any(np.allclose(np.exp(1j * q), np.exp(1j * o), atol=1e-3) for o in ours)
    # Near-singular poses have branches so close together that a search may merge them.
    assert found_all >= 0.99 * expected_all
    assert expected_all > 2 * POSES


def test_finds_the_ur10_posture_it_came_from() -> None:
    robot = robot_record(ur10_urdf())
    model = build_robot_model(robot)
    rng = np.random.default_rng(3)
    for _ in range(5):
        q = rng.uniform(-np.pi, np.pi, 6)
        found = inverse_kinematics(robot, model, flange(model, q))
        assert any(np.allclose(np.exp(1j * row), np.exp(1j * q), atol=1e-5) for row in found)


def test_an_unreachable_pose_has_no_branch(gofa: tuple[Robot, RobotModel]) -> None:
    robot, model = gofa
    target = np.eye(4)
    target[:3, 3] = [2.5, 0.0, 0.5]
    assert inverse_kinematics(robot, model, target).shape == (0, 6)


def test_start_branches_are_ranked_and_hold_the_start() -> None:
    workcell, model = rack_cell(), rack_model()
    for arm in (0, 1):
        ranks = [branch.rank for branch in model.branches[arm]]
        assert ranks == sorted(ranks)
        best = model.branches[arm][0]
        assert best.kept == workcell.task.samples
        assert best.path.shape == (workcell.task.samples, 6)
        np.testing.assert_allclose(best.path[0], best.q, atol=1e-6)
        # Without clearances the ranking may differ, the set of branches may not.
        bare = start_branches(workcell, arm, model.robots[arm])
        assert len(bare) == len(model.branches[arm])


def test_a_start_out_of_reach_is_told_for_each_robot() -> None:
    cell = rack_cell()
    far = fixed([-0.9, 0.0, 1.9, 0.0, 0.0, 0.0])
    workcell = with_task(cell, waypoints=(far, *cell.task.waypoints[1:]))
    with pytest.raises(WorkcellError, match=r"task\.start: robot 'left'") as error:
        build_cell_model(workcell)
    assert len(error.value.problems) == 2


# ABB's working-range positions: joint angles [deg] -> centre of the flange [m].
FLANGE_POSITIONS = [
    ((0, 0, 0, 0, 0, 0), (0.635, 0, 1.235)),
    ((0, 0, -78.4, 0, 26.7, 0), (0, 0, 1.719)),
    ((0, 90, -78.4, 0, 26.7, 0), (1.381, 0, 0.338)),
    ((0, 180, -78.4, 0, 26.7, 0), (0, 0, -1.043)),
    ((0, -90, -78.4, 0, 26.7, 0), (-1.381, 0, 0.338)),
    ((0, 180, 11.6, 0, 26.7, 0), (-0.674, 0, -0.369)),
    ((0, 180, 85, 0, 26.7, 0), (-0.193, 0, 0.277)),
    ((0, 180, -168.4, 0, 26.7, 0), (0.674, 0, -0.369)),
    ((0, 180, -225, 0, 26.7, 0), (0.371, 0, 0.194)),
]
STRETCHED = np.radians([0, 90, -78.4, 0, 26.7, 0])


@pytest.fixture(scope="module")
def model() -> pin.Model:
    return reduced_model(read_urdf(GOFA))


def flange_pose(model: pin.Model, q: np.ndarray) -> pin.SE3:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId("tool0")]


@pytest.mark.parametrize(("degrees", "position"), FLANGE_POSITIONS)
def test_flange_positions(
    model: pin.Model, degrees: tuple[float, ...], position: tuple[float, ...]
) -> None:
    # The published angles are rounded to 0.1 degrees, hence 1 mm per coordinate.
    found = flange_pose(model, np.radians(degrees)).translation
    np.testing.assert_allclose(found, position, atol=1e-3)


def test_flange_points_forward_at_zero(model: pin.Model) -> None:
    rotation = flange_pose(model, np.zeros(6)).rotation
    np.testing.assert_allclose(rotation[:, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=1e-12)


def test_limits(model: pin.Model) -> None:
    np.testing.assert_allclose(
        np.degrees(model.lowerPositionLimit), [-270, -180, -225, -180, -180, -270], atol=1e-9
    )
    np.testing.assert_allclose(
        np.degrees(model.upperPositionLimit), [270, 180, 85, 180, 180, 270], atol=1e-9
    )
    np.testing.assert_allclose(
        np.degrees(model.velocityLimit), [120, 120, 125, 200, 200, 200], atol=1e-9
    )
    np.testing.assert_allclose(model.effortLimit, [390, 400, 160, 60, 60, 60])


def test_mass_is_the_robots(model: pin.Model) -> None:
    assert sum(inertia.mass for inertia in model.inertias) == pytest.approx(48.0, abs=0.01)


def test_inertias_are_physical(model: pin.Model) -> None:
    for joint in range(1, model.njoints):
        moments = np.linalg.eigvalsh(model.inertias[joint].inertia)
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1]


def test_gravity_torque_at_full_stretch_with_payload(model: pin.Model) -> None:
    data = model.createData()
    gravity = pin.computeGeneralizedGravity(model, data, STRETCHED)
    jacobian = pin.computeFrameJacobian(
        model, data, STRETCHED, model.getFrameId("tool0"), pin.LOCAL_WORLD_ALIGNED
    )
    torque = np.abs(gravity + jacobian[:3].T @ [0, 0, 12 * 9.81])
    np.testing.assert_allclose(torque[[1, 2, 4]], [367, 126, 16], atol=0.5)
    assert np.all(torque < model.effortLimit)


def test_forearm_and_upper_arm_stand_on_opposite_sides(model: pin.Model) -> None:
    geometry = pin.buildGeomFromUrdf(model, str(GOFA), pin.GeometryType.COLLISION)
    sides = {g.name: g.placement.translation[1] for g in geometry.geometryObjects}
    assert sides["link_2_0"] == pytest.approx(-0.155)
    assert sides["link_4_2"] == pytest.approx(0.09765)


SHOULDER, UPPER_ARM, OFFSET, FOREARM = 0.338, 0.707, 0.110, 0.534
WRIST = np.array([0.101, 0.0, 0.080])
GRID = 1440


def gofa_branches(robot: Robot, T_root_flange: Array) -> Array:
    """(m, 6) joint positions within [-pi, pi] and the joint limits' turns [rad]."""
    flange_to_link = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    R_6, p_6 = T_root_flange[:3, :3] @ flange_to_link, T_root_flange[:3, 3]
    found = []
    grid = np.linspace(-np.pi, np.pi, GRID + 1)
    for back, elbow in product((False, True), (1.0, -1.0)):

        def angle(q6: Any, back: bool = back, elbow: float = elbow) -> Any:
            _, _, _, axis_4, axis_5 = _first_three(R_6, p_6, q6, back, elbow)
            return np.einsum("...k,...k->...", axis_4, axis_5)

        values = angle(grid)
        for left, right, a, b in zip(grid, grid[1:], values, values[1:], strict=False):
            if np.isfinite(a) and np.isfinite(b) and a * b <= 0.0 and abs(a - b) < 0.5:
                root = float(brentq(angle, left, right, xtol=1e-13))
                found.append(_posture(R_6, p_6, root, back, elbow))
    return np.array([q for q in found if _possible(robot, q)]).reshape(-1, 6)


def _rot_x(angle: Any) -> Array:
    return rotation_from_rpy(np.stack([angle, 0.0 * angle, 0.0 * angle], axis=-1))


def _first_three(R_6: Array, p_6: Array, q6: Any, back: bool, elbow: float) -> tuple[Any, ...]:
    """q1, q2, q3, axis 4 and axis 5 of values q6 (...); NaN where the point is out of the arm's
    reach."""
    R_5 = R_6 @ _rot_x(-q6)
    point = p_6 - R_5 @ WRIST
    q1 = np.arctan2(point[..., 1], point[..., 0]) + (np.pi if back else 0.0)
    radius = np.cos(q1) * point[..., 0] + np.sin(q1) * point[..., 1]
    height = point[..., 2] - SHOULDER
    length = np.hypot(FOREARM, OFFSET)
    cosine = (radius**2 + height**2 - UPPER_ARM**2 - length**2) / (2.0 * UPPER_ARM * length)
    bend = elbow * np.arccos(np.where(np.abs(cosine) > 1.0, np.nan, cosine))
    # Angles from the vertical, positive towards the front.
    q2 = np.arctan2(radius, height) - np.arctan2(
        length * np.sin(bend), UPPER_ARM + length * np.cos(bend)
    )
    q3 = bend - np.arctan2(FOREARM, OFFSET)
    phi = q2 + q3
    axis_4 = np.stack([np.cos(q1) * np.cos(phi), np.sin(q1) * np.cos(phi), -np.sin(phi)], axis=-1)
    return q1, q2, q3, axis_4, R_5[..., 1]


def _posture(R_6: Array, p_6: Array, q6: float, back: bool, elbow: float) -> Array:
    q1, q2, q3, axis_4, axis_5 = _first_three(R_6, p_6, q6, back, elbow)
    side = np.array([-np.sin(q1), np.cos(q1), 0.0])
    R_3 = np.column_stack([axis_4, side, np.cross(axis_4, side)])
    local = R_3.T @ axis_5
    q4 = np.arctan2(local[2], local[1])
    R_45 = (R_3 @ _rot_x(q4)).T @ R_6 @ _rot_x(-q6)
    q5 = np.arctan2(R_45[0, 2], R_45[0, 0])
    return np.array([q1, q2, q3, q4, q5, q6])


def _possible(robot: Robot, q: Array) -> bool:
    """Whether some full turn of every joint lies within its limits."""
    lowest = robot.position_lower + np.remainder(q - robot.position_lower, 2 * np.pi)
    return bool(np.all(lowest <= robot.position_upper))
