"""A carry under the task's own time law: joint rates that agree with the box's rest and motion."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from hybrid_opt.timing.analysis import judge_timing
from hybrid_opt.timing.model import REFINEMENT, TimingModel
from hybrid_opt.timing.records import TimingStatus
from symbolic.records import TimeLaw
from tests.hybrid_opt.timing.cells import initial, near_initial, timing_of
from tests.symbolic.cells import hand_cell

INTERVALS = 20


@cache
def timing(law: TimeLaw) -> TimingModel:
    """Sampled as densely as the timing recomputes a path."""
    cell = hand_cell()
    task = replace(cell.task, time_law=law, samples=REFINEMENT * INTERVALS + 1)
    return timing_of(replace(cell, task=task), INTERVALS)


def test_joint_rates_are_those_of_the_exact_derivatives() -> None:
    """Of the path's derivatives that the timing model compiles, driven with the box's speed."""
    model = timing("ramped")
    carry, motion = model.search_carry(initial()), model.path_motion(initial())
    np.testing.assert_allclose(carry.parameter, motion.parameter, atol=1e-15)
    length = (motion.pose_first**2).sum(axis=1)
    speed = ((carry.rate * motion.pose_first).sum(axis=1) / length)[:, None]
    bend = carry.second_rate - motion.pose_second * speed**2
    push = ((bend * motion.pose_first).sum(axis=1) / length)[:, None]
    q_second = motion.q_second * speed**2 + motion.q_first * push
    np.testing.assert_allclose(carry.side_by_side("q_rate"), motion.q_first * speed, atol=1e-3)
    inside = slice(3, -3)
    second = carry.side_by_side("q_second")
    np.testing.assert_allclose(second[inside], q_second[inside], atol=5e-3)


def test_a_ramped_carry_rests_at_its_ends() -> None:
    """And is not told that its robots would have to be at speed there."""
    for x in (initial(), *near_initial(np.random.default_rng(4), 3)):
        carry = timing("ramped").search_carry(x)
        for arm in carry.arms:
            np.testing.assert_allclose(arm.q_rate[[0, -1]], 0.0, atol=1e-6)
        judged = judge_timing(timing("ramped"), x)
        assert "at speed" not in judged.reason
    assert judge_timing(timing("ramped"), initial()).status is TimingStatus.OK


def test_a_constant_carry_is_at_speed_at_its_ends() -> None:
    judged = judge_timing(timing("constant"), initial())
    assert judged.status is TimingStatus.EXCEEDED
    assert "at speed" in judged.reason
