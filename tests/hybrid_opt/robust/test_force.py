"""Robust forces, also along a path: closed forms at rest, sampled cases, slopes by differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from codegen.lanes import lane_text
from codegen.source import dense, generated_c
from hybrid_opt.carry import BoxMotion, at_rest
from hybrid_opt.evaluate.objectives import OBJECTIVES
from hybrid_opt.robust.cases import nominal_case, random_cases, worst_cases
from hybrid_opt.robust.force import (
    BATCH,
    HOLDS,
    LARGEST_FACTOR,
    SAMPLES,
    SCREENED,
    RobustModel,
    allowed_factor,
)
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, RobustPath
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.contact.worst_cases import CASE_SIZES, case_squeeze_function
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import Uncertainty
from symbolic.records.cell import RANGES
from tests.refusals import refused
from tests.symbolic.cells import RACK, hand_cell, rack_cell, with_contacts
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
SMALL = Uncertainty(0.08, 0.05, np.full(3, 0.004), 0.003, np.array([0.2, 0.0, 0.3]))
WIDE = Uncertainty(0.2, 0.05, np.full(3, 0.01), 0.005, np.full(3, 0.3))
FRICTION = 0.8
POINTS = 12

SETS = {"hand": SET, "rack": WIDE}
"""Of cells with pads that face one another; others have `SMALL`."""

ANYWHERE = ["drum", "fork", pytest.param("corner", marks=pytest.mark.slow)]


@cache
def model(name: str = "hand") -> RobustModel:
    """Of a cell and its set."""
    if name == "hand":
        cell = with_contacts(hand_cell(), friction=(FRICTION, FRICTION))
    else:
        cell = rack_cell() if name == "rack" else load(RACK.with_name(f"{name}.toml"))
    return RobustModel(replace(cell, uncertainty=SETS.get(name, SMALL)))


def motion(name: str = "hand") -> BoxMotion:
    rng = np.random.default_rng(4)
    if name in SETS:
        parts = [random_motion(rng) for _ in range(POINTS)]
        return BoxMotion(*[np.array(values) for values in zip(*parts, strict=True)])
    # Around the cell's start pose, gently.
    task, rng, n = model(name).workcell.task, np.random.default_rng(2), 6
    pose = np.tile(task.waypoints[0].lower, (n, 1)) + 0.05 * rng.normal(size=(n, 6))
    return BoxMotion(pose, 0.2 * rng.normal(size=(n, 6)), 0.5 * rng.normal(size=(n, 6)))


@pytest.mark.parametrize("leader", [0, 1])
def test_at_rest_the_worst_case_is_told_in_closed_form(leader: int) -> None:
    """Pads in line with the centre of mass: least friction, most mass, worst disturbance.

    The contacts lie across y, N_1 - N_2 is the disturbance's share along it, either way, and each
    pad bears half of the tangential force: the lighter one holds it by friction.
    """
    uncertainty = Uncertainty(0.1, 0.05, np.zeros(3), 0.0, np.array([0.5, 0.3, 0.4]))
    commanded, leading = model().hold(at_rest(), uncertainty, leader)
    mass = 10.0 * 1.05
    tangential = mass * np.hypot(9.81 + 0.4, 0.5)
    along = mass * 0.3
    expected = tangential / (2.0 * 0.9 * FRICTION) + along
    assert commanded[0] == pytest.approx(expected, rel=1e-6)
    assert leading[0] == pytest.approx(expected + along, rel=1e-6)


def test_a_displaced_centre_of_mass_is_held_by_pressing_harder() -> None:
    """50 mm towards a pad: opposed tangential forces of weight times 0.05 / 0.4 carry it, so that
    the nearer pad bears 0.5 + 0.125 of the weight."""
    box = with_contacts(hand_cell(), friction=(0.5, 0.5), patch_radius=(0.01, 0.01))
    uncertainty = Uncertainty(centre_of_mass=np.array([0.0, 0.05, 0.0]))
    commanded, leading = RobustModel(box).hold(at_rest(), uncertainty)
    assert commanded[0] == pytest.approx(98.1 * 0.625 / 0.5, rel=1e-6)
    assert leading[0] == pytest.approx(commanded[0], rel=1e-6)


def test_a_fork_and_a_pad_press_alike() -> None:
    """Opposite normals: what the motion asks along them is the difference, all else is squeeze."""
    force = model("fork").robust_force(at_rest(), Uncertainty(friction=0.1))
    cell = model("fork").workcell
    least = 9.81 * cell.payload.mass / (2.0 * 0.9 * cell.contacts[0].friction)
    assert force.leading == pytest.approx(force.commanded, rel=2e-3)
    assert force.commanded[0] >= least * (1.0 - 1e-6)


@pytest.mark.parametrize(
    ("name", "cases", "share"),
    [
        ("hand", 3000, 0.9),
        ("rack", 4000, 0.75),
        ("drum", 200, 0.85),
        ("fork", 200, 0.85),
        pytest.param("corner", 400, 0.85, marks=pytest.mark.slow),
    ],
)
def test_no_random_case_needs_more_and_some_need_nearly_as_much(
    name: str, cases: int, share: float
) -> None:
    moved = motion(name)
    force = model(name).robust_force(moved)
    assert (force.commanded > force.nominal[:, 1]).all()
    check = model(name).check(moved, force, cases, np.random.default_rng(1))
    assert check.holds
    assert check.cases == cases
    weaker = replace(force, commanded=share * force.commanded)
    assert not model(name).check(moved, weaker, cases, np.random.default_rng(1)).holds


@pytest.mark.parametrize("factor", [0.91, 0.87])
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
    assert check.holds == (factor > 0.9)


def test_cases_within_the_ranges_lie_below_the_vertices() -> None:
    """Each range for itself, so that no other hides what it adds."""
    rng = np.random.default_rng(3)
    for name in RANGES:
        one = replace(Uncertainty(), **{name: getattr(SET, name)})
        force = model().robust_force(motion(), one)
        # Pads that are displaced apart turn the torsion as well, which no vertex has.
        beyond = 3e-3 if name == "relative_position" else HOLDS
        assert model().check(motion(), force, 500, rng).closest < 1.0 + beyond, name
        assert (force.commanded >= (1.0 - 1e-7) * force.nominal[:, 1]).all(), name


def test_leading_arm_feels_no_more_than_told() -> None:
    """In every case the leader's force is the commanded one and the motion's difference."""
    force = model().robust_force(motion())
    rng, worst = np.random.default_rng(5), worst_cases(command_model(model().workcell), SET)
    cases = worst[rng.integers(len(worst), size=200)]
    cases[:, 4] = 10.0 * rng.uniform(0.95, 1.05, 200)
    needed = model().least_squeeze(motion(), cases)
    felt = force.commanded + needed[:, :, 0] - needed[:, :, 1]
    assert (felt <= force.leading * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("name", ANYWHERE)
def test_more_friction_never_needs_more_force(name: str) -> None:
    """And a force is found wherever friction closes the grasp, far from the cell's own too."""
    even, shares = model(name), np.linspace(0.7, 1.3, 61)
    cases = np.tile(nominal_case(even.workcell), (len(shares), 1))
    assert next(iter(CASE_SIZES)) == "friction"
    cases[:, : CASE_SIZES["friction"]] *= shares[:, None]
    force = even.least_squeeze(motion(name), cases)
    assert np.isfinite(force).all()
    assert (np.diff(force, axis=0) < 1e-6 * force[1:]).all()


