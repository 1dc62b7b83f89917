"""A smoothed timing keeps to the path and the limits, and begins and ends at rest."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.job.smooth import acceleration_at_ends, rests_at_ends, smoothed
from hybrid_opt.timing import JerkLimits, Timing, TimingLimits, time_path, time_with_jerk
from hybrid_opt.timing.use import limit_use, worst
from symbolic.path.spline import path_basis
from symbolic.records.task import waypoints_of
from tests.hybrid_opt.job.jobs import rack, rack_jobs, rack_timing

FORCE = 55.0


def fast() -> Timing:
    return time_path(rack().timing_model, rack().initial, TimingLimits(force=FORCE))


@pytest.mark.parametrize("width", [0.02, 0.05, 0.1])
def test_a_time_optimal_timing_loses_its_jumps(width: float) -> None:
    timing = fast()
    assert not rests_at_ends(timing)
    found = smoothed(rack().timing_model, timing, width)
    carry, cell = found.carry, rack().workcell
    assert carry is not None
    assert acceleration_at_ends(found) == 0.0
    assert timing.duration < found.duration < 1.02 * (timing.duration + 2.0 * width)
    # The jerk is bounded by the largest jump, twice the limit, times the kernel's peak.
    time, second = carry.time, carry.side_by_side("q_second")
    limit = np.concatenate([robot.acceleration_max for robot in cell.robots])
    jerk = np.abs(np.diff(second, axis=0)) / np.diff(time)[:, None]
    assert (jerk / limit).max() <= 2.0 * (35.0 / 32.0) / width * 1.05
    # The same path, and rates that are its derivatives.
    points = waypoints_of(cell.task, carry.x)
    poses = path_basis(len(points), carry.parameter).position @ points
    np.testing.assert_allclose(carry.pose, poses, atol=1e-10)
    for values, rate in (
        (carry.q, carry.side_by_side("q_rate")),
        (carry.pose, carry.rate),
        (carry.side_by_side("q_rate"), second),
    ):
        slope = np.gradient(values, time, axis=0)
        np.testing.assert_allclose(slope[2:-2], rate[2:-2], atol=0.005 * np.abs(rate).max())
    # Limits, from the carry alone.
    assert carry.normal_force.max() <= 1.005 * FORCE
    assert (np.abs(second) / limit).max() <= 1.005
    torque = np.concatenate([robot.torque_max for robot in cell.robots])
    assert (np.abs(carry.torque) / torque).max() <= 1.005


@pytest.mark.parametrize("force", [50.5, 55.0, 60.0])
@pytest.mark.parametrize("width", [0.03, 0.08])
def test_it_is_slowed_no_more_than_a_limit_asks_for(force: float, width: float) -> None:
    model, limits = rack().timing_model, TimingLimits(force=force)
    timing = time_path(model, rack().initial, limits)
    found = smoothed(model, timing, width)
    assert found.carry is not None
    use = limit_use(found.carry, model.workcell, limits, model.joint_names)
    assert found.use == use
    assert 0.5 * timing.slowed < found.slowed < timing.slowed
    assert 1.0 - 1e-3 < worst(use).ratio <= 1.0


def test_a_timing_at_rest_stays_as_it_is() -> None:
    limits = JerkLimits.of(rack().workcell)
    assert limits is not None
    once = time_with_jerk(
        rack().timing_model, rack().initial, TimingLimits(reference_speed=True), limits
    ).timing
    assert rests_at_ends(once)
    assert rack_jobs().plan(once).timing is once
    assert rack_jobs().plan(rack_timing(), smoothing=0.0).timing is rack_timing()
