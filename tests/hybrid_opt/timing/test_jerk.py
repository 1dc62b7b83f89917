"""Timings within jerk limits: held by differences of what is driven, against those without."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.timing import TimingLimits, TimingStatus, time_path
from hybrid_opt.timing.jerk import JerkLimits, JerkTiming, time_with_jerk
from symbolic.errors import SettingsError
from tests.hybrid_opt.timing.cells import hand_timing, initial

FORCE = 55.0
JOINTS = 12


def jerk_limits(size: float) -> JerkLimits:
    return JerkLimits(np.full(JOINTS, size), 0.6 * size)


@cache
def timed(size: float, force: float | None = FORCE) -> JerkTiming:
    return time_with_jerk(hand_timing(), initial(), TimingLimits(force=force), jerk_limits(size))


@pytest.mark.parametrize("size", [10.0, 40.0])
def test_every_limit_holds_and_the_jerk_is_that_of_what_is_driven(size: float) -> None:
    found = timed(size)
    carry = found.timing.carry
    assert found.timing.ok
    assert carry is not None
    assert max(excess.ratio for excess in found.timing.use.values()) <= 1.005
    # Differences of the joints' accelerations over time, an independent way to their jerk.
    acceleration, time = carry.side_by_side("q_second"), carry.time
    jerk = np.diff(acceleration, axis=0) / np.diff(time)[:, None]
    assert np.abs(jerk).max() <= size * 1.01
    box = np.diff(carry.second_rate[:, :3], axis=0) / np.diff(time)[:, None]
    assert np.linalg.norm(box, axis=1).max() <= 0.6 * size * 1.01
    assert max(np.abs(jerk).max() / size, np.linalg.norm(box, axis=1).max() / (0.6 * size)) > 0.95


def test_positions_speeds_and_accelerations_belong_together() -> None:
    carry = timed(40.0).timing.carry
    assert carry is not None
    steps = np.diff(carry.time)[:, None]
    q, rate = carry.side_by_side("q"), carry.side_by_side("q_rate")
    middle = (rate[1:] + rate[:-1]) / 2.0
    np.testing.assert_allclose(np.diff(q, axis=0) / steps, middle, atol=2e-4)
    second = carry.side_by_side("q_second")
    middle = (second[1:] + second[:-1]) / 2.0
    np.testing.assert_allclose(np.diff(rate, axis=0) / steps, middle, atol=2e-2)


def test_both_ends_rest_without_acceleration() -> None:
    carry = timed(40.0).timing.carry
    assert carry is not None
    for name in ("q_rate", "q_second"):
        assert np.abs(carry.side_by_side(name)[[0, -1]]).max() < 1e-9


def test_tighter_jerk_costs_more_and_loose_jerk_next_to_nothing() -> None:
    slow, middle, fast = (timed(size).timing.duration for size in (10.0, 40.0, 2000.0))
    assert slow > middle > fast
    free = time_path(hand_timing(), initial(), TimingLimits(force=FORCE)).duration
    assert timed(40.0).without == free
    assert timed(40.0).cost == pytest.approx(middle / free - 1.0)
    # The spline has no corners, so that it stays a little above the fastest timing of all.
    assert 0.995 * free < fast < 1.03 * free


def test_a_path_that_no_timing_drives_says_so() -> None:
    found = time_with_jerk(hand_timing(), initial(), TimingLimits(force=20.0), jerk_limits(40.0))
    assert found.timing.status is TimingStatus.INFEASIBLE_AT_REST


def test_jerk_limits_are_positive() -> None:
    with pytest.raises(SettingsError, match="positive"):
        JerkLimits(np.zeros(JOINTS), 1.0)
