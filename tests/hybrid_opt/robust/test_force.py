"""Robust forces: closed forms at rest, sampled cases, laws of sets."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.evaluate.objectives import OBJECTIVES
from hybrid_opt.robust.cases import random_cases, worst_cases
from hybrid_opt.robust.force import (
    BATCH,
    HOLDS,
    SCREENED,
    BoxMotion,
    RobustModel,
    allowed_factor,
)
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell
from symbolic.records.cell import RANGES
from tests.symbolic.cells import hand_cell, with_contacts
from tests.symbolic.contact.test_payload_load import random_motion

SET = Uncertainty(
    friction=0.1,
    mass=0.05,
    centre_of_mass=np.array([0.01, 0.01, 0.005]),
    pad_position=0.004,
    disturbance=np.array([0.5, 0.3, 0.4]),
    tracking=0.1,
    internal_force=4.0,
    tilt=0.02,
    relative_position=0.002,
    relative_angle=0.01,
)
FRICTION = 0.8
SAMPLES = 12


def cell() -> Workcell:
    return replace(with_contacts(hand_cell(), friction=(FRICTION, FRICTION)), uncertainty=SET)


@cache
def model() -> RobustModel:
    return RobustModel(cell())


def motion() -> BoxMotion:
    rng = np.random.default_rng(4)
    parts = [random_motion(rng) for _ in range(SAMPLES)]
    return BoxMotion(*[np.array(values) for values in zip(*parts, strict=True)])


def at_rest() -> BoxMotion:
    still = np.zeros((1, 6))
    return BoxMotion(still, still, still)


@pytest.mark.parametrize("leader", [0, 1])
def test_at_rest_the_worst_case_is_told_in_closed_form(leader: int) -> None:
    """Pads in line with the centre of mass: least friction, most mass, worst disturbance.

    The contacts lie across y, N_1 - N_2 is the disturbance's share along it, and N_1 + N_2 the
    tangential force over the coefficient.
    """
    uncertainty = Uncertainty(0.1, 0.05, np.zeros(3), 0.0, np.array([0.5, 0.3, 0.4]))
    commanded, leading = model().hold(at_rest(), uncertainty, leader)
    mass = 10.0 * 1.05
    tangential = mass * np.hypot(9.81 + 0.4, 0.5)
    along = mass * 0.3
    expected = (tangential / (0.9 * FRICTION) + along) / 2.0
    assert commanded[0] == pytest.approx(expected, rel=1e-6)
    assert leading[0] == pytest.approx(expected + along, rel=1e-6)


def test_a_displaced_centre_of_mass_is_held_by_pressing_harder() -> None:
    """The known case of the allocation: 50 mm towards a pad, patches of 10 mm, 111.5 N."""
    box = with_contacts(hand_cell(), friction=(0.5, 0.5), patch_radius=(0.01, 0.01))
    uncertainty = Uncertainty(centre_of_mass=np.array([0.0, 0.05, 0.0]))
    commanded, leading = RobustModel(box).hold(at_rest(), uncertainty)
    assert commanded[0] == pytest.approx(98.1 * 0.25 / (0.5 * 0.4 + 0.02), rel=1e-6)
    assert leading[0] == pytest.approx(commanded[0], rel=1e-6)


def test_no_random_case_needs_more_and_some_need_nearly_as_much() -> None:
    rng = np.random.default_rng(1)
    force = model().robust_force(motion())
    check = model().check(motion(), force, 3000, rng)
    assert check.holds
    assert check.cases == 3000
    assert 0.9 < check.closest <= 1.0
    weaker = replace(force, commanded=0.9 * force.commanded)
    assert not model().check(motion(), weaker, 3000, rng).holds


@pytest.mark.parametrize("factor", [0.95, 0.92])
def test_the_closest_case_is_that_of_every_case_at_every_sample(factor: float) -> None:
    """In several turns, of which each looks only at what is closer than those before."""
    moved, rng = motion(), np.random.default_rng(5)
    force = model().robust_force(moved)
    force = replace(force, commanded=factor * force.commanded)
    step = BATCH // len(moved.pose)
    check = model().check(moved, force, 3 * step, np.random.default_rng(5))
    assert model().check(moved, force, 3 * step, np.random.default_rng(5), threads=2) == check
    cases = np.concatenate([random_cases(model().workcell, SET, step, rng) for _ in range(3)])
    needed = model().least_squeeze(moved, cases, force.leader)[:, :, 1 - force.leader]
    share = (needed / force.commanded).max(axis=1)
    assert check.closest == share.max() > SCREENED
    assert check.failing == (share > 1.0 + HOLDS).sum()
    assert check.holds == (factor > 0.93)


@pytest.mark.slow
def test_none_of_a_hundred_thousand_cases_slips() -> None:
    force = model().robust_force(motion())
    assert model().check(motion(), force, 100_000, np.random.default_rng(2)).holds


def test_cases_within_the_ranges_lie_below_the_vertices() -> None:
    """Each range for itself, so that no other hides what it adds."""
    rng = np.random.default_rng(3)
    for name in RANGES:
        one = replace(Uncertainty(), **{name: getattr(SET, name)})
        force = model().robust_force(motion(), one)
        assert model().check(motion(), force, 500, rng).holds, name
        assert (force.commanded >= (1.0 - 1e-7) * force.nominal[:, 1]).all(), name


def test_leading_arm_feels_no_more_than_told() -> None:
    """In every case the leader's force is the commanded one and the motion's difference."""
    force = model().robust_force(motion())
    rng = np.random.default_rng(5)
    for _ in range(200):
        cases = worst_cases(cell(), SET)
        case = cases[rng.integers(len(cases))].copy()
        case[4] = 10.0 * rng.uniform(0.95, 1.05)
        needed = model().least_squeeze(motion(), case[None])[0]
        felt = force.commanded + needed[:, 0] - needed[:, 1]
        assert (felt <= force.leading * (1.0 + 1e-9)).all()


def test_the_price_grows_with_the_set_and_starts_at_the_nominal_forces() -> None:
    price = model().price(motion(), np.array([0.0, 0.5, 1.0, 1.5]))
    assert (np.diff(price, axis=0) > 0.0).all()
    force = model().robust_force(motion())
    np.testing.assert_allclose(price[2], force.peak, rtol=1e-12)
    np.testing.assert_allclose(price[0, 1], force.nominal[:, 1].max(), rtol=1e-7)


def test_the_largest_set_uses_the_forces_up() -> None:
    limit = 1.2 * model().robust_force(motion()).peak
    factor = model().largest_factor(motion(), limit)
    peak = model().price(motion(), np.array([factor]))[0]
    assert factor > 1.0
    assert (peak / limit).max() == pytest.approx(1.0, rel=1e-4)
    assert model().largest_factor(motion(), 0.1 * limit) == 0.0
    assert allowed_factor(cell(), SET) == pytest.approx(0.0315 / 0.005)


def test_is_an_objective() -> None:
    found = motion()
    outputs: dict[str, Array] = {
        name: getattr(found, name)[None] for name in ("pose", "rate", "second_rate")
    }
    value = OBJECTIVES["robust_force"].evaluate(outputs, cell())
    expected = (model().robust_force(found).peak / cell().task.reference_force).max()
    assert value == pytest.approx([expected])


def test_misuse_is_told() -> None:
    with pytest.raises(SettingsError, match="leader 2"):
        model().hold(motion(), SET, leader=2)
    with pytest.raises(SettingsError, match="no friction or no patch"):
        model().hold(motion(), SET.scaled(10.0))
