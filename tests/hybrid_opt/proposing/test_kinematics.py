from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from hybrid_opt.proposing.holding import (
    ArmKinematics,
    box_to_last_joint,
    possible_spins,
    spun,
)
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.records import Workcell
from symbolic.records.poses import pose_matrix

RACK = "studies/workcells/rack.toml"


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


def test_pads_that_stand_rigidly_beside_one_another_are_not_spun() -> None:
    spins = 2.0 * np.pi * np.arange(12) / 12
    fork, round_pad = load("studies/workcells/fork.toml").contacts, load(RACK).contacts[0]
    np.testing.assert_array_equal(possible_spins(round_pad, spins), spins)
    assert fork[0].further
    assert possible_spins(fork[0], spins).tolist() == [0.0]
    # A rectangle covers the same patch after half a turn only.
    np.testing.assert_allclose(possible_spins(fork[1], spins), [0.0, np.pi])
