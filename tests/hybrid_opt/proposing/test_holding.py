"""Ways to hold the box: the kinematics side by side against Pinocchio, spins, and pairs of ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from hybrid_opt.proposing.holding import (
    ArmKinematics,
    Hold,
    HoldQuery,
    HoldSearch,
    box_to_last_joint,
    clear_spins,
    find_holds,
    possible_spins,
    spun,
)
from hybrid_opt.proposing.setup import Agreement
from hybrid_opt.proposing.trial import judge_of
from symbolic.array import Array
from symbolic.geometry.pairs import build_geometry
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.records import Body, Box, Workcell
from symbolic.records.poses import box_placement, pose_matrix
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="module")
def rack() -> Workcell:
    return load(RACK)


def test_placements_and_jacobians_are_pinocchios(rack: Workcell) -> None:
    kinematics = ArmKinematics.of(rack, 0, ())
    model = arm_model(rack.robots[0])
    data = model.createData()
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 6))
    frames, T = kinematics.chain(q)
    J = kinematics.jacobian(frames, T)
    base = rack.robots[0].T_world_base
    for k in range(len(q)):
        pin.computeJointJacobians(model, data, q[k])
        np.testing.assert_allclose(T[k], base @ data.oMi[6].homogeneous, atol=1e-13)
        own = pin.getJointJacobian(model, data, 6, pin.LOCAL_WORLD_ALIGNED)
        turned = np.vstack([base[:3, :3] @ own[:3], base[:3, :3] @ own[3:]])
        np.testing.assert_allclose(J[k], turned, atol=1e-13)


def test_newtons_method_comes_back_to_where_placements_are_from(rack: Workcell) -> None:
    kinematics = ArmKinematics.of(rack, 1, ())
    rng = np.random.default_rng(1)
    q = rng.uniform(-1.5, 1.5, (50, 6))
    _, T = kinematics.chain(q)
    found = kinematics.solve(q + rng.normal(0.0, 0.02, q.shape), T, 20, 1e-3)
    away = found.manipulability > 0.01
    assert away.sum() > 25
    np.testing.assert_allclose(found.q[away], q[away], atol=1e-5)
    np.testing.assert_allclose(kinematics.chain(found.q)[1], T, atol=1e-5)


def test_following_goes_where_the_joints_came_from(rack: Workcell) -> None:
    kinematics = ArmKinematics.of(rack, 0, ())
    begin = np.array([0.2, 0.5, 0.4, 0.3, 0.9, 0.1])
    path = begin + np.linspace(0.0, 0.4, 20)[:, None] * np.array([1, -1, 0.5, 0.2, 0.4, 1.0])
    _, T = kinematics.chain(path)
    found, kept, _ = kinematics.follow(begin[None], T)
    assert kept.tolist() == [20]
    np.testing.assert_allclose(found[:, 0], path, atol=1e-6)


def test_a_posture_that_does_not_reach_is_told(rack: Workcell) -> None:
    kinematics = ArmKinematics.of(rack, 0, ())
    far = pose_matrix(np.array([5.0, 0.0, 0.0]), np.zeros(3))
    _, kept, _ = kinematics.follow(np.zeros((1, 6)), np.array([far, far]))
    assert kept.tolist() == [0]


def test_the_spin_turns_the_pad_as_the_file_does(rack: Workcell) -> None:
    """A spin of the joint about the pad's axis is one of the pad."""
    geometry = ArmKinematics.of(rack, 0, ()).geometry
    contact = rack.contacts[0]
    plain = box_to_last_joint(rack, geometry, contact, 0)
    turned = box_to_last_joint(rack, geometry, spun(contact, 0.7), 0)
    np.testing.assert_allclose(plain[:3, 3], turned[:3, 3], atol=1e-12)
    angle = pin.log3(plain[:3, :3].T @ turned[:3, :3])
    assert np.linalg.norm(angle) == pytest.approx(0.7)
    np.testing.assert_allclose(np.linalg.inv(geometry.T_joint_box), plain, atol=1e-12)


def test_spins_are_left_out_at_which_the_pad_meets_what_stands(rack: Workcell) -> None:
    """A bar beside the pad, and a fin on the pad that meets it in one of four turns."""
    start = np.array(rack.task.waypoints[0].lower)
    goal, robot = start + 0.05 * np.eye(6)[2], rack.robots[0]
    at = pose_matrix(np.array([0.15, 0.0, -0.05]), np.zeros(3))
    fin = Body("fin", Box(np.array([0.3, 0.02, 0.02])), robot.T_flange_pad @ at)
    robot = replace(robot, tool=(fin,))
    pad = box_placement(rack.task.orientation, start) @ rack.contacts[0].T_box_pad
    at = pose_matrix(np.array([0.22, 0.0, -0.05]), np.zeros(3))
    bar = Body("bar", Box(np.full(3, 0.1)), pad @ at)
    cell = replace(rack, robots=(robot, rack.robots[1]), environment=(bar,))
    judge = judge_of(build_geometry(cell))
    spins: Array = np.pi / 2.0 * np.arange(4.0)
    query = HoldQuery(cell, start, goal, spins, judge)
    np.testing.assert_allclose(clear_spins(query, 0, spins), spins[1:])
    np.testing.assert_array_equal(clear_spins(query, 0, spins[:1]), spins[:1])
    np.testing.assert_array_equal(clear_spins(replace(query, judge=None), 0, spins), spins)