def test_what_is_commanded_is_known_without_every_case() -> None:
    """Also of more than `SAMPLES` samples: cases that rule at some are asked at all."""
    even, moved = model("drum"), motion("drum")
    commanded, leading = even.hold(moved, SMALL)
    np.testing.assert_allclose(even.commanded(moved, SMALL), commanded, rtol=1e-9)
    above = float(np.median(commanded))
    found = even.commanded(moved, SMALL, above=above)
    np.testing.assert_allclose(found, np.maximum(commanded, above), rtol=1e-9)
    np.testing.assert_allclose(even.peak(moved, SMALL), [leading.max(), commanded.max()], rtol=5e-3)
    at, share = np.arange(6.0), np.linspace(0.0, 5.0, 2 * SAMPLES)
    parts = [
        np.column_stack([np.interp(share, at, column) for column in values.T])
        for values in vars(moved).values()
    ]
    many = BoxMotion(*parts)
    np.testing.assert_allclose(even.commanded(many, SMALL), even.hold(many, SMALL)[0], rtol=1e-4)


def test_forces_have_a_form_in_lanes() -> None:
    """Without it a recommendation would take minutes."""
    function = dense(case_squeeze_function(model("drum").workcell))
    assert lane_text(generated_c([function]), "lanes").entry


def test_the_price_grows_with_the_set_until_it_uses_the_forces_up() -> None:
    def peak(factor: float) -> Array:
        return model().peak(motion(), SET.scaled(factor))

    price, force = [peak(factor) for factor in (0.0, 0.5, 1.0, 1.5)], model().robust_force(motion())
    assert (np.diff(price, axis=0) > 0.0).all()
    np.testing.assert_allclose(price[2], force.peak, rtol=1e-12)
    np.testing.assert_allclose(price[0][1], force.nominal[:, 1].max(), rtol=1e-7)
    limit = 1.2 * force.peak
    factor = model().largest_factor(motion(), limit)
    assert factor > 1.0
    assert (peak(factor) / limit).max() == pytest.approx(1.0, rel=1e-4)
    assert model().largest_factor(motion(), 0.1 * limit) == 0.0
    # Friction is the first to be used up: its share, tilt, and displacements over the distance.
    f = allowed_factor(model().workcell, SET)
    left = (
        np.tan(np.arctan(FRICTION * (1.0 - 0.1 * f)) - 0.03 * f) - (2.0 * 0.004 + 0.002) * f / 0.4
    )
    assert left == pytest.approx(0.0, abs=1e-6)


