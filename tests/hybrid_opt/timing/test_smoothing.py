"""A smoothed timing keeps its path and its limits, without jumps of the acceleration."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.timing.jerk import (
    acceleration_at_ends,
    has_rest_at_ends,
    without_jumps,
)
from hybrid_opt.timing.records import Timing, TimingLimits
from hybrid_opt.timing.solve import check_limits, most_used, time_path
from symbolic.path.spline import path_basis, waypoints_of
from tests.hybrid_opt.job.jobs import rack

FORCE = 55.0


@cache
def fast(force: float = FORCE) -> Timing:
    return time_path(rack().timing_model, rack().initial, TimingLimits(force=force))


@pytest.mark.parametrize("width", [0.02, 0.1])
def test_a_time_optimal_timing_loses_its_jumps(width: float) -> None:
    timing = fast()
    assert not has_rest_at_ends(timing)
    found = without_jumps(rack().timing_model, timing, None, width)
    carry, cell = found.driven, rack().workcell
    assert acceleration_at_ends(found) == 0.0
    assert timing.duration < found.duration < 1.02 * (timing.duration + 2.0 * width)
    # The jerk is bounded by the largest jump, twice the limit, times the kernel's peak.
    time, second = carry.time, carry.stack_arms("q_second")
    limit = np.concatenate([robot.acceleration_max for robot in cell.robots])
    jerk = np.abs(np.diff(second, axis=0)) / np.diff(time)[:, None]
    assert (jerk / limit).max() <= 2.0 * (35.0 / 32.0) / width * 1.05
    # The same path, and rates that are its derivatives.
    points = waypoints_of(cell.task, carry.x)
    poses = path_basis(len(points), carry.parameter).position @ points
    np.testing.assert_allclose(carry.pose, poses, atol=1e-10)
    for values, rate in (
        (carry.q, carry.stack_arms("q_rate")),
        (carry.pose, carry.rate),
        (carry.stack_arms("q_rate"), second),
    ):
        slope = np.gradient(values, time, axis=0)
        np.testing.assert_allclose(slope[2:-2], rate[2:-2], atol=0.005 * np.abs(rate).max())
    # Limits, from the carry alone.
    assert carry.normal_force.max() <= 1.005 * FORCE
    assert (np.abs(second) / limit).max() <= 1.005
    torque = np.concatenate([robot.torque_max for robot in cell.robots])
    assert (np.abs(carry.torque) / torque).max() <= 1.005


@pytest.mark.parametrize(("force", "width"), [(50.5, 0.08), (55.0, 0.03), (60.0, 0.08)])
def test_it_is_slowed_no_more_than_a_limit_asks_for(force: float, width: float) -> None:
    model, limits = rack().timing_model, TimingLimits(force=force)
    timing = fast(force)
    found = without_jumps(model, timing, None, width)
    use = check_limits(model, found.driven, limits).use
    assert found.use == use
    assert 0.5 * timing.slowed < found.slowed < timing.slowed
    assert 1.0 - 1e-3 < most_used(use).ratio <= 1.0
