"""Compiled timings against TOPP-RA, a convex program, their limits and their laws."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.passes import ForwardBackwardPasses
from hybrid_opt.timing.records import TimingLimits, TimingStatus
from hybrid_opt.timing.solve import PathTimer, drive_path
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.hybrid_opt.timing.cells import (
    by_toppra,
    hand_timing,
    initial,
    near_initial,
    timing_of,
    with_robots,
)
from tests.refusals import refused
from tests.symbolic.cells import (
    RACK,
    fixed,
    hand_cell,
    hand_model,
    with_contacts,
    with_payload,
    with_task,
)

INTERVALS = 100
STATIC = 98.1 / 2.0


def timer_of(cell: Workcell, intervals: int = INTERVALS) -> PathTimer:
    return PathTimer(CompiledCell(cell, model=hand_model(cell)), intervals, lanes=1)


@cache
def some_paths() -> Array:
    return near_initial(np.random.default_rng(3), 3)


def assert_agrees(timer: PathTimer, model: TimingModel, x: Array, limits: TimingLimits) -> None:
    """Duration within 0.2 % of TOPP-RA, limits within 0.5 % on the tenfold grid."""
    found, expected = timer.time(x, limits), by_toppra(model, x, limits)
    assert found.ok == expected.ok, (found.status, found.place, expected.reason)
    if not expected.ok:
        assert found.status is expected.status
        return
    assert found.duration == pytest.approx(expected.duration, rel=2e-3)
    check_limits = drive_path(model, x, found.grid_speed, limits)
    assert check_limits.ok, check_limits.reason
    assert check_limits.duration == pytest.approx(found.duration, rel=1e-9)
    np.testing.assert_allclose(
        check_limits.driven.normal_force.max(axis=0), found.peak_force, rtol=1e-3, atol=0.01
    )


@pytest.mark.parametrize(
    ("share", "factor"), [(None, 0.6), (None, 1.0), (1.01, 1.0), (1.05, 0.6), (1.3, 1.0)]
)
def test_durations_agree_with_toppra_and_limits_hold(share: float | None, factor: float) -> None:
    cell = with_contacts(
        with_robots(hand_cell(), torque_max=factor), patch_radius=(0.0315 * factor, 0.0315)
    )
    timer, model = timer_of(cell), timing_of(cell, INTERVALS)
    limits = TimingLimits(force=None if share is None else share * STATIC)
    for x in some_paths():
        assert_agrees(timer, model, x, limits)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rack", "transfer"])
def test_two_hundred_random_carries_agree_with_by_toppra(name: str) -> None:
    """At 200 intervals: at 100 some of the sharpest exceed a joint's acceleration between the
    points by 1.2 %."""
    cell = load(RACK.with_name(f"{name}.toml"))
    timer, model = PathTimer(cell, 200), TimingModel(cell, 200)
    rng, task, timed = np.random.default_rng(12), cell.task, 0
    for k in range(2000):
        x = rng.uniform(task.lower, task.upper)
        limits = TimingLimits(force=(None, 50.0, 52.0, 55.0, 60.0)[k % 5])
        motion = model.path_motion(x)
        # A path that only its tenfold samples reject is judged by other samples, not timed.
        if motion.lost.any() or motion.manipulability.min() < 0.031:
            continue
        if abs(motion.limit_margin.min()) < 1e-3:
            continue
        assert_agrees(timer, model, x, limits)
        timed += 1
        if timed == 200:
            return
    pytest.fail(f"only {timed} carries could be timed")


def test_a_tilted_box_is_not_driven_where_it_could_not_rest_within_the_limit() -> None:
    """Hung below its pads it tilts into what accelerates it, as on a waiter's tray: in motion it
    needs less force than it would if it stopped there. Both ways to time it agree."""
    cell = with_task(hand_cell(), allocation="soft-finger")
    cell = with_payload(cell, centre_of_mass=np.array([0.0, 0.0, -0.06]))
    x = initial().reshape(3, 6)
    x[:, 4] = 0.05, 0.2, 0.05
    model, timer = timing_of(cell, 100), timer_of(cell, 100)
    still = model.still(model.path_motion(x.ravel())).peak_normal_force.max()
    limits = TimingLimits(force=float(1.001 * still))
    found, other = timer.time(x.ravel(), limits), by_toppra(model, x.ravel(), limits)
    assert found.ok
    assert found.duration == pytest.approx(other.duration, rel=3e-3)
    too_low = TimingLimits(force=float(0.999 * still))
    for low in (timer.time(x.ravel(), too_low), by_toppra(model, x.ravel(), too_low)):
        assert low.status is TimingStatus.INFEASIBLE_AT_REST


def test_limits_used_up_at_rest_are_named_as_time_path_names_them() -> None:
    weak = with_robots(hand_cell(), torque_max=0.3)
    cases = (
        (hand_cell(), TimingLimits(force=STATIC)),
        (weak, TimingLimits()),
        (
            with_payload(hand_cell(), centre_of_mass=np.array([0.04, 0.0, 0.0])),
            TimingLimits(),
        ),
    )
    for cell, limits in cases:
        found = timer_of(cell).time(initial(), limits)
        expected = by_toppra(timing_of(cell, INTERVALS), initial(), limits)
        assert found.status is expected.status is TimingStatus.INFEASIBLE_AT_REST
        assert found.place.constraint == expected.place.constraint
        assert found.place.joint == expected.place.joint
        assert found.duration == float("inf")
        assert found.use[found.place.constraint] == pytest.approx(
            expected.use[expected.place.constraint].ratio, rel=1e-3
        )


def test_paths_that_fail_before_any_timing() -> None:
    task = hand_cell().task
    still = with_task(
        hand_cell(),
        waypoints=(task.waypoints[0], task.waypoints[1], fixed(task.waypoints[0].lower)),
        initial=task.waypoints[0].lower[None],
    )
    timing = timer_of(still).time(task.waypoints[0].lower, TimingLimits())
    assert timing.status is TimingStatus.NO_MOTION
    singular = with_robots(hand_cell(), min_manipulability=1e3)
    assert timer_of(singular).time(initial(), TimingLimits()).status is TimingStatus.NEAR_SINGULAR
    tight = with_robots(hand_cell(), position_upper=0.0)
    assert timer_of(tight).time(initial(), TimingLimits()).status is TimingStatus.JOINT_LIMITS


def test_limits_that_the_passes_do_not_support_are_timed_by_toppra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits, less = TimingLimits(force=1.05 * STATIC), TimingLimits(force=0.5 * STATIC)
    compiled, still = timer_of(hand_cell(), 30).time_all(
        np.array([initial()] * 2), limits, np.array([1.05, 0.5]) * STATIC
    )
    monkeypatch.setattr(ForwardBackwardPasses, "supports", lambda *_: False)
    timer = timer_of(hand_cell(), 30)
    assert not timer.passes.supports(limits)
    found = timer.time(initial(), limits)
    assert found.ok
    assert found.duration == pytest.approx(compiled.duration, rel=2e-3)
    np.testing.assert_allclose(found.peak_force, compiled.peak_force, rtol=1e-3)
    refused = timer.time(initial(), less)
    assert refused.status is still.status is TimingStatus.INFEASIBLE_AT_REST
    np.testing.assert_allclose(refused.peak_force, still.peak_force, rtol=1e-3)


def test_misuse_is_refused() -> None:
    with refused(SettingsError, "intervals"):
        PathTimer(hand_cell(), intervals=5)
    with refused(SettingsError, "shape"):
        timer_of(hand_cell()).time(np.full(18, np.nan), TimingLimits())
    with refused(SettingsError, "shape"):
        drive_path(hand_timing(INTERVALS), initial(), np.zeros(INTERVALS + 1), TimingLimits())
    too_fast = np.sin(np.linspace(0.0, np.pi, INTERVALS + 1))
    check_limits = drive_path(hand_timing(INTERVALS), initial(), 10.0 * too_fast, TimingLimits())
    assert check_limits.status is TimingStatus.EXCEEDED
