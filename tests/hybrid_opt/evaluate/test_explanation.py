"""What is in the way of candidates that fail: names, places and amounts."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluations import REASONS
from hybrid_opt.evaluate.explanation import Explanation, explain, frequent, missing_reach
from symbolic.read.cell import load
from symbolic.records.poses import box_placement
from symbolic.records.task import straight_line
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell(load(RACK))


@pytest.fixture(scope="module")
def found(cell: Cell) -> tuple[Explanation, ...]:
    x = cell.initial + np.random.default_rng(2).normal(0.0, 0.15, (60, cell.n_var))
    judged = cell.evaluate(x)
    return explain(cell.evaluator, judged[~judged.feasible])


def test_the_straight_line_meets_a_board(cell: Cell) -> None:
    judged = cell.evaluate(straight_line(cell.workcell.task))
    (why,) = explain(cell.evaluator, judged)
    outputs = cell.evaluator.outputs(judged.x)
    at = [outputs[name][0, [why.sample]] for name in ("pose", "q_1", "q_2")]
    hit = cell.evaluator.checker.collision_mask(*map(np.ascontiguousarray, at))[0]
    names = {cell.geometry.pair_names[k] for k in np.flatnonzero(hit)}
    assert why.pair in names
    assert f"{why.pair[0]} meets {why.pair[1]}" in str(why)
    assert why.position == judged.position[0]


def test_reasons_come_with_what_they_are_about(cell: Cell, found: tuple[Explanation, ...]) -> None:
    assert len(found) > 20
    for why in found:
        assert why.reason in REASONS
        assert (why.pair is not None) == (why.reason == "collision")
        assert (why.joint is not None) == why.reason.startswith("joint_limits")
        assert (why.robot is not None) == why.reason.startswith("reach")
        if why.joint is not None:
            assert why.joint.startswith(("left/joint_", "right/joint_"))
            assert why.excess > 0.0
            assert f"{why.excess:.3f} rad beyond its limit" in str(why)
    counts = frequent(found)
    assert sum(counts["pairs"].values()) == sum(why.pair is not None for why in found)
    assert list(counts["pairs"].values()) == sorted(counts["pairs"].values(), reverse=True)


def test_missing_reach_is_the_distance_beyond_the_stretched_arm(cell: Cell) -> None:
    robot, contact = cell.workcell.robots[0], cell.workcell.contacts[0]
    carry, orientation = cell.carry(cell.initial), cell.workcell.task.orientation
    at = box_placement(orientation, carry.pose[0])
    held = missing_reach(robot, contact, at, carry.arms[0].q[0])
    assert held == pytest.approx(0.0, abs=1e-6)
    near, far = at.copy(), at.copy()
    near[1, 3], far[1, 3] = -2.0, -3.0
    lacks = [missing_reach(robot, contact, T, carry.arms[0].q[0]) for T in (near, far)]
    assert lacks[0] > 0.5
    assert lacks[1] - lacks[0] == pytest.approx(1.0, abs=0.2)
