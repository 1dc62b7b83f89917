"""Hands that hold by themselves, against makers' formulas, springs, and conic programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import clarabel
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import BoxMotion
from hybrid_opt.robust.force import interpreted_robust_model
from symbolic.array import Array
from symbolic.contact.elastic import kern, layer_shares
from symbolic.contact.force_closure import wrench_to_box
from symbolic.contact.holding_hands import (
    HandPatch,
    HoldingHands,
    SharingHand,
    internal_force_needs,
    required_holding_forces,
    yielded,
)
from symbolic.contact.load import load_function
from symbolic.contact.registry import contact_model, require_squeeze
from symbolic.errors import SettingsError, WorkcellError
from symbolic.read.cell import load
from symbolic.records import Contact, Workcell
from symbolic.records.poses import box_rotation, transform
from tests.refusals import refused
from tests.symbolic.cells import RACK, call, standing_text
from tests.symbolic.contact.oracle import solved

RADIUS, FRICTION = 0.04, 0.5

DISC = Contact(np.eye(4), FRICTION, RADIUS, kind="magnet", holding_force=100.0)
CUP = replace(DISC, kind="cup")
FINGER = replace(DISC, kind="fingers", half_sides=(0.03, 0.02), patch_radius=0.0360555)
HANDS = {"disc": DISC, "cup": CUP, "finger": FINGER}

SEEDS = st.integers(0, 2**31)


def needed(hand: Contact, wrench: Array) -> Array:
    """(2,) forces against lifting and against sliding [N]."""
    found = required_holding_forces(ca.DM(wrench), hand.friction, HandPatch.of(hand))
    return np.array([float(value) for value in found])


def random_hands(seed: int, count: int) -> tuple[Contact, ...]:
    """Hands of all kinds with any places and normals within a box of 0.4 m."""
    rng, kinds = np.random.default_rng(seed), list(HANDS.values())
    return tuple(
        replace(
            kinds[k % 3],
            T_box_pad=transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.2, 0.2, 3)),
            layer_shear=rng.uniform(0.1, 2.0),
            layer_stiffness=rng.uniform(0.2, 5.0),
        )
        for k in range(count)
    )


def random_load(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(0.0, 50.0, 3), rng.normal(0.0, 5.0, 3)])


def points_of(hand: Contact, count: int) -> tuple[Array, Array]:
    """(n, 2) points of a patch, and their shares (n,) of its area, exact for second moments."""
    nodes, doubled = np.polynomial.legendre.leggauss(count)
    if hand.half_sides is not None:
        x, y = np.meshgrid(*[side * nodes for side in hand.half_sides])
        return np.column_stack([x.ravel(), y.ravel()]), np.outer(doubled, doubled).ravel() / 4.0
    angle = 2.0 * np.pi * np.arange(4 * count) / (4 * count)
    # Even in the squared radius: each ring stands for as much area.
    at, weight = np.sqrt((nodes + 1.0) / 2.0), doubled / 2.0
    if hand.is_ring:
        at, weight = np.ones(1), np.ones(1)
    r, phi = (each.ravel() for each in np.meshgrid(at, angle))
    points = hand.patch_radius * np.column_stack([r * np.cos(phi), r * np.sin(phi)])
    return points, np.tile(weight, len(angle)) / len(angle)


# --- one cup without moments: J. Schmalz GmbH, basic principles of vacuum technology ---


def held_by_one_cup(normal: Array, acceleration: Array, mass: float = 6.0) -> float:
    """Needed holding force of a cup at the centre of mass, for one acceleration."""
    z = np.asarray(normal)
    x = np.cross([0.0, 1.0, 0.0], z) if abs(z[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    axes = np.column_stack([x, np.cross(z, x), z])
    cup = replace(CUP, T_box_pad=transform(axes, np.zeros(3)))
    load = np.concatenate([mass * (acceleration + np.array([0.0, 0.0, 9.80665])), np.zeros(3)])
    return float(needed(cup, layer_shares((cup,))[0] @ load).max())


@pytest.mark.parametrize("a", [0.0, 1.5, 5.0])
def test_one_cup_without_moments_needs_what_makers_say(a: float) -> None:
    m, g, mu = 6.0, 9.80665, FRICTION
    above, beside = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
    lifted, along = np.array([0.0, 0.0, a]), np.array([a, 0.0, 0.0])
    assert held_by_one_cup(above, lifted) == pytest.approx(m * (g + a), rel=1e-9)
    assert held_by_one_cup(above, along) == pytest.approx(m * (g + a / mu), rel=1e-9)
    assert held_by_one_cup(beside, lifted) == pytest.approx(m / mu * (g + a), rel=1e-9)


# --- the split ---


def split_by_springs(hands: tuple[Contact, ...], load: Array) -> Array:
    """(n, 6) wrenches of hands whose patches are grids of springs: the least elastic energy that
    balances a load, as one program over the forces of all springs."""
    maps, compliance, owners = [], [], []
    for k, hand in enumerate(hands):
        for place, share in zip(*points_of(hand, 6), strict=True):
            x, y = place
            lever = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
            maps.append(np.vstack([np.eye(3), lever]))
            along = hand.layer_stiffness * np.array([hand.layer_shear, hand.layer_shear, 1.0])
            compliance.append(1.0 / (share * hand.area * along))
            owners.append(k)
    to_box = np.hstack([wrench_to_box(hands[k]) @ own for k, own in zip(owners, maps, strict=True)])
    # min 1/2 f C f  s.t.  B f = load; with g = sqrt(C) f the least norm.
    root = np.sqrt(np.concatenate(compliance))
    forces = np.linalg.lstsq(to_box / root, load, rcond=None)[0] / root
    wrenches = np.zeros((len(hands), 6))
    for j, k in enumerate(owners):
        wrenches[k] += maps[j] @ forces[3 * j : 3 * j + 3]
    return wrenches


@pytest.mark.parametrize("seed", range(4))
def test_hands_share_a_load_like_grids_of_springs(seed: int) -> None:
    hands, load = random_hands(seed, 2 + seed), random_load(seed)
    found = layer_shares(hands) @ load
    expected = split_by_springs(hands, load)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())


@given(seed=SEEDS, count=st.integers(1, 6))
def test_shares_balance_the_load(seed: int, count: int) -> None:
    hands, load = random_hands(seed, count), random_load(seed)
    wrenches = layer_shares(hands) @ load
    total = sum(wrench_to_box(hand) @ own for hand, own in zip(hands, wrenches, strict=True))
    np.testing.assert_allclose(total, load, atol=1e-9 * np.abs(load).max())


@given(seed=SEEDS)
def test_the_box_frame_does_not_matter(seed: int) -> None:
    hands, load = random_hands(seed, 3), random_load(seed)
    rng = np.random.default_rng(seed)
    T = transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))
    moved = tuple(replace(hand, T_box_pad=T @ hand.T_box_pad) for hand in hands)
    force, moment = T[:3, :3] @ load[:3], T[:3, :3] @ load[3:]
    other = np.concatenate([force, moment + np.cross(T[:3, 3], force)])
    np.testing.assert_allclose(layer_shares(moved) @ other, layer_shares(hands) @ load, atol=1e-7)


@given(seed=SEEDS)
def test_mirrored_hands_need_the_same(seed: int) -> None:
    """Half a turn about z exchanges both hands of a pair and turns the load."""
    (first, _), load = random_hands(seed, 2), random_load(seed)
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    hands = first, replace(first, T_box_pad=half @ first.T_box_pad)
    turned = np.concatenate([half[:3, :3] @ load[:3], half[:3, :3] @ load[3:]])
    own, other = layer_shares(hands) @ load, layer_shares(hands) @ turned
    np.testing.assert_allclose(own[0], other[1], atol=1e-8)
    np.testing.assert_allclose(own[1], other[0], atol=1e-8)


# --- what a hand needs ---


@given(seed=SEEDS, name=st.sampled_from(sorted(HANDS)), factor=st.floats(0.1, 10.0))
def test_needs_grow_with_the_load_and_add_up_at_most(seed: int, name: str, factor: float) -> None:
    hand, one, other = HANDS[name], random_load(seed), random_load(seed + 1)
    alone = needed(hand, one)
    np.testing.assert_allclose(needed(hand, factor * one), factor * alone, rtol=1e-6, atol=1e-6)
    assert (needed(hand, one + other) <= alone + needed(hand, other) + 1e-6).all()


@given(seed=SEEDS, name=st.sampled_from(("disc", "cup")), angle=st.floats(-np.pi, np.pi))
def test_the_spin_of_a_round_hand_does_not_matter(seed: int, name: str, angle: float) -> None:
    wrench, turn = random_load(seed), Rotation.from_euler("z", angle).as_matrix()
    spun = np.concatenate([turn @ wrench[:3], turn @ wrench[3:]])
    np.testing.assert_allclose(needed(HANDS[name], spun), needed(HANDS[name], wrench), rtol=1e-9)


@given(seed=SEEDS, name=st.sampled_from(sorted(HANDS)))
def test_a_rim_lifts_where_the_least_pressure_of_a_layer_vanishes(seed: int, name: str) -> None:
    """A layer's pressure is linear over its patch: the least force under which no point of its rim
    pulls, with the slope from moments of a grid."""
    hand, wrench = HANDS[name], random_load(seed)
    points, share = points_of(hand, 3)
    if hand.half_sides is None:
        around = 2.0 * np.pi * np.arange(360) / 360.0
        edge = hand.patch_radius * np.column_stack([np.cos(around), np.sin(around)])
    else:
        edge = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * np.array(hand.half_sides)
    # Pressure a + b x + c y: moments M_x = sum y p, M_y = -sum x p fix b and c.
    x, y = points.T
    bend = np.array([[share @ (x * y), share @ (y * y)], [-share @ (x * x), -share @ (x * y)]])
    slope = np.linalg.solve(bend, wrench[3:5])
    least = float((-(edge @ slope)).max() - wrench[2])
    assert needed(hand, wrench)[0] == pytest.approx(least, rel=1e-4, abs=1e-4 * abs(wrench).max())


def least_against_sliding(hand: Contact, wrench: Array, count: int) -> float:
    """Least force under which friction of an even pressure on a grid bears a wrench."""
    points, share = points_of(hand, count)
    n = len(points)
    # Unknowns: P, then the tangential forces (n, 2) of the points.
    balance = np.zeros((3, 1 + 2 * n))
    balance[0, 1::2] = balance[1, 2::2] = 1.0
    balance[2, 1::2], balance[2, 2::2] = -points[:, 1], points[:, 0]
    scale = RADIUS
    balance[2] /= scale
    right = np.array([wrench[0], wrench[1], wrench[5] / scale])
    cones = np.zeros((3 * n, 1 + 2 * n))
    cones[::3, 0] = -hand.friction * share
    cones[1::3, 1::2] = cones[2::3, 2::2] = -np.eye(n)
    cost = np.zeros(1 + 2 * n)
    cost[0] = 1.0
    blocks = [
        (balance, right, [clarabel.ZeroConeT(3)]),
        (cones, np.zeros(3 * n), [clarabel.SecondOrderConeT(3)] * n),
    ]
    found = solved(np.zeros((1 + 2 * n,) * 2), cost, blocks)
    assert found is not None
    return float(found[0] - wrench[2])


RECTANGLES = {
    f"{x:g} to {y:g}": replace(
        FINGER, half_sides=(0.005 * x, 0.005 * y), patch_radius=0.005 * np.hypot(x, y)
    )
    for x, y in [(1.0, 1.0), (2.0, 1.0), (1.0, 3.0), (5.0, 1.0), (10.0, 1.0)]
}


@pytest.mark.parametrize("name", [*sorted(HANDS), *RECTANGLES])
@pytest.mark.parametrize("lever", [0.0, 0.1, 0.2, 0.3, 0.7, 1.5, 100.0])
def test_sliding_needs_what_even_pressure_bears(name: str, lever: float) -> None:
    """Torsion in radii times the tangential force; the model is on the safe side."""
    hand, beyond = (HANDS | RECTANGLES)[name], {"disc": 0.022, "cup": 0.031}.get(name, 0.25)
    for angle in (0.0, 0.6, 1.57):
        tangential = np.array([np.cos(angle), np.sin(angle)]) / (1.0 + lever) * 40.0
        torsion = lever / (1.0 + lever) * 40.0 * hand.patch_radius
        wrench = np.array([*tangential, 0.0, 0.0, 0.0, torsion])
        exact = least_against_sliding(hand, wrench, 8)
        assert -4e-3 < needed(hand, wrench)[1] / exact - 1.0 < beyond


def test_a_cups_lip_has_the_moments_of_a_ring() -> None:
    assert kern(CUP) == (RADIUS / 2.0,) * 2
    assert kern(DISC) == (RADIUS / 4.0,) * 2


# --- hands that yield ---


def sharing(hands: Sequence[Contact]) -> list[SharingHand]:
    shares = layer_shares(hands)
    return [
        SharingHand(ca.DM(share), ca.DM(wrench_to_box(hand)), hand.friction, HandPatch.of(hand))
        for hand, share in zip(hands, shares, strict=True)
    ]


def borne(hands: Sequence[SharingHand], load: Array) -> Array:
    """(n, 6) wrenches of hands after they have yielded."""
    return np.array([np.array(own).ravel() for own in yielded(ca.DM(load), hands)])


@given(seed=SEEDS, count=st.integers(1, 6), factor=st.floats(0.1, 10.0))
def test_hands_that_yield_balance_the_load(seed: int, count: int, factor: float) -> None:
    hands, load = random_hands(seed, count), random_load(seed)
    wrenches = borne(sharing(hands), load)
    total = sum(wrench_to_box(hand) @ own for hand, own in zip(hands, wrenches, strict=True))
    np.testing.assert_allclose(total, load, atol=1e-9 * np.abs(load).max())
    scaled = borne(sharing(hands), factor * load)
    np.testing.assert_allclose(scaled, factor * wrenches, atol=1e-6 * np.abs(scaled).max())


@given(seed=SEEDS, count=st.integers(1, 6))
def test_hands_do_not_yield_while_a_rim_lifts_first(seed: int, count: int) -> None:
    hands, load = random_hands(seed, count), random_load(seed)
    hands = tuple(replace(hand, friction=20.0) for hand in hands)
    shares = layer_shares(hands) @ load
    lifting, sliding = np.max([needed(*each) for each in zip(hands, shares, strict=True)], axis=0)
    assume(lifting >= sliding)
    np.testing.assert_allclose(borne(sharing(hands), load), shares, atol=1e-9)


def least_of_any_share(hands: Sequence[Contact], load: Array) -> float:
    """Least holding force of round hands under which any balance of a load exists: a conic program
    over the wrenches of all hands."""
    n = len(hands)
    cost, balance = np.zeros(1 + 6 * n), np.zeros((6, 1 + 6 * n))
    cost[0] = 1.0
    blocks = [(balance, load, [clarabel.ZeroConeT(6)])]
    for k, hand in enumerate(hands):
        own = slice(1 + 6 * k, 7 + 6 * k)
        balance[:, own] = wrench_to_box(hand)
        patch = HandPatch.of(hand)
        lift, slide = np.zeros((3, 1 + 6 * n)), np.zeros((4, 1 + 6 * n))
        lift[0, [0, 3 + 6 * k]] = slide[0, [0, 3 + 6 * k]] = -1.0
        for row, entry in enumerate((3, 4), 1):
            lift[row, 1 + 6 * k + entry] = -1.0 / patch.kern[0]
        # Without the product of force and torsion: a lower bound.
        lengths = (1.0, 1.0, float(patch.twist))
        for row, (entry, length) in enumerate(zip((0, 1, 5), lengths, strict=True), 1):
            slide[row, 1 + 6 * k + entry] = -1.0 / (hand.friction * length)
        blocks += [(lift, np.zeros(3), [clarabel.SecondOrderConeT(3)])]
        blocks += [(slide, np.zeros(4), [clarabel.SecondOrderConeT(4)])]
    found = solved(np.zeros((1 + 6 * n,) * 2), cost, blocks)
    assert found is not None
    return float(found[0])


@given(seed=SEEDS, count=st.integers(2, 5))
def test_no_share_holds_with_less_than_the_best_one(seed: int, count: int) -> None:
    """All normals are parallel: facing hands could squeeze, and the program would have no end."""
    load, down = random_load(seed), np.diag([1.0, -1.0, -1.0])
    hands = [
        replace(hand, T_box_pad=transform(down, hand.T_box_pad[:3, 3]))
        for hand in random_hands(seed, 3 * count)
        if hand.half_sides is None
    ]
    wrenches = borne(sharing(hands), load)
    found = max(needed(*each).max() for each in zip(hands, wrenches, strict=True))
    least = least_of_any_share(hands, load)
    assert found >= least - 1e-5 * max(1.0, abs(least))


@pytest.mark.parametrize("pushed", [0.3, 0.6, 0.9])
def test_a_pressed_hand_takes_over_what_a_pulled_one_cannot_bear(pushed: float) -> None:
    """Two cups in a line along the load, of which a moment presses one and pulls the other: they
    slide together once the friction of both is used up."""
    ahead, behind = (
        replace(CUP, T_box_pad=transform(np.diag([1.0, -1.0, -1.0]), np.array([x, 0.0, 0.0])))
        for x in (0.1, -0.1)
    )
    along, hands = 60.0, (ahead, behind)
    load = np.array([along, 0.0, 0.0, 0.0, 0.0, 0.0])
    load[4] = pushed * along / FRICTION * 0.1
    together = along / FRICTION / 2.0
    own = layer_shares(hands) @ load
    alone = max(needed(*each)[1] for each in zip(hands, own, strict=True))
    wrenches = borne(sharing(hands), load)
    found = max(needed(*each).max() for each in zip(hands, wrenches, strict=True))
    assert alone > 1.1 * together
    assert together * (1.0 - 1e-9) <= found < together + 0.5 * (alone - together)


# --- a cell ---


CELLS = ("palletising", "plate")


@cache
def hands_cell(name: str) -> Workcell:
    return load(RACK.with_name(f"{name}.toml"))


@cache
def load_of_cell(name: str) -> ca.Function:
    return load_function(hands_cell(name))


@given(seed=SEEDS, name=st.sampled_from(CELLS))
def test_an_arm_needs_what_its_most_loaded_hand_needs(seed: int, name: str) -> None:
    cell = hands_cell(name)
    pose, rate, second = np.random.default_rng(seed).normal(0.0, 0.4, (3, 6))
    found = call(load_of_cell(name), pose, rate, second)
    rotation = box_rotation(cell.task.orientation, pose)
    wrench = np.zeros(6)
    for i, contact in enumerate(cell.contacts):
        force, moment = (rotation.T @ part for part in np.split(found[f"wrench_{i + 1}"], 2))
        wrench += [*force, *(moment + np.cross(contact.T_box_pad[:3, 3], force))]
    total = sum(rotation.T @ force for force in np.split(found["contact_force"], 2))
    np.testing.assert_allclose(wrench[:3], total, atol=1e-9)
    about = rotation.T @ found["required_moment"] + np.cross(cell.payload.centre_of_mass, total)
    np.testing.assert_allclose(wrench[3:], about, atol=1e-9)
    model = HoldingHands(cell)
    hands = model.sharing(ca.DM([contact.friction for contact in cell.contacts]))
    expected = np.zeros(2)
    for pad, i, own in zip(cell.pads, cell.pad_robots, borne(hands, wrench), strict=True):
        expected[i] = max(expected[i], *needed(pad, own))
    np.testing.assert_allclose(found["normal_force"], expected, rtol=1e-9, atol=1e-9)
    most = cell.contacts[0].friction * found["normal_force"]
    assert (found["tangential_force"] <= most + 1e-9).all()


@given(seed=SEEDS)
def test_opposed_arms_ask_for_no_more_than_their_bound(seed: int) -> None:
    hands, robots = random_hands(seed, 4), (0, 0, 1, 1)
    bounds = internal_force_needs(hands, robots)
    push = np.random.default_rng(seed).normal(size=3)
    found = pushed_by_springs(hands, robots) @ push / np.linalg.norm(push)
    for hand, own, bound in zip(hands, found, bounds, strict=True):
        assert (needed(hand, own) <= opposed_need(hand, bound) * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("name", CELLS)
def test_the_bound_of_opposed_arms_is_what_their_worst_direction_asks_for(name: str) -> None:
    cell = hands_cell(name)
    bounds = internal_force_needs(cell.pads, cell.pad_robots)
    pushes = np.random.default_rng(1).normal(size=(1000, 3))
    pushes /= np.linalg.norm(pushes, axis=1)[:, None]
    by_push = pushed_by_springs(cell.pads, cell.pad_robots)
    for hand, own, bound in zip(cell.pads, by_push, bounds, strict=True):
        most = np.max([needed(hand, own @ push) for push in pushes], axis=0)
        np.testing.assert_array_less(most, opposed_need(hand, bound) * (1.0 + 1e-9))
        np.testing.assert_allclose(most, opposed_need(hand, bound), rtol=0.02)


def opposed_need(hand: Contact, bound: Array) -> Array:
    """(2,) bounds against lifting and against sliding, from a row of `internal_force_needs`."""
    a, b, c, lifting = bound
    return np.array([lifting, np.sqrt(a / hand.friction**2 + b / hand.friction + c)])


def pushed_by_springs(hands: Sequence[Contact], robots: Sequence[int]) -> Array:
    """(n, 6, 3) wrenches of hands whose patches are grids of springs, per newton along each axis
    with which the second arm pushes a free box against the first. No arm turns."""
    whole, moved, springs = np.zeros((6, 6)), np.zeros((6, 3)), []
    for hand, robot in zip(hands, robots, strict=True):
        R, origin = hand.T_box_pad[:3, :3], hand.T_box_pad[:3, 3]
        shear = hand.layer_shear
        for place, share in zip(*points_of(hand, 6), strict=True):
            K = share * hand.area * hand.layer_stiffness * R @ np.diag([shear, shear, 1.0]) @ R.T
            at = R[:, :2] @ place
            # Displacement of the box at the point by its own translation and rotation.
            follows = np.hstack([np.eye(3), -skew(origin + at)])
            whole += follows.T @ K @ follows
            moved += robot * follows.T @ K
            springs.append((K, follows, at))
    box, pushes = np.linalg.solve(whole, moved), np.zeros((3, 3))
    found, remaining = np.zeros((len(hands), 6, 3)), iter(springs)
    for k, (hand, robot) in enumerate(zip(hands, robots, strict=True)):
        R = hand.T_box_pad[:3, :3]
        for _ in points_of(hand, 6)[0]:
            K, follows, at = next(remaining)
            force = K @ (robot * np.eye(3) - follows @ box)
            found[k] += np.vstack([R.T @ force, R.T @ skew(at) @ force])
            pushes += robot * force
    return found @ np.linalg.inv(pushes)


def skew(a: Array) -> Array:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@pytest.mark.parametrize("name", CELLS)
def test_robust_forces_hold_random_cases(name: str) -> None:
    cell, rng = hands_cell(name), np.random.default_rng(1)
    model = interpreted_robust_model(cell)
    motion = BoxMotion(*rng.normal(0.0, 0.3, (3, 4, 6)))
    force = model.robust_force(motion)
    assert (force.commanded == force.leading).all()
    assert (force.commanded > 1.3 * force.nominal.max(axis=1)).all()
    assert model.check(motion, force, 500, rng).holds


CUP_KEYS = 'kind = "cup"'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("holding_force = 140.0", "", "holding_force"),
        (CUP_KEYS, "", "holding_force: "),
        ("patch_radius = 0.03", "patch_size = [0.04, 0.04]", "patch_size: "),
        ("samples = 80", "samples = 80\nreference_force = 90.0", "reference_force"),
        ("samples = 80", 'samples = 80\nallocation = "paper"', "task.allocation: "),
    ],
)
def test_what_does_not_fit_hands_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    text = standing_text(RACK.with_name("palletising.toml")).replace(old, new)
    (tmp_path / "cell.toml").write_text(text)
    with refused(WorkcellError, "workcell", said):
        load(tmp_path / "cell.toml")


def with_holding_forces(cell: Workcell, forces: tuple[float, float]) -> Workcell:
    """Return a cell as its file with these holding forces of the arms' hands [N] is read."""
    first, second = (
        replace(
            contact,
            holding_force=force,
            further=tuple(replace(pad, holding_force=force) for pad in contact.further),
        )
        for contact, force in zip(cell.contacts, forces, strict=True)
    )
    task = replace(cell.task, reference_force=np.full(2, min(forces)))
    return replace(cell, contacts=(first, second), task=task)