def test_is_an_objective() -> None:
    found, cell = motion(), model().workcell
    outputs: dict[str, Array] = {name: part[None] for name, part in vars(found).items()}
    value = OBJECTIVES["robust_force"].evaluate(outputs, cell)
    expected = (model().robust_force(found).peak / cell.task.reference_force).max()
    assert value == pytest.approx([expected])


def test_a_set_that_nothing_holds_is_told() -> None:
    """Of the fork nearly no friction is left: its forces are not found."""
    with refused(SettingsError, "no-friction"):
        model().hold(motion(), SET.scaled(10.0))
    lost = replace(hand_cell(), uncertainty=Uncertainty(friction=1.0))
    with pytest.raises(SettingsError, match="friction"):
        RobustPath(lost)
    even, moved = model("fork"), motion("fork")
    assert 0.0 < even.largest_factor(moved, np.full(2, 1e9)) < LARGEST_FACTOR
    widest = SMALL.scaled(allowed_factor(even.workcell, SMALL))
    assert np.isinf(even.peak(moved, widest)).all()
    with refused(SettingsError, "no-force"):
        even.robust_force(moved, widest)


STEP = 1e-4


def points_of(seed: int) -> PathPoints:
    rng = np.random.default_rng(seed)
    first, second = rng.normal(scale=0.5, size=(2, POINTS, 6))
    a, w = rng.normal(size=POINTS), rng.uniform(0.1, 1.0, POINTS)
    return PathPoints(motion().pose, first, second, a, w)


def test_forces_and_slopes_are_those_of_the_motion() -> None:
    points, cell = points_of(7), model().workcell
    robust = RobustPath(cell)
    value, whole = robust.at(points)
    needed = model().robust_force(points.motion)
    expected = np.stack([needed.leading, needed.commanded], axis=1)
    np.testing.assert_allclose(value, expected, rtol=1e-7)
    names = ("pose", "first", "second", "a", "w")
    for k, entry in ((0, [0]), (1, [4]), (2, [2]), (3, []), (4, [])):
        ends = []
        for sign in (1.0, -1.0):
            moved = getattr(points, names[k]).copy()
            moved[(..., *entry)] += sign * STEP
            ends.append(robust.at(replace(points, **{names[k]: moved}))[0])
        difference = (ends[0] - ends[1]) / (2.0 * STEP)
        column = 6 * k + entry[0] if entry else BY_TIMING.start + k - 3
        np.testing.assert_allclose(whole[:, :, column], difference, atol=2e-3)
    # Where a force is above a level, the same; nowhere else.
    level = np.full(POINTS, float(np.median(value.max(axis=1))))
    rows, ruling = robust.governing_above(points, level)
    beyond = robust.slopes(points.at(rows), ruling)
    np.testing.assert_array_equal(rows, np.flatnonzero(value.max(axis=1) > level))
    assert 0 < len(rows) < POINTS
    np.testing.assert_allclose(ruling.force, value[rows], rtol=1e-9)
    np.testing.assert_allclose(beyond, whole[rows], rtol=1e-6, atol=1e-6)


def test_they_are_convex_and_have_slopes_at_rest() -> None:
    """Between two places no higher than the line, and never below a tangent."""
    points, forces = points_of(8), RobustPath(model().workcell)
    a, w = points.a, points.w
    begin, whole = forces.at(replace(points, a=0.0 * a, w=0.0 * w))
    slope = whole[:, :, BY_TIMING]
    end, _ = forces.at(points)
    middle, _ = forces.at(replace(points, a=a / 2.0, w=w / 2.0))
    assert np.isfinite(slope).all()
    assert (middle <= (begin + end) / 2.0 + 1e-5).all()
    tangent = begin + slope[..., 0] * a[:, None] + slope[..., 1] * w[:, None]
    assert (end >= tangent - 1e-5).all()
