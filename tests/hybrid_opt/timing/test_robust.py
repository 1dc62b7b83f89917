"""Timings within robust forces, compiled and not, and margins of a timed carry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.carry import Carry
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.robust.cases import worst_cases
from hybrid_opt.robust.force import robust_model
from hybrid_opt.static_hold import static_hold
from hybrid_opt.timing.analysis import closest_to_reference_timing
from hybrid_opt.timing.candidates import search_carry
from hybrid_opt.timing.model import SpeedProfile, TimingModel
from hybrid_opt.timing.records import TimingLimits, TimingStatus
from hybrid_opt.timing.robustness import (
    Margin,
    payload_sensitivity,
    robustness_margins,
)
from hybrid_opt.timing.solve import PathTimer, check_limits, drive_path, time_path
from symbolic.contact.registry import command_model
from symbolic.records import Uncertainty, Workcell
from tests.hybrid_opt.timing import convex_oracle
from tests.hybrid_opt.timing.cells import hand_timing, initial, near_initial, timing_of
from tests.hybrid_opt.timing.robust_oracle import robust_limit
from tests.symbolic.cells import hand_cell, hand_model, with_contacts, with_payload

SET = Uncertainty(0.1, 0.05, np.array([0.005, 0.005, 0.0]), 0.003, np.array([0.0, 0.2, 0.2]))
INTERVALS = 50


@cache
def unsure(intervals: int = INTERVALS) -> TimingModel:
    return timing_of(unsure_cell(), intervals)


@cache
def plain() -> Carry:
    """Within a limit on planned forces alone."""
    carry = time_path(unsure(), initial(), TimingLimits(force=60.0)).driven
    return carry


def unsure_cell(uncertainty: Uncertainty = SET) -> Workcell:
    return replace(hand_cell(), uncertainty=uncertainty)


def test_the_robust_forces_use_the_limit_up_and_keep_it() -> None:
    model = unsure()
    forces = robust_model(model.workcell)
    needed = float(forces.robust_force(plain()).peak.max())
    assert needed > 62.0
    timing = time_path(model, initial(), TimingLimits(force=needed, robust=True))
    assert timing.status is TimingStatus.OK
    peak = float(forces.robust_force(timing.driven).peak.max())
    assert peak == pytest.approx(needed, rel=2e-3)
    # The plan's own timing keeps this limit, so that the fastest is no slower.
    assert timing.duration <= plain().duration * (1.0 + 1e-3)
    only_plan = time_path(model, initial(), TimingLimits(force=needed))
    assert only_plan.duration < timing.duration


def test_a_limit_below_what_holds_still_in_every_case_is_told() -> None:
    model = unsure()
    timing = time_path(model, initial(), TimingLimits(force=53.0, robust=True))
    assert timing.status is TimingStatus.INFEASIBLE_AT_REST
    assert timing.place.constraint == "normal force"
    assert time_path(model, initial(), TimingLimits(force=53.0)).ok


@pytest.mark.parametrize("share", [0.9, 1.0, 1.5])
def test_the_use_of_the_limit_is_that_of_all_cases(share: float) -> None:
    """Cases far below the limit are left out, where others are near it."""
    model = unsure()
    held = robust_model(model.workcell).robust_force(plain())
    limit = share * float(held.peak.max())
    limits = TimingLimits(force=limit, robust=True)
    use = check_limits(model, plain(), limits).use["normal force"]
    assert use.ratio == pytest.approx(held.peak.max() / limit, rel=1e-6)
    every = model.carry_limits.ratios(plain(), limits)["normal force"].max(axis=1)
    needed = np.maximum(held.commanded, held.leading) / limit
    near = needed > 0.985
    np.testing.assert_allclose(every[near], needed[near], rtol=1e-6)
    assert (every < needed * (1.0 + 1e-6)).all()


FINE = 100


def timer_of(uncertainty: Uncertainty, intervals: int = FINE) -> PathTimer:
    cell = unsure_cell(uncertainty)
    return PathTimer(CompiledCell(cell, model=hand_model(cell)), intervals, lanes=1)


@cache
def timer() -> PathTimer:
    return timer_of(SET)


def test_they_agree_with_time_path_and_keep_the_limit_on_the_tenfold_grid() -> None:
    model = unsure(FINE)
    paths = np.vstack([initial(), near_initial(np.random.default_rng(3), 2)])
    limits = [TimingLimits(force=force, robust=True) for force in (70.0, 77.0, 83.0)]
    timed = timer().time_all(paths, limits[0], np.array([limit.force for limit in limits]))
    for x, limit, found in zip(paths, limits, timed, strict=True):
        expected = time_path(model, x, limit)
        assert found.ok, (found.status, expected.reason)
        assert found.duration == pytest.approx(expected.duration, rel=1e-3)
        check_limits = drive_path(model, x, found.grid_speed, limit)
        assert check_limits.ok, check_limits.reason
        peak = robust_model(model.workcell).robust_force(check_limits.driven).peak
        assert (peak <= 1.005 * (limit.force or 0.0)).all()
        assert found.robust_force == pytest.approx(peak, rel=1e-3)
        assert found.robust_force is not None
        assert found.peak_force.max() < found.robust_force.max()


def test_they_agree_with_a_convex_program() -> None:
    """Of four cases, each with wrenches of its own as variables."""
    some = Uncertainty(0.1, 0.05, np.array([0.008, 0.0, 0.0]), 0.0, np.array([0.0, 0.3, 0.0]))
    cell, intervals = unsure_cell(some), 24
    model, other = timing_of(cell, intervals), timer_of(some, intervals)
    limits = TimingLimits(force=80.0, torque=False, pressure=False, robust=True)
    cases = list(worst_cases(command_model(cell), some))
    assert len(cases) == 4
    exact = convex_oracle.shortest_duration(
        model, initial(), limits, robust_limit(cases, 0.95 / 1.05)
    )
    found = other.time(initial(), limits)
    planned = other.time(initial(), replace(limits, robust=False))
    assert found.duration == pytest.approx(exact, rel=5e-3)
    assert found.duration > 1.02 * planned.duration


def test_one_nominal_case_changes_nothing() -> None:
    """Where the patches suffice the least squeeze is the planned one."""
    one = timer_of(Uncertainty())
    for force in (51.0, 60.0):
        robust = one.time(initial(), TimingLimits(force=force, robust=True))
        planned = one.time(initial(), TimingLimits(force=force))
        assert robust.duration == pytest.approx(planned.duration, rel=5e-4)
        assert robust.robust_force == pytest.approx(planned.peak_force, rel=5e-4)


def test_what_cannot_stand_still_says_with_what_force_it_could() -> None:
    weak, strong = timer().time_all(
        np.array([initial(), initial()]),
        TimingLimits(force=55.0, robust=True),
        np.array([55.0, 70.0]),
    )
    assert strong.ok
    assert weak.status is TimingStatus.INFEASIBLE_AT_REST
    assert weak.place.constraint == "normal force"
    needed = 55.0 * weak.use["normal force"]
    assert needed == pytest.approx(weak.peak_force.max())
    still = timer().time(initial(), TimingLimits(force=1.002 * needed, robust=True))
    assert still.ok
    at_rest = timer().time(initial(), TimingLimits(force=0.998 * needed, robust=True))
    assert at_rest.status is TimingStatus.INFEASIBLE_AT_REST


def by_name(margins: tuple[Margin, ...]) -> dict[str, Margin]:
    return {margin.quantity: margin for margin in margins}


def test_forces_are_proportional_to_the_mass() -> None:
    """The payload at the limit, carried for real: its resultant is the limit."""
    x = near_initial(np.random.default_rng(2), 1)[0]
    cell = hand_cell()
    sensitivity = payload_sensitivity(search_carry(hand_timing(), x))
    mass = sensitivity.payload_limit
    heavy = with_payload(cell, mass=mass, inertia=cell.payload.inertia * mass / cell.payload.mass)
    force = search_carry(timing_of(heavy, 20), x).peak_resultant_force.max()
    assert force == pytest.approx(117.68, rel=1e-9)
    assert sensitivity.force_at(np.array([mass])).max() == pytest.approx(117.68)
    assert mass < static_hold(cell).payload_limit


def changed(cell: Workcell, margin: Margin, factor: float) -> Workcell:
    """The cell with the margin's quantity moved to a share of the way to its limit."""
    value = margin.nominal + factor * (margin.limit - margin.nominal)
    if margin.quantity == "friction of both contacts":
        return with_contacts(cell, friction=(value, value))
    axis = "xyz".index(margin.quantity[-1])
    return with_payload(cell, centre_of_mass=value * np.eye(3)[axis])