def test_pads_that_stand_rigidly_beside_one_another_are_not_spun() -> None:
    spins = 2.0 * np.pi * np.arange(12) / 12
    fork, round_pad = load("studies/workcells/fork.toml").contacts, load(RACK).contacts[0]
    np.testing.assert_array_equal(possible_spins(round_pad, spins), spins)
    assert fork[0].further
    assert possible_spins(fork[0], spins).tolist() == [0.0]
    # A rectangle covers the same patch after half a turn only.
    np.testing.assert_allclose(possible_spins(fork[1], spins), [0.0, np.pi])


SPINS: Array = 2.0 * np.pi * np.arange(12.0) / 12.0


@pytest.fixture(scope="module")
def cell() -> Workcell:
    return load(RACK)


def ends(cell: Workcell) -> tuple[Array, Array]:
    return cell.task.waypoints[0].lower, cell.task.waypoints[-1].lower


def found(cell: Workcell) -> HoldSearch:
    query = HoldQuery(cell, *ends(cell), SPINS, None)
    return find_holds(query, 0, ArmKinematics.of(cell, 0, ()), np.random.default_rng(1))


def test_holds_hold_the_box_at_both_ends(cell: Workcell) -> None:
    holds = found(cell).holds
    assert len(holds) > 1
    kinematics = ArmKinematics.of(cell, 0, ())
    for hold in holds:
        contact = spun(cell.contacts[0], hold.spin)
        T_box_joint = box_to_last_joint(cell, kinematics.geometry, contact, 0)
        for pose, q in zip(ends(cell), (hold.q_start, hold.q_goal), strict=True):
            T = kinematics.chain(q[None])[1][0]
            np.testing.assert_allclose(T, pose_matrix(pose[:3], pose[3:]) @ T_box_joint, atol=1e-5)


LIFT = 0
"""The lift's index in both arms."""


def posture(arm: ArmKinematics, target: Array, lift: float) -> Array:
    """One that holds the box within the limits, the lift at a height [m]."""
    rng = np.random.default_rng(2)
    begin = rng.uniform(arm.lower, arm.upper, (400, len(arm.lower)))
    begin[:, LIFT] = lift
    found = arm.solve(begin, np.tile(target, (400, 1, 1)), 50, 1e-3)
    inside = np.all((found.q > arm.lower + 0.02) & (found.q < arm.upper - 0.02), axis=1)
    return np.asarray(found.q[(found.residual < 1e-6) & inside & (found.manipulability > 0.01)][0])


def held(workcell: Workcell, arm: int, pose: Array) -> Array:
    """Where the arm's last joint has to be (4, 4)."""
    kinematics = ArmKinematics.of(workcell, arm, ())
    T = box_to_last_joint(workcell, kinematics.geometry, workcell.contacts[arm], arm)
    return np.asarray(pose_matrix(pose[:3], pose[3:]) @ T)


def test_both_arms_end_on_one_lift_and_still_hold_the_box() -> None:
    workcell = load(RACK.with_name("tiago.toml"))
    start = workcell.task.waypoints[0].lower
    arms, holds = [], []
    for arm, lift in enumerate((0.06, 0.10)):
        redundant = tuple(joint for joint, _ in workcell.task.redundant_of(arm))
        kinematics = ArmKinematics.of(workcell, arm, redundant)
        q = posture(kinematics, held(workcell, arm, start), lift)
        arms.append(kinematics)
        holds.append(Hold(0.0, q, q, 1.0))
    agreed = Agreement(workcell, (start, start)).of((holds[0], holds[1]))
    assert agreed is not None
    for end in ("q_start", "q_goal"):
        first, second = (getattr(hold, end) for hold in agreed)
        assert first[LIFT] == second[LIFT]
        assert 0.06 <= first[LIFT] <= 0.10
        for arm, q in enumerate((first, second)):
            placed = arms[arm].chain(q[None])[1][0]
            np.testing.assert_allclose(placed, held(workcell, arm, start), atol=1e-5)


def test_arms_without_common_joints_stay_as_they_are() -> None:
    workcell = load(RACK)
    start = workcell.task.waypoints[0].lower
    pair = (Hold(0.0, np.zeros(6), np.zeros(6), 1.0), Hold(0.1, np.ones(6), np.ones(6), 1.0))
    assert Agreement(workcell, (start, start)).of(pair) is pair
