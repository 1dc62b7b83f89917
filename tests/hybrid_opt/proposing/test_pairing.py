"""Both arms of a TIAGo on one lift; the oracle is the placement of their last joints."""

from __future__ import annotations

import numpy as np

from hybrid_opt.proposing.holding import ArmKinematics, Hold, box_to_last_joint
from hybrid_opt.proposing.setup import Agreement
from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import Workcell
from symbolic.records.poses import pose_matrix
from tests.symbolic.read.samples import RACK

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
