"""Ways to hold of one arm of the rack; the oracle is the placement of its last joint."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.proposing.holding import (
    ArmKinematics,
    HoldQuery,
    HoldSearch,
    box_to_last_joint,
    find_holds,
    spun,
)
from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import Workcell
from symbolic.records.poses import pose_matrix
from tests.symbolic.read.samples import RACK

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
