"""Ways to hold of one arm of the rack; the oracle is the placement of its last joint."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hybrid_opt.proposing import holding
from hybrid_opt.proposing.holding import GUIDES, HoldQuery, HoldSearch, find_holds
from hybrid_opt.proposing.kinematics import ArmKinematics, box_to_last_joint, spun
from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import Workcell
from symbolic.records.poses import pose_matrix
from tests.symbolic.read.samples import RACK

SPINS: Array = 2.0 * np.pi * np.arange(12.0) / 12.0


@pytest.fixture(scope="module")
def cell() -> Workcell:
    return load(RACK)


@pytest.fixture
def followed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many postures were followed together, every time."""
    sizes: list[int] = []
    follow = ArmKinematics.follow

    def counted(self: ArmKinematics, q: Array, *rest: Any, **named: Any) -> Any:
        sizes.append(len(q))
        return follow(self, q, *rest, **named)

    monkeypatch.setattr(ArmKinematics, "follow", counted)
    return sizes


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


def test_postures_of_all_spins_are_followed_together(cell: Workcell, followed: list[int]) -> None:
    within = found(cell).within
    assert followed[0] == within
    assert len(followed) <= len(GUIDES)


def test_no_further_guide_is_tried_when_enough_postures_arrived(
    cell: Workcell, followed: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(holding, "ENOUGH_HOLDS", 1)
    assert found(cell).holds
    assert len(followed) == 1
