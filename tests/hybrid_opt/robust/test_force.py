"""Robust forces, also along a path: closed forms at rest, sampled cases, slopes by differences."""

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
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, RobustPath
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


STEP = 1e-4


@pytest.mark.parametrize("leader", [0, 1])
def test_forces_and_slopes_are_those_of_the_motion(leader: int) -> None:
    rng = np.random.default_rng(7)
    first, second = rng.normal(scale=0.5, size=(2, SAMPLES, 6))
    a, w = rng.normal(size=SAMPLES), rng.uniform(0.1, 1.0, SAMPLES)
    pose = motion().pose

    def forces(a: Array, w: Array) -> Array:
        moving = BoxMotion(pose, first * np.sqrt(w)[:, None], np.outer(a, np.ones(6)) * first)
        moving.second_rate[:] += second * w[:, None]
        found = model().robust_force(moving, leader=leader)
        both = [found.leading, found.commanded]
        return np.stack(both if leader == 0 else both[::-1], axis=1)

    robust = RobustPath(cell(), leader=leader)
    points = PathPoints(pose, first, second, a, w)
    value, whole = robust.at(points)
    slope = whole[:, :, BY_TIMING]
    np.testing.assert_allclose(value, forces(a, w), rtol=1e-7)
    by_a = (forces(a + STEP, w) - forces(a - STEP, w)) / (2.0 * STEP)
    by_w = (forces(a, w + STEP) - forces(a, w - STEP)) / (2.0 * STEP)
    np.testing.assert_allclose(slope[..., 0], by_a, atol=1e-3)
    np.testing.assert_allclose(slope[..., 1], by_w, atol=1e-3)
    for k, entry in ((0, 0), (1, 4), (2, 2)):
        ends = []
        for sign in (1.0, -1.0):
            moved = [pose.copy(), first.copy(), second.copy()]
            moved[k][:, entry] += sign * STEP
            ends.append(robust.at(PathPoints(moved[0], moved[1], moved[2], a, w))[0])
        difference = (ends[0] - ends[1]) / (2.0 * STEP)
        np.testing.assert_allclose(whole[:, :, 6 * k + entry], difference, atol=2e-3)
    # Where a force is above a level, the same; nowhere else.
    level = np.full(SAMPLES, float(np.median(value.max(axis=1))))
    rows, force, beyond = robust.beyond(points, level)
    np.testing.assert_array_equal(rows, np.flatnonzero(value.max(axis=1) > level))
    assert 0 < len(rows) < SAMPLES
    np.testing.assert_allclose(force, value[rows], rtol=1e-9)
    np.testing.assert_allclose(beyond, whole[rows], rtol=1e-6, atol=1e-6)


def test_they_are_convex_and_have_slopes_at_rest() -> None:
    """Between two places no higher than the line, and never below a tangent."""
    rng = np.random.default_rng(8)
    first, second = rng.normal(scale=0.5, size=(2, SAMPLES, 6))
    forces, pose = RobustPath(cell()), motion().pose
    still = np.zeros(SAMPLES)
    a, w = rng.normal(size=SAMPLES), rng.uniform(0.0, 1.0, SAMPLES)
    begin, whole = forces.at(PathPoints(pose, first, second, still, still))
    slope = whole[:, :, BY_TIMING]
    end, _ = forces.at(PathPoints(pose, first, second, a, w))
    middle, _ = forces.at(PathPoints(pose, first, second, a / 2.0, w / 2.0))
    assert np.isfinite(slope).all()
    assert (middle <= (begin + end) / 2.0 + 1e-5).all()
    tangent = begin + slope[..., 0] * a[:, None] + slope[..., 1] * w[:, None]
    assert (end >= tangent - 1e-5).all()


def test_a_set_that_nothing_holds_is_refused() -> None:
    lost = replace(hand_cell(), uncertainty=Uncertainty(friction=1.0))
    with pytest.raises(SettingsError, match="no friction"):
        RobustPath(lost)
