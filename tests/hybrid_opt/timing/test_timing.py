"""Timings by toppra: their limits, closed forms, a convex and a nonlinear program; and stored."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import to_json, write_json
from hybrid_opt.timing.analysis import (
    TimedTrajectory,
    check_search_timing,
    closest_to_reference_timing,
    duration_against_force_limit,
    read_timing,
    time_trajectory,
    timing_document,
)
from hybrid_opt.timing.jerk import time_with_jerk
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import JerkLimits, Timing, TimingLimits, TimingStatus
from hybrid_opt.timing.robustness import robustness_margins
from hybrid_opt.timing.solve import time_path, validate_timing
from hybrid_opt.timing.topp_ra import linearised_rows
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from tests.hybrid_opt.timing import convex_oracle, nonlinear_oracle
from tests.hybrid_opt.timing.cells import (
    hand_timing,
    initial,
    near_initial,
    timing_of,
    with_robots,
)
from tests.refusals import refused
from tests.symbolic.cells import fixed, hand_cell, with_task
from tests.symbolic.read.samples import RACK

WEIGHT = 98.1
STATIC = WEIGHT / 2.0


def worst_ratios(model: TimingModel, timing: Timing, limits: TimingLimits) -> Array:
    """Largest use of any limit but friction on each interval of the refined samples."""
    ratios = model.carry_limits.ratios(timing.driven, limits)
    del ratios["friction"]
    use = np.max([ratio.max(axis=1) for ratio in ratios.values()], axis=0)
    most_used: Array = use.reshape(model.intervals, -1).max(axis=1)
    return most_used


@pytest.mark.parametrize(
    ("limits", "factor"),
    [
        (TimingLimits(), 1.0),
        (TimingLimits(), 0.6),
        (TimingLimits(reference_speed=True), 0.6),
        (TimingLimits(force=1.01 * STATIC), 1.0),
        (TimingLimits(force=1.3 * STATIC), 0.6),
    ],
)
def test_limits_hold_between_the_grid_points_and_are_reached(
    limits: TimingLimits, factor: float
) -> None:
    model = timing_of(with_robots(hand_cell(), torque_max=factor, acceleration_max=0.8))
    timing = time_path(model, initial(), limits)
    assert timing.ok, timing.reason
    use = worst_ratios(model, timing, limits)
    assert use.max() <= 1.005
    # Time-optimal motion has a limit active everywhere, but in intervals where it changes sides.
    assert np.mean(use > 0.98) > 0.95


def test_a_carry_starts_and_ends_at_rest_and_its_rates_integrate() -> None:
    carry = time_path(hand_timing(), initial()).driven
    for end in (0, -1):
        np.testing.assert_allclose(carry.stack_arms("q_rate")[end], 0.0, atol=1e-9)
    step = np.diff(carry.time)[:, None]
    assert (step >= 0.0).all()
    q, q_rate, q_second = (carry.stack_arms(name) for name in ("q", "q_rate", "q_second"))
    for value, rate in ((q, q_rate), (q_rate, q_second)):
        integral = np.sum(step * (rate[1:] + rate[:-1]) / 2.0, axis=0)
        np.testing.assert_allclose(integral, value[-1] - value[0], atol=2e-3)


def test_duration_falls_with_the_force_limit() -> None:
    curve = duration_against_force_limit(hand_timing(), initial(), points=6)
    assert curve.static_force == pytest.approx(STATIC, rel=1e-9)
    assert all(status is TimingStatus.OK for status in curve.status)
    assert (np.diff(curve.force) > 0.0).all()
    assert (np.diff(curve.duration) < 1e-6).all()
    free = time_path(hand_timing(), initial()).duration
    assert curve.duration[-1] == pytest.approx(free, rel=1e-3)
    with refused(SettingsError, "too-few", 1):
        duration_against_force_limit(hand_timing(), initial(), points=1)


def test_ten_times_the_reference_speed_is_judged_and_kept_within_limits() -> None:
    cell = hand_cell()
    fast = with_task(cell, reference_speed=10.0 * cell.task.reference_speed)
    model = timing_of(fast)
    check_limits = check_search_timing(model, initial())
    assert check_limits.status is TimingStatus.EXCEEDED
    assert max(excess.ratio for excess in check_limits.use.values()) > 2.0
    closest = closest_to_reference_timing(model, initial())
    assert closest.ok
    # So fast a reference never binds.
    assert closest.duration == pytest.approx(time_path(model, initial()).duration, rel=1e-4)


def test_the_search_timing_starts_at_speed_and_is_told_so() -> None:
    check_limits = check_search_timing(hand_timing(), initial())
    assert check_limits.status is TimingStatus.EXCEEDED
    assert check_limits.place.constraint == "start from rest"
    assert np.abs(check_limits.driven.stack_arms("q_rate")[0]).max() > 0.05


def test_the_closest_timing_cruises_at_the_reference_speed() -> None:
    cell = hand_cell()
    report = timed()
    closest = report.timings["closest to reference"]
    assert closest.ok
    speed = np.linalg.norm(closest.driven.rate[:, :3], axis=1)
    assert speed.max() <= cell.task.reference_speed * 1.0001
    assert np.mean(speed > 0.99 * cell.task.reference_speed) > 0.9
    assert report.nominal_duration < closest.duration < 1.1 * report.nominal_duration
    assert set(report.timings) == {"search", "fastest", "closest to reference", "force limited"}
    search, fastest = (report.timings[name].driven for name in ("search", "fastest"))
    assert (fastest.force_ratio > search.force_ratio).all()


def test_a_zero_length_segment_is_passed() -> None:
    cell = hand_cell()
    points = list(cell.task.waypoints)
    middle = fixed(cell.task.initial[1])
    twice = with_task(
        cell, waypoints=(*points[:2], middle, middle, *points[3:]), initial=cell.task.initial[::2]
    )
    timing = time_path(timing_of(twice), twice.task.initial.reshape(-1))
    assert timing.ok, timing.reason
    assert np.isfinite(timing.duration)


def test_a_pure_rotation_takes_the_time_it_needs() -> None:
    cell = hand_cell()
    pose = cell.task.initial[1]
    turned = np.array([*pose[:5], 0.2])
    start = with_task(cell, waypoints=(fixed(pose), fixed(turned)), initial=np.zeros((0, 6)))
    timing = closest_to_reference_timing(timing_of(start, 60), np.zeros(0))
    assert timing.ok, timing.reason
    assert timing.duration > 0.2 / cell.task.reference_angular_speed
    assert timing.use["path speed"].ratio == pytest.approx(1.0, abs=0.005)


def test_an_arm_that_loses_the_path_is_named() -> None:
    x = initial()
    x[6] = -2.5  # far out of reach
    timing = time_path(hand_timing(), x)
    assert timing.status is TimingStatus.OFF_PATH
    assert any(robot.name in timing.reason for robot in hand_cell().robots)


def test_force_limits_decision_vectors_and_intervals_are_checked() -> None:
    for force in (0.0, -1.0, float("nan"), float("inf")):
        with refused(SettingsError, "force"):
            TimingLimits(force=force)
    with refused(SettingsError, "no-force"):
        TimingLimits(robust=True)
    with refused(SettingsError, "shape", "18"):
        time_path(hand_timing(), np.full(18, np.nan))
    with refused(SettingsError, "intervals", 5):
        TimingModel(hand_cell(), intervals=5)


FORCE_SHARES = (None, 1.005, 1.05, 1.2)
"""Force limits over the largest force at rest."""

SEEDS = [pytest.param(seed, marks=pytest.mark.slow if seed >= 4 else ()) for seed in range(24)]


@pytest.mark.parametrize("seed", SEEDS)
def test_duration_agrees_with_a_convex_program(seed: int) -> None:
    model = hand_timing()
    (x,) = near_initial(np.random.default_rng(seed), 1)
    motion = model.path_motion(x)
    still = np.zeros(len(motion.parameter))
    static = float(model.drive(motion, still, still)["normal_force"].max())
    share = FORCE_SHARES[seed % len(FORCE_SHARES)]
    limits = TimingLimits(
        force=None if share is None else share * static,
        torque=False,
        pressure=False,
        reference_speed=seed % 3 == 0,
    )
    timing = time_path(model, x, limits)
    assert timing.ok, timing.reason
    # Asked for is 1 %; the two agree much better.
    assert timing.duration == pytest.approx(
        convex_oracle.shortest_duration(model, x, limits), rel=1e-3
    )


@pytest.mark.parametrize("factor", [0.6, 0.55])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
def test_torque_limited_duration_agrees_with_a_nonlinear_program(factor: float, seed: int) -> None:
    model = timing_of(with_robots(hand_cell(), torque_max=factor), intervals=40)
    (x,) = near_initial(np.random.default_rng(seed), 1, size=0.5)
    timing = time_path(model, x, TimingLimits(pressure=False))
    assert timing.ok, timing.reason
    assert timing.use["joint torque"].ratio == pytest.approx(1.0, abs=0.005)
    exact = nonlinear_oracle.shortest_duration(model, x, start=0.7 * timing.grid_speed)
    assert timing.duration == pytest.approx(exact, rel=0.01)
    without = time_path(model, x, TimingLimits(pressure=False, torque=False))
    assert timing.duration > 1.01 * without.duration


def test_rows_allow_rest_and_touch_the_value_where_they_are_made() -> None:
    rng = np.random.default_rng(1)
    shape = (500, 3)
    value, at_rest = rng.uniform(-0.5, 1.2, shape), rng.uniform(-0.99, 0.99, shape)
    gradient = rng.normal(size=(*shape, 2))
    z = np.column_stack([rng.normal(size=500), rng.uniform(0.01, 1.0, 500)])
    rows = linearised_rows(value, gradient, at_rest, z)
    assert (rows.bound > 0.0).all()
    beyond = rows.alpha * z[:, :1] + rows.beta * z[:, 1:] - rows.bound
    # Only a bound that is raised although the row itself allows rest leaves the value.
    touches = np.abs(beyond - (value - 1.0)) < 1e-9
    raised = 1.0 - value + np.einsum("nkd,nd->nk", gradient, z) < (1.0 - at_rest) / 2.0
    assert touches.all()
    assert 100 < raised.sum() < 1400


def test_a_tilted_path_whose_patches_rest_nearly_uses_up_is_timed() -> None:
    """Rows whose bounds were raised cut nothing off there: 25 iterations came to one timing."""
    x = np.zeros((3, 6))
    x[:, [0, 2, 4]] = [
        [-0.3860, 0.9217, 0.3455],
        [-0.2815, 1.1587, 0.5980],
        [-0.1818, 1.2105, 0.4803],
    ]
    timing = time_path(TimingModel(load(RACK), 100), x.ravel(), TimingLimits(force=65.0))
    assert timing.ok, timing.reason
    assert timing.iterations < 10
    assert abs(timing.duration - 1.865) < 0.01


SMALL_PATCH, OFFSET = 0.012, 0.05
"""[m] Neither holds the box without pressing harder."""


def off_centre(allocation: str) -> TimingModel:
    cell = hand_cell()
    along = cell.contacts[0].T_box_pad[:3, 2]
    payload = replace(cell.payload, centre_of_mass=OFFSET * along)
    first, second = (replace(contact, patch_radius=SMALL_PATCH) for contact in cell.contacts)
    task = replace(cell.task, allocation=allocation)
    return timing_of(replace(cell, payload=payload, contacts=(first, second), task=task), 50)


def test_what_soft_fingers_hold_can_be_timed() -> None:
    found = time_path(off_centre("paper"), initial(), TimingLimits())
    assert found.status is TimingStatus.INFEASIBLE_AT_REST
    assert found.place.constraint == "pressure shift"
    model = off_centre("soft-finger")
    timing = time_path(model, initial(), TimingLimits())
    assert timing.status is TimingStatus.OK
    assert "pressure shift" not in timing.use
    assert np.abs(timing.driven.moment_residual).max() < 1e-5
    names = [margin.quantity for margin in robustness_margins(model, timing.driven)]
    assert not any(name.startswith("patch radius") for name in names)


TOLD: list[tuple[int, int]] = []
"""Timings done and in all, as `timed` told them."""


@cache
def timed() -> TimedTrajectory:
    # The limit cannot be kept: that timing has no carry.
    return time_trajectory(
        hand_timing(),
        initial(),
        force_limit=1.0,
        curve_points=3,
        progress=lambda done, total: TOLD.append((done, total)),
    )


def test_every_timing_is_told_and_stored(tmp_path: Path) -> None:
    timed()
    # Three for every carry, one within the force limit, the margins, the validation, three of the
    # curve.
    assert [(k, 9) for k in range(1, 10)] == TOLD
    path = tmp_path / "timing.json"
    document = to_json(timing_document(timed()))
    write_json(path, document)
    assert to_json(read_timing(path)) == document


def test_figures_are_those_of_the_timings() -> None:
    document = timing_document(timed())
    fastest, carry = document.timings["fastest"], timed().timings["fastest"].driven
    assert fastest.duration == carry.time[-1] - carry.time[0]
    assert fastest.peak_normal_force is not None
    np.testing.assert_array_equal(fastest.peak_normal_force, carry.normal_force.max(axis=0))
    limited = document.timings["force limited"]
    assert limited.status == "infeasible at rest"
    assert limited.peak_normal_force is None
    assert to_json(limited)["duration"] is None
    assert document.force_curve is not None
    assert len(document.force_curve.force) == 3
    assert document.margins == timed().margins


def test_what_limits_on_jerk_cost_is_stored(tmp_path: Path) -> None:
    limits = JerkLimits(np.full(12, 40.0), 30.0)
    found = time_with_jerk(hand_timing(), initial(), TimingLimits(), limits)
    named = timed().timings | {"within jerk limits": found.timing}
    jerky = replace(timed(), timings=named, jerk=found)
    path = tmp_path / "timing.json"
    write_json(path, to_json(timing_document(jerky)))
    stored = read_timing(path)
    assert stored.jerk is not None
    assert (stored.jerk.duration, stored.jerk.without) == (found.timing.duration, found.without)
    assert (stored.jerk.joint_use, stored.jerk.payload_use) == found.jerk_use
    assert stored.timings["within jerk limits"].duration == stored.jerk.duration
    assert timing_document(timed()).jerk is None


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"timings": {"fastest": {}}}, "timings.fastest.status"),
        ({"timings": {"fastest": {"status": "fine"}}}, "'fine'"),
        ({"margins": None}, "margins"),
        ({"nominal_duration": "long"}, "nominal_duration"),
    ],
)
def test_damage_is_told_with_its_place(
    tmp_path: Path, change: dict[str, object], told: str
) -> None:
    path = tmp_path / "timing.json"
    path.write_text(json.dumps(to_json(timing_document(timed())) | change), encoding="utf-8")
    with pytest.raises(ResultsError, match=told):
        read_timing(path)


@pytest.mark.parametrize(
    "limits", [TimingLimits(), TimingLimits(force=60.0), TimingLimits(reference_speed=True)]
)
def test_toppra_confirms_the_timings_of_the_passes(limits: TimingLimits) -> None:
    timing = time_path(hand_timing(), initial(), limits)
    found = validate_timing(hand_timing(), timing)
    assert found.duration == timing.duration
    assert found.ratio == pytest.approx(1.0, abs=2e-3)
    assert found.is_confirmed
    assert not replace(found, duration=1.01 * found.duration).is_confirmed


def test_a_path_without_timing_cannot_be_validated() -> None:
    untimed = time_path(hand_timing(), initial(), TimingLimits(force=30.0))
    with refused(SettingsError, "no-timing"):
        validate_timing(hand_timing(), untimed)
