"""One arm: its model against Pinocchio's numbers, and following a path."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from studies.research.plain.arm import PlainArm
from studies.research.plain.motion import rotation
from symbolic.array import Array
from symbolic.errors import RobotModelError
from symbolic.robot.arm import (
    CHEAP_STEPS,
    MAX_JOINT_STEP,
    NEWTON_STEPS,
    REACH_TOLERANCE,
    block_step,
    follow_function,
    joint_torque,
    newton_step,
    pose_error,
    track_function,
)
from symbolic.robot.model import RobotModel, build_robot_model
from tests.robots import GOFA_URDF, robot_record, ur10_urdf
from tests.symbolic.cells import call, gofa_model, hand_cell, start_posture

CELL = hand_cell()
ARMS = tuple(PlainArm(r, c) for r, c in zip(CELL.robots, CELL.contacts, strict=True))

_q = ca.SX.sym("q", 6)
_R, _p = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3)


def step_function() -> ca.Function:
    model = gofa_model()
    result = _q
    for _ in range(NEWTON_STEPS):
        result = newton_step(model, result, _R, _p)
    _, residual = pose_error(_R, _p, *model.placement(result))
    return ca.Function("step", [_q, _R, _p], [result, residual])


def box_pose(arm: PlainArm, q: Array) -> Array:
    """Box pose (6,) whose contact the pad of an arm is at."""
    world = (
        pin.SE3(arm.robot.T_world_base)
        * arm.place(q)
        * pin.SE3(arm.robot.T_flange_pad)
        * pin.SE3(arm.contact.T_box_pad).inverse()
    )
    return np.concatenate([world.translation, Rotation.from_matrix(world.rotation).as_euler("xyz")])


def random_posture(rng: np.random.Generator, margin: float = 0.2) -> Array:
    robot = CELL.robots[0]
    return rng.uniform(robot.position_lower + margin, robot.position_upper - margin)


@given(axis=st.integers(0, 2), angle=st.floats(-np.pi, np.pi), shift=st.floats(-1.0, 1.0))
def test_residual_vanishes_for_equal_placements_only(axis: int, angle: float, shift: float) -> None:
    """In particular not for half a turn, where the sine of the error angle vanishes."""
    R = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    right, residual = pose_error(ca.DM(R), ca.DM([shift, 0, 0]), ca.DM(np.eye(3)), ca.DM([0, 0, 0]))
    expected = np.hypot(shift, 2 * np.sin(angle / 2))
    assert float(residual) == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(np.array(right)[3:, 0], np.sin(angle) * np.eye(3)[axis], atol=1e-12)


def test_newton_converges_quadratically() -> None:
    rng = np.random.default_rng(3)
    model = gofa_model()
    once = ca.Function("once", [_q, _R, _p], [newton_step(model, _q, _R, _p)])
    q = np.array([0.3, -0.6, 0.4, 0.5, 1.0, 0.2])
    target = ARMS[0].place(q).copy()
    guess, errors = q + 0.02 * rng.normal(size=6), []
    for _ in range(5):
        errors.append(np.abs(guess - q).max())
        guess = np.array(once(guess, target.rotation, target.translation))[:, 0]
    assert errors[4] < 1e-12
    for before, after in pairwise(errors):
        assert after < 5.0 * before**2 + 1e-13


def test_a_singular_posture_keeps_its_joints_and_shows_its_residual() -> None:
    """Stretched arm and aligned wrist: the Jacobian has no inverse."""
    q = np.zeros(6)
    q[2] = -np.arctan2(0.534, 0.110)
    target = ARMS[0].place(q).copy()
    found, residual = step_function()(
        q, target.rotation, target.translation + np.array([0.1, 0.0, 0.3])
    )
    assert np.all(np.isfinite(found.full()))
    assert float(residual) > 0.01


def test_ten_thousand_random_poses_are_never_wrongly_reported_as_reached() -> None:
    """Poses of random postures, Newton from a disturbed posture; Pinocchio judges the outcome."""
    rng = np.random.default_rng(11)
    count = 10_000
    true = np.array([random_posture(rng, 0.0) for _ in range(count)])
    # From a sample's usual distance to one from which two steps cannot arrive.
    guess = true + rng.normal(size=(count, 6)) * 10.0 ** rng.uniform(-4, 0, (count, 1))
    targets = [ARMS[0].place(q).copy() for q in true]
    R = np.hstack([t.rotation for t in targets])
    p = np.column_stack([t.translation for t in targets])
    found, residual = (v.full() for v in step_function().map(count)(guess.T, R, p))
    reached = residual[0] <= REACH_TOLERANCE
    assert 0.2 < reached.mean() < 0.8
    for q, target, claimed in zip(found.T, targets, residual[0], strict=True):
        actual = ARMS[0].residual(q, target)
        assert actual == pytest.approx(claimed, abs=1e-11, rel=1e-6)


@pytest.mark.parametrize("arm", [0, 1])
def test_joint_torques_do_the_work_of_the_contact_wrench(arm: int) -> None:
    """Virtual work: tau . dq = f . dp + m . d(angle) of the contact point, by differences."""
    rng = np.random.default_rng(arm)
    q_symbol, R_symbol, wrench_symbol = (
        ca.SX.sym("q", 6),
        ca.SX.sym("R", 3, 3),
        ca.SX.sym("wrench", 6),
    )
    torque = joint_torque(
        CELL.robots[arm],
        CELL.contacts[arm],
        gofa_model().jacobian(q_symbol),
        R_symbol,
        wrench_symbol,
    )
    function = ca.Function("torque", [q_symbol, R_symbol, wrench_symbol], [torque])
    plain = ARMS[arm]

    def contact(q: Array) -> pin.SE3:
        return pin.SE3(plain.robot.T_world_base) * plain.place(q) * plain.T_flange_pad

    for _ in range(5):
        q, wrench, h = random_posture(rng), rng.normal(size=6) * 50.0, 1e-6
        R = rotation(box_pose(plain, q)[3:])
        tau = np.array(function(q, R, wrench))[:, 0]
        for joint in range(6):
            dq = h * np.eye(6)[joint]
            after, before = contact(q + dq), contact(q - dq)
            turn = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
            moved = np.concatenate([after.translation - before.translation, turn]) / (2 * h)
            assert tau[joint] == pytest.approx(wrench @ moved, abs=1e-5)


def straight_path(arm: int, end: Array, samples: int = 40) -> tuple[Array, Array]:
    start = CELL.task.waypoints[0].lower
    poses = start + np.linspace(0.0, 1.0, samples)[:, None] * (end - start)
    return start_posture(CELL)[arm], poses


@pytest.mark.parametrize("arm", [0, 1])
def test_follows_a_reachable_path_to_within_its_tolerance(arm: int) -> None:
    start, poses = straight_path(arm, np.array([-0.4, 0.05, 0.8, 0.1, 0.1, -0.1]))
    follow = follow_function(CELL.robots[arm], gofa_model(), CELL.contacts[arm], 40, "follow")
    result = call(follow, start, poses, np.zeros((40, 6)))
    assert not result["lost"].any()
    for q, pose in zip(result["q"], poses, strict=True):
        assert ARMS[arm].residual(q, ARMS[arm].flange_target(pose)) < REACH_TOLERANCE


def test_the_first_step_of_a_coarse_path_is_reached_as_well() -> None:
    """The second sample has no motion before it; its prediction must make up for that."""
    start, poses = straight_path(0, np.array([-0.4, 0.0, 0.8, 0.0, 0.0, 0.0]), samples=30)
    follow = follow_function(CELL.robots[0], gofa_model(), CELL.contacts[0], 30, "follow")
    result = call(follow, start, poses, np.zeros((30, 6)))
    assert result["ik_residual"][1] < 1e-9
    assert not result["lost"].any()


def test_an_arm_that_lost_the_path_stays_lost_even_when_it_finds_back() -> None:
    start = start_posture(CELL)[0]
    pose = CELL.task.waypoints[0].lower
    # Out of reach and back again.
    x = np.concatenate([np.linspace(0.0, -1.5, 40), np.linspace(-1.5, 0.0, 40), np.zeros(40)])
    poses = np.tile(pose, (120, 1))
    poses[:, 0] = x
    follow = follow_function(CELL.robots[0], gofa_model(), CELL.contacts[0], 120, "follow")
    result = call(follow, start, poses, np.zeros((120, 6)))
    first = int(np.argmax(result["lost"]))
    assert result["lost"][:first].max() == 0.0
    assert result["lost"][first:].min() == 1.0
    assert result["ik_residual"][first:].max() > 0.1
    # It waits where it was, and its residual says how far off that is.
    assert np.all(result["q"][first:] == result["q"][first - 1])
    held = result["q"][first - 1]
    for pose, residual in zip(poses[first:], result["ik_residual"][first:], strict=True):
        assert residual == pytest.approx(ARMS[0].residual(held, ARMS[0].flange_target(pose)))


def test_a_jump_to_another_branch_counts_as_lost() -> None:
    """The sample is reached, but by a change of joints that no motion makes."""
    track = track_function(CELL.robots[0], gofa_model(), CELL.contacts[0], "track")
    start, pose = start_posture(CELL)[0], CELL.task.waypoints[0].lower
    previous = start + 2.0 * MAX_JOINT_STEP * np.eye(6)[0]
    # Extrapolation with this change lands exactly on the posture that holds the box.
    change = start - previous
    assert ARMS[0].residual(start, ARMS[0].flange_target(pose)) < REACH_TOLERANCE
    result = call(track, np.concatenate([previous, change, np.zeros(7)]), pose, np.zeros(6))
    assert result["lost"][0] == 1.0
    np.testing.assert_array_equal(result["q"], previous)


def test_a_step_by_blocks_is_newtons() -> None:
    model = gofa_model()
    step, residual = block_step(model, _q, _R, _p)
    both = ca.Function("both", [_q, _R, _p], [step, residual, newton_step(model, _q, _R, _p)])
    rng = np.random.default_rng(5)
    for _ in range(200):
        q = random_posture(rng)
        target = ARMS[0].place(q + 0.05 * rng.normal(size=6)).copy()
        found, before, expected = both(q, target.rotation, target.translation)
        conditioned = np.linalg.cond(ARMS[0].jacobian(q)) < 1e4
        if conditioned:
            np.testing.assert_allclose(found.full(), expected.full(), atol=1e-9)
        assert float(before) == pytest.approx(ARMS[0].residual(q, target), abs=1e-12)


def test_a_sample_that_the_cheap_steps_miss_is_reached_all_the_same() -> None:
    """A wild change of the last change sends the extrapolation astray; the QR steps find back."""
    track = track_function(CELL.robots[0], gofa_model(), CELL.contacts[0], "track")
    start, pose = start_posture(CELL)[0], CELL.task.waypoints[0].lower
    rng = np.random.default_rng(6)
    astray = 0
    for _ in range(20):
        state = np.concatenate([start, np.zeros(6), rng.normal(0.0, 2.0, 6), [0.0]])
        result = call(track, state, pose, np.zeros(6))
        assert result["lost"] == 0.0
        assert ARMS[0].residual(result["q"], ARMS[0].flange_target(pose)) < REACH_TOLERANCE
        guess = start + state[12:18]
        for _ in range(CHEAP_STEPS + 1):
            guess = ARMS[0].newton_step(guess, ARMS[0].flange_target(pose))
        astray += ARMS[0].residual(guess, ARMS[0].flange_target(pose)) > REACH_TOLERANCE
    assert astray > 5


def test_turning_base_and_box_together_changes_nothing_for_the_arm() -> None:
    turn = 0.7
    R = Rotation.from_euler("z", turn).as_matrix()
    robot, contact = CELL.robots[0], CELL.contacts[0]
    T = np.eye(4)
    T[:3, :3] = R
    turned_robot = replace(robot, T_world_base=T @ robot.T_world_base)
    start, poses = straight_path(0, np.array([-0.4, 0.05, 0.8, 0.1, 0.1, -0.1]))
    turned_poses = np.column_stack([poses[:, :3] @ R.T, poses[:, 3:] + [0.0, 0.0, turn]])
    wrenches = np.random.default_rng(0).normal(size=(40, 6)) * 30.0
    turned_wrenches = (wrenches.reshape(-1, 3) @ R.T).reshape(-1, 6)
    here = follow_function(robot, gofa_model(), contact, 40, "here")
    there = follow_function(turned_robot, gofa_model(), contact, 40, "there")
    expected = call(here, start, poses, wrenches)
    for name, value in call(there, start, turned_poses, turned_wrenches).items():
        np.testing.assert_allclose(value, expected[name], atol=1e-9, err_msg=name)


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