STRENGTHS = [(140.0, 280.0), (300.0, 100.0), (50.0, 50.0)]


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize("forces", STRENGTHS)
def test_a_force_is_the_same_share_of_the_hands_of_either_arm(
    name: str, forces: tuple[float, float]
) -> None:
    """What hands need does not depend on what they have."""
    cell = with_holding_forces(hands_cell(name), forces)
    motion = np.random.default_rng(2).normal(0.0, 0.4, (3, 6))
    needs = call(load_of_cell(name), *motion)["normal_force"]
    found = call(load_function(cell), *motion)["normal_force"]
    np.testing.assert_allclose(found / cell.task.reference_force, needs / np.array(forces))
    held = contact_model(cell).held_with(found)
    np.testing.assert_allclose(found / held, needs / np.array(forces))


@pytest.mark.parametrize("name", CELLS)
def test_robust_forces_follow_the_hands_that_need_the_larger_share(name: str) -> None:
    """Stronger hands of one arm lower the share that both need, and only until the other arm
    decides; hands that are all stronger need the same force."""
    cell, rng = hands_cell(name), np.random.default_rng(1)
    motion = BoxMotion(*rng.normal(0.0, 0.3, (3, 4, 6)))

    def commanded(first: float, second: float) -> Array:
        model = interpreted_robust_model(with_holding_forces(cell, (first, second)))
        force = model.robust_force(motion)
        assert (force.commanded == force.leading).all()
        assert model.check(motion, force, 200, np.random.default_rng(3)).holds
        return np.asarray(force.commanded)

    equal = commanded(140.0, 140.0)
    np.testing.assert_allclose(commanded(200.0, 200.0), equal, rtol=1e-9)
    alone = [commanded(140.0, 1e5), commanded(1e5, 140.0)]
    np.testing.assert_allclose(np.max(alone, axis=0), equal, rtol=1e-9)
    between = commanded(140.0, 160.0)
    assert (between <= equal * (1.0 + 1e-9)).all()
    assert (between >= alone[0] * (1.0 - 1e-9)).all()


