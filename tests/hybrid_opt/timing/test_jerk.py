"""Timings within jerk limits: held by differences of what is driven, against those without."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.robust.force import robust_model
from hybrid_opt.timing.jerk import time_with_jerk
from hybrid_opt.timing.records import JerkLimits, JerkTiming, TimingLimits, TimingStatus
from hybrid_opt.timing.solve import time_path
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty
from tests.hybrid_opt.timing import jerk_oracle
from tests.hybrid_opt.timing.cells import (
    hand_timing,
    initial,
    near_initial,
    timing_of,
    with_robots,
)
from tests.refusals import refused
from tests.symbolic.cells import hand_cell, with_payload

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
    carry = found.timing.driven
    assert found.timing.ok
    assert max(excess.ratio for excess in found.timing.use.values()) <= 1.005
    # Differences of the joints' accelerations over time, an independent way to their jerk.
    acceleration, time = carry.stack_arms("q_second"), carry.time
    jerk = np.diff(acceleration, axis=0) / np.diff(time)[:, None]
    assert np.abs(jerk).max() <= size * 1.01
    box = np.diff(carry.second_rate[:, :3], axis=0) / np.diff(time)[:, None]
    assert np.linalg.norm(box, axis=1).max() <= 0.6 * size * 1.01
    assert max(np.abs(jerk).max() / size, np.linalg.norm(box, axis=1).max() / (0.6 * size)) > 0.95


def test_positions_speeds_and_accelerations_belong_together_and_end_at_rest() -> None:
    carry = timed(40.0).timing.driven
    steps = np.diff(carry.time)[:, None]
    q, rate = carry.stack_arms("q"), carry.stack_arms("q_rate")
    middle = (rate[1:] + rate[:-1]) / 2.0
    np.testing.assert_allclose(np.diff(q, axis=0) / steps, middle, atol=2e-4)
    second = carry.stack_arms("q_second")
    middle = (second[1:] + second[:-1]) / 2.0
    np.testing.assert_allclose(np.diff(rate, axis=0) / steps, middle, atol=2e-2)
    for values in (rate, second):
        assert np.abs(values[[0, -1]]).max() < 1e-9


def test_a_limit_of_robust_forces_is_kept() -> None:
    """At what the planned timing needs in every case, so that both are allowed much the same."""
    cell = replace(hand_cell(), uncertainty=Uncertainty(friction=0.1, mass=0.05))
    model, forces = timing_of(cell), robust_model(cell)
    plain = timed(40.0).timing.driven
    needed = float(forces.robust_force(plain).peak.max())
    limits = TimingLimits(force=needed, robust=True)
    found = time_with_jerk(model, initial(), limits, jerk_limits(40.0))
    assert found.timing.ok
    assert found.timing.limits == limits
    peak = float(forces.robust_force(found.timing.driven).peak.max())
    assert 0.99 * needed < peak <= needed * 1.005
    assert found.timing.peak_force == pytest.approx(peak)
    # The plan's own timing keeps this limit, so that this is no slower, but for what rounds
    # settle at.
    assert found.without < found.timing.duration <= plain.duration * 1.005


def test_tighter_jerk_costs_more_and_loose_jerk_next_to_nothing() -> None:
    slow, middle, fast = (timed(size).timing.duration for size in (10.0, 40.0, 2000.0))
    assert slow > middle > fast
    free = time_path(hand_timing(), initial(), TimingLimits(force=FORCE)).duration
    assert timed(40.0).without == free
    assert timed(40.0).cost == pytest.approx(middle / free - 1.0)
    # The spline has no corners, so that it stays a little above the fastest timing of all.
    assert 0.995 * free < fast < 1.03 * free


@pytest.mark.parametrize(
    ("speed", "acceleration", "jerk"),
    [(0.3, 1.0, 5.0), (1.0, 1.0, 5.0), (1.0, 5.0, 5.0), (0.2, 5.0, 4.0)],
)
def test_a_straight_way_takes_the_time_of_the_s_curve(
    speed: float, acceleration: float, jerk: float
) -> None:
    """Speed, acceleration and jerk of the box alone bind, in every combination."""
    cell = with_robots(hand_cell(), velocity_max=100.0, acceleration_max=1e3, torque_max=100.0)
    cell = with_payload(cell, velocity_max=speed, acceleration_max=acceleration)
    way = np.concatenate([[0.0, 0.0, z, 0.0, 0.0, 0.0] for z in (0.845, 0.945, 1.045)])
    limits = TimingLimits(torque=False, pressure=False)
    only_box = JerkLimits(np.full(JOINTS, np.inf), jerk)
    found = time_with_jerk(timing_of(cell), way, limits, only_box)
    exact = jerk_oracle.s_curve(0.4, speed, acceleration, jerk)
    assert exact * 0.9995 < found.timing.duration < exact * 1.005


@pytest.mark.parametrize(
    ("seed", "share", "joints", "payload"),
    [
        (1, 1.1, 50.0, 30.0),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                (0, None, 30.0, 20.0),
                (2, None, 20.0, 100.0),
                (3, 1.05, 80.0, 80.0),
                (4, None, 200.0, 10.0),
                (5, 1.2, 15.0, np.inf),
            )
        ),
    ],
)
def test_no_transcription_in_time_finds_a_shorter_one(
    seed: int, share: float | None, joints: float, payload: float
) -> None:
    """IPOPT over time with piecewise constant jerk, from a slow start, comes to the same."""
    model = hand_timing()
    (x,) = near_initial(np.random.default_rng(seed), 1)
    motion = model.path_motion(x)
    still = np.zeros(len(motion.parameter))
    rest = float(model.drive(motion, still, still)["normal_force"].max())
    limits = TimingLimits(None if share is None else share * rest, torque=False, pressure=False)
    jerk = JerkLimits(np.full(JOINTS, joints), payload)
    found = time_with_jerk(model, x, limits, jerk)
    assert found.timing.ok
    other = jerk_oracle.shortest_duration(model, x, limits, jerk, 2.0 * found.timing.duration)
    assert found.timing.duration == pytest.approx(other, rel=1e-2)
    assert found.cost > 0.01


def test_a_workcell_states_limits() -> None:
    cell = hand_cell()
    assert JerkLimits.from_workcell(cell) is None
    first, second = cell.robots
    one = replace(cell, robots=(replace(first, jerk_max=np.full(6, 40.0)), second))
    limits = JerkLimits.from_workcell(one)
    assert limits is not None
    np.testing.assert_array_equal(limits.joints, [40.0] * 6 + [np.inf] * 6)
    assert limits.payload == np.inf
    box = JerkLimits.from_workcell(with_payload(cell, jerk_max=30.0))
    assert box is not None
    assert box.payload == 30.0
    assert np.isinf(box.joints).all()
    with refused(SettingsError, "jerk"):
        JerkLimits(np.zeros(JOINTS), 1.0)


def test_a_path_that_no_timing_drives_says_so() -> None:
    found = time_with_jerk(hand_timing(), initial(), TimingLimits(force=20.0), jerk_limits(40.0))
    assert found.timing.status is TimingStatus.INFEASIBLE_AT_REST
