"""Start branches of arms, and those of the GoFa by its geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from symbolic.array import Array
from symbolic.cell_model import build_cell_model
from symbolic.errors import WorkcellError
from symbolic.read.arms import reduced_model
from symbolic.read.urdf import read_urdf
from symbolic.records import Robot
from symbolic.robot.branches import inverse_kinematics, start_branches
from symbolic.robot.model import RobotModel, build_robot_model
from tests.robots import GOFA_URDF, robot_record, ur10_urdf
from tests.symbolic.cells import fixed, rack_cell, with_task
from tests.symbolic.read.samples import GOFA
from tests.symbolic.robot.gofa_branches import gofa_branches


@pytest.fixture(scope="module")
def gofa() -> tuple[Robot, RobotModel]:
    model = build_robot_model(robot_record(GOFA_URDF))
    robot = replace(
        robot_record(GOFA_URDF),
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


def test_finds_every_branch_of_random_poses(gofa: tuple[Robot, RobotModel]) -> None:
    robot, model = gofa
    rng = np.random.default_rng(7)
    found_all = 0
    expected_all = 0
    for _ in range(25):
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
    assert expected_all > 25 * 2


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
    workcell = rack_cell()
    model = build_cell_model(workcell)
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
    with pytest.raises(WorkcellError, match=r"task\.start: robot 'left' has no posture") as error:
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