def test_hands_of_unequal_force_are_read(tmp_path: Path) -> None:
    text = standing_text(RACK.with_name("palletising.toml"))
    text = text.replace("holding_force = 140.0", "holding_force = 120.0", 1)
    (tmp_path / "cell.toml").write_text(text)
    task = load(tmp_path / "cell.toml").task
    assert task.reference_force.tolist() == [120.0, 120.0]
    assert task.force_limit[1] == 120.0


def test_what_squeezes_is_refused_to_hands() -> None:
    with refused(SettingsError, "needs-pads"):
        require_squeeze(hands_cell("palletising"), "a job")


def test_cups_come_along_their_normals_and_fingers_across_them_from_outside() -> None:
    for name, normal in (("palletising", [0.0, 0.0, -1.0]), ("plate", None)):
        cell = load(RACK.with_name(f"{name}.toml"))
        for arm, contact in enumerate(cell.contacts):
            way = contact_model(cell).approach(arm)
            assert np.linalg.norm(way) == pytest.approx(1.0)
            if normal is not None:
                np.testing.assert_allclose(way, normal, atol=1e-12)
            else:
                assert way @ contact.T_box_pad[:3, 2] == pytest.approx(0.0, abs=1e-12)
                assert way @ contact.T_box_pad[:3, 3] < 0.0
