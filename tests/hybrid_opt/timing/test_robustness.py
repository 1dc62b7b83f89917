"""Payload sensitivity and margins against closed forms and direct re-evaluation."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.carry import Carry
from hybrid_opt.static_hold import static_hold
from hybrid_opt.timing import TimingModel, closest_to_reference_timing, time_path
from hybrid_opt.timing.robustness import (
    Margin,
    payload_sensitivity,
    robustness_margins,
)
from symbolic.records import Workcell
from tests.hybrid_opt.timing.cells import hand_timing, initial, near_initial, timing_of
from tests.symbolic.cells import hand_cell, with_contacts, with_payload


def carry(model: TimingModel, x: np.ndarray | None = None) -> Carry:
    return model.search_carry(initial() if x is None else x)


def by_name(margins: tuple[Margin, ...]) -> dict[str, Margin]:
    return {margin.quantity: margin for margin in margins}


def test_static_payload_limit_has_a_closed_form() -> None:
    # (m g / 2) sqrt(1 + 1 / mu^2) = 12 kgf
    assert static_hold(hand_cell()).payload_limit == pytest.approx(16.9648, abs=1e-4)
    for mu in (0.5, 0.8):
        cell = with_contacts(hand_cell(), friction=(mu, mu))
        expected = 2.0 * 117.68 / (9.81 * np.sqrt(1.0 + 1.0 / mu**2))
        assert static_hold(cell).payload_limit == pytest.approx(expected, rel=1e-9)


def test_forces_are_proportional_to_the_mass() -> None:
    """The payload at the limit, carried for real: its resultant is the limit."""
    x = near_initial(np.random.default_rng(2), 1)[0]
    cell = hand_cell()
    sensitivity = payload_sensitivity(carry(hand_timing(), x))
    mass = sensitivity.payload_limit
    heavy = with_payload(cell, mass=mass, inertia=cell.payload.inertia * mass / cell.payload.mass)
    force = np.linalg.norm(carry(timing_of(heavy, 20), x).contact_force, axis=2).max()
    assert force == pytest.approx(117.68, rel=1e-9)
    assert sensitivity.force_at(np.array([mass])).max() == pytest.approx(117.68)
    assert (sensitivity.mass_by_normal > sensitivity.mass_by_resultant).all()
    assert mass < sensitivity.static_mass


def test_slow_carries_bear_almost_the_static_payload() -> None:
    model = hand_timing()
    timing = time_path(model, initial(), model.drive_limits(1.001 * 49.05))
    assert timing.carry is not None
    limit = payload_sensitivity(timing.carry).payload_limit
    static = static_hold(model.workcell).payload_limit
    assert 0.995 * static < limit < static


def test_friction_margin_is_the_normal_force_margin_while_level() -> None:
    """Level and symmetric: N = F_t / (2 mu) at the peak, so mu may fall to mu N / N_ref."""
    model = hand_timing()
    level = carry(model)
    margin = by_name(robustness_margins(model, level))["friction of both contacts"]
    assert margin.fails == "normal force"
    expected = level.normal_force.max() / 117.68
    # Accelerations along the squeeze axis are zero on the level hand-made path.
    assert margin.limit == pytest.approx(expected, rel=1e-4)


def test_centre_of_mass_margin_is_the_patch_radius_while_level() -> None:
    model = hand_timing()
    margins = by_name(robustness_margins(model, carry(model)))
    radius = hand_cell().contacts[0].patch_radius
    for sign, name in ((1.0, "+x"), (-1.0, "-x")):
        margin = margins[f"centre of mass towards {name}"]
        assert margin.fails == "pressure shift"
        # Equal tangential forces carry an offset by equal shifts.
        assert sign * margin.limit == pytest.approx(radius, rel=0.01)


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
    assert timed.carry is not None
    margin = by_name(robustness_margins(model, timed.carry))[quantity]
    assert margin.fails in ("normal force", "pressure shift", "joint torque")
    motion = model.path_motion(x)
    sample = np.searchsorted(motion.parameter, timed.carry.parameter - 1e-9)
    at = motion.at(sample)
    tangent = at.pose_first[:, np.abs(at.pose_first).sum(axis=0).argmax()]
    axis = np.abs(at.pose_first).sum(axis=0).argmax()
    keep = np.abs(tangent) > 0.05
    speed = timed.carry.rate[keep, axis] / tangent[keep]
    second = timed.carry.second_rate[keep, axis] - at.pose_second[keep, axis] * speed**2
    acceleration = second / tangent[keep]
    held = []
    for factor in (0.99, 1.01):
        other = timing_of(changed(cell, margin, factor))
        used = other.carry(
            other.path_motion(x).at(sample[keep]), timed.carry.time[keep], speed, acceleration
        )
        limit = np.concatenate([robot.torque_max for robot in cell.robots])
        worst = max(
            float(used.normal_force.max() / 117.68),
            float(used.pressure_shift.max() / cell.contacts[0].patch_radius),
            float((np.abs(used.torque) / limit).max()),
        )
        held.append(worst <= 1.0)
    assert held == [True, False]


def test_a_carry_that_fails_already_has_no_margin() -> None:
    cell = with_payload(hand_cell(), centre_of_mass=np.array([0.05, 0.0, 0.0]))
    model = timing_of(cell, 20)
    for margin in robustness_margins(model, carry(model))[:3]:
        assert margin.limit == margin.nominal
        assert margin.fails == "pressure shift"


def test_least_patch_radius_is_the_largest_shift() -> None:
    model = hand_timing()
    tilted = carry(model, near_initial(np.random.default_rng(9), 1)[0])
    margins = by_name(robustness_margins(model, tilted))
    for i, name in enumerate(("first", "second")):
        assert margins[f"patch radius of {name}"].limit == tilted.pressure_shift[:, i].max()