@pytest.mark.parametrize(
    "quantity",
    ["friction of both contacts", *(f"centre of mass towards {d}" for d in ("+x", "-y"))],
)
def test_margins_are_where_a_full_model_of_the_changed_cell_fails(quantity: str) -> None:
    cell, x = hand_cell(), near_initial(np.random.default_rng(7), 1)[0]
    model = hand_timing()
    timed = closest_to_reference_timing(model, x)
    margin = by_name(robustness_margins(model, timed.driven))[quantity]
    assert margin.fails in ("normal force", "pressure shift", "joint torque")
    speeds, held = SpeedProfile.from_grid_speed(timed.grid_speed), []
    for factor in (0.99, 1.01):
        other = timing_of(changed(cell, margin, factor))
        used = speeds.carry(other, other.path_motion(x))
        limit = np.concatenate([robot.torque_max for robot in cell.robots])
        most_used = max(
            float(used.normal_force.max() / 117.68),
            float(used.pressure_shift.max() / cell.contacts[0].patch_radius),
            float((np.abs(used.torque) / limit).max()),
        )
        held.append(most_used <= 1.0)
    assert held == [True, False]


def test_a_carry_that_fails_already_has_no_margin() -> None:
    cell = with_payload(hand_cell(), centre_of_mass=np.array([0.05, 0.0, 0.0]))
    model = timing_of(cell, 20)
    for margin in robustness_margins(model, search_carry(model, initial()))[:3]:
        assert margin.limit == margin.nominal
        assert margin.fails == "pressure shift"


def test_least_patch_radius_is_the_largest_shift() -> None:
    model = hand_timing()
    tilted = search_carry(model, near_initial(np.random.default_rng(9), 1)[0])
    margins = by_name(robustness_margins(model, tilted))
    for i, name in enumerate(("first", "second")):
        assert margins[f"patch radius of {name}"].limit == tilted.pressure_shift[:, i].max()
