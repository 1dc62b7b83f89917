"""Simulated hands: against makers' formulas, and the contact model against them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

pytest.importorskip("mujoco")

from hybrid_opt.carry import box_motion
from hybrid_opt.extras.simulation.box import bisected, carriage_motion
from hybrid_opt.extras.simulation.hand_bodies import ArmStiffness, HandSprings, lip_points
from hybrid_opt.extras.simulation.hand_cases import worst_hand_case
from hybrid_opt.extras.simulation.hands import (
    HAND_SETTINGS,
    HandSimulation,
)
from hybrid_opt.robust.force import interpreted_robust_model
from studies.research.hand_carries import (
    KINDS,
    RESOLUTION,
    SWINGS,
    carry_along,
    draw,
    needed_force,
    threshold,
)
from symbolic.array import Array
from symbolic.contact.elastic import kern
from symbolic.errors import SettingsError
from symbolic.records import Contact, Uncertainty, Workcell
from symbolic.records.cell import HandKind
from symbolic.records.poses import transform
from tests.hybrid_opt.cells import shipped
from tests.refusals import refused
from tests.symbolic.cells import hand_cell

MASS, FRICTION, RADIUS, G = 6.0, 0.5, 0.04, 9.81

SIZE = np.array([0.3, 0.4, 0.2])

ABOVE, BESIDE = "above", "beside"


def two_hands(where: str, kind: HandKind = "cup") -> Workcell:
    """A box held by two hands in line with its centre of mass, which lies between their faces."""
    cell, arms = shipped("palletising").workcell, []
    for side in (1.0, -1.0):
        if where == ABOVE:
            normal, place = np.array([0.0, 0.0, -1.0]), [0.0, 0.12 * side, SIZE[2] / 2.0]
        else:
            normal, place = np.array([0.0, -side, 0.0]), [0.0, side * SIZE[1] / 2.0, 0.0]
        x = np.array([1.0, 0.0, 0.0])
        T = transform(np.column_stack([x, np.cross(normal, x), normal]), np.array(place))
        sides = HALF_SIDES if kind == "fingers" else None
        arms.append(Contact(T, FRICTION, RADIUS, sides, kind=kind, holding_force=1.0))
    centre = np.array([0.0, 0.0, SIZE[2] / 2.0 if where == ABOVE else 0.0])
    inertia = MASS / 12.0 * np.diag(SIZE[[1, 2, 0]] ** 2 + SIZE[[2, 0, 1]] ** 2)
    payload = replace(cell.payload, size=SIZE, mass=MASS, centre_of_mass=centre, inertia=inertia)
    return replace(cell, payload=payload, contacts=(arms[0], arms[1]))


@pytest.mark.parametrize(
    ("where", "acceleration", "needed"),
    [
        (ABOVE, (0.0, 0.0, 0.0), MASS * G / 2.0),
        (ABOVE, (0.0, 0.0, 3.0), MASS * (G + 3.0) / 2.0),
        (ABOVE, (2.0, 0.0, 0.0), MASS * (G + 2.0 / FRICTION) / 2.0),
        (BESIDE, (0.0, 0.0, 0.0), MASS * G / FRICTION / 2.0),
        (BESIDE, (0.0, 0.0, 3.0), MASS * (G + 3.0) / FRICTION / 2.0),
    ],
)
def test_cups_without_moments_need_what_makers_say(
    where: str, acceleration: tuple[float, ...], needed: float
) -> None:
    """J. Schmalz GmbH, basic principles of vacuum technology, for half of the payload each."""
    workcell = two_hands(where)
    motion = carriage_motion(carry_along(workcell, np.zeros(6), 0.3), HAND_SETTINGS)
    simulation = HandSimulation(workcell, disturbance=acceleration)
    found = bisected(partial(simulation.simulate, motion, needed), 0.9, 1.1, 4)
    assert found.factor == pytest.approx(1.0, abs=0.02)


def test_arms_that_pull_against_one_another_lift_a_rim() -> None:
    """One cup of each arm, level, across their faces. Neither arm turns, so each cup also bears
    half of the couple of both. Along their faces a slip relieves both."""
    workcell, pull = two_hands(ABOVE), 8.0
    places = [contact.T_box_pad[1, 3] for contact in workcell.contacts]
    moment = pull * (places[0] - places[1]) / 2.0
    motion = carriage_motion(carry_along(workcell, np.zeros(6), 0.3), HAND_SETTINGS)
    simulation = HandSimulation(workcell, opposed=(0.0, 0.0, pull))
    needed = MASS * G / 2.0 + pull + moment / (RADIUS / 2.0)
    found = bisected(partial(simulation.simulate, motion, needed), 0.9, 1.1, 4)
    assert found.slips.lifts
    assert found.factor == pytest.approx(1.0, abs=0.02)
    along = HandSimulation(workcell, opposed=(0.0, pull, 0.0))
    assert along.simulate(motion, MASS * G / 2.0 + 0.5 * pull / FRICTION).holds


SOFT = ArmStiffness(linear=5e5, angular=2e3)

HALF_SIDES = (0.03, 0.05)

WEIGHT = np.array([0.0, 0.0, MASS * G / 2.0])


def springs(kind: HandKind, where: str, arms: ArmStiffness | None) -> tuple[Array, Array]:
    """Stiffness (3,) of one hand in series with its arm along the axes of the box [N/m], and about
    them [N m/rad]: sums over the springs of a ring, a disc or a rectangle."""
    x, y = HALF_SIDES if kind == "fingers" else (RADIUS, RADIUS)
    share = {"cup": 2.0, "magnet": 4.0, "fingers": 3.0}[kind]
    area = 4.0 * x * y if kind == "fingers" else np.pi * RADIUS**2
    normal, squares = HAND_SETTINGS.layer * area, np.array([x**2, y**2]) / share
    shear = normal / 3.0
    along = np.array([shear, shear, normal])
    about = np.array([normal * squares[1], normal * squares[0], shear * squares.sum()])
    if where == BESIDE:
        along, about = along[[0, 2, 1]], about[[0, 2, 1]]
    if arms is not None:
        along = 1.0 / (1.0 / along + 1.0 / arms.linear)
        about = 1.0 / (1.0 / about + 1.0 / arms.angular)
    return along, about


def test_the_worst_case_of_the_model_is_as_hard_as_it_says() -> None:
    """The arms pull apart across the faces of two level cups, each of which also bears half of the
    couple: what the model commands is what this takes."""
    doubt, pull = Uncertainty(mass=0.1, tracking=0.2, internal_force=8.0), 8.0
    workcell = replace(two_hands(ABOVE), uncertainty=doubt)
    carry = carry_along(workcell, np.zeros(6), 0.3)
    model = interpreted_robust_model(workcell)
    force = float(model.commanded(box_motion(carry), doubt, 0).max())
    moment = pull * float(np.ptp([c.T_box_pad[1, 3] for c in workcell.contacts])) / 2.0
    needed = (1.1 * MASS * G / 2.0 + pull + moment / (RADIUS / 2.0)) / 0.8
    assert force == pytest.approx(needed, rel=1e-3)
    case = worst_hand_case(carry, model)
    np.testing.assert_allclose(np.abs(case.opposed), [0.0, 0.0, pull], atol=0.05 * pull)
    motion = carriage_motion(carry, HAND_SETTINGS)
    simulate = partial(case.simulate, motion, np.full(2, force), settings=HAND_SETTINGS)
    assert simulate(0.98).lifts
    assert simulate(1.02).holds


@pytest.mark.parametrize("arms", [None, SOFT])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("where", [ABOVE, BESIDE])
def test_a_displaced_arm_loads_layers_and_arms_as_springs_in_series(
    where: str, axis: int, arms: ArmStiffness | None
) -> None:
    """Two equal springs in series, whose moments turn the payload between arms that do not turn:
    each bears half of the couple with its stiffness against that rotation. Both cups are in line
    along y: across this line the payload turns."""
    workcell, pull = two_hands(where), 8.0 * np.eye(3)[axis]
    along, about = springs("cup", where, arms)
    distance = float(np.ptp([contact.T_box_pad[1, 3] for contact in workcell.contacts]))
    turning = about[2 - axis] if axis != 1 else np.inf
    compliance = 2.0 / along[axis] + distance**2 / (2.0 * turning)
    motion = carriage_motion(carry_along(workcell, np.zeros(6), 0.3), HAND_SETTINGS)
    simulation = HandSimulation(workcell, opposed=pull, arms=arms)
    expected = np.linalg.norm(simulation.displacement) / compliance
    assert expected == pytest.approx(8.0, rel=1e-6)
    found = in_box(workcell, simulation.simulate(motion, 200.0).wrench[:, :3]) - WEIGHT
    for force, sign in zip(found, (-1.0, 1.0), strict=True):
        np.testing.assert_allclose(force, sign * pull, atol=0.035 * float(expected))


@pytest.mark.parametrize(
    ("kind", "where", "arms"),
    [
        ("cup", ABOVE, None),
        ("magnet", BESIDE, SOFT),
        ("fingers", ABOVE, SOFT),
        ("fingers", BESIDE, None),
    ],
)
def test_a_turned_arm_loads_layers_and_arms_as_springs_in_series(
    kind: HandKind, where: str, arms: ArmStiffness | None
) -> None:
    """About all three axes at once. The payload turns by an angle at which both hands' moments and
    the couple of their forces, at -a and a on the y axis, balance."""
    workcell = two_hands(where, kind)
    along, about = springs(kind, where, arms)
    a = workcell.contacts[0].T_box_pad[1, 3]
    # About x the payload moves along z at the hands, and about z along x; about y not at all.
    couple = a**2 * along[[2, 1, 0]] * [1.0, 0.0, 1.0]
    angle = 0.5 / about
    turned = about * angle / (2.0 * (about + couple))
    motion = carriage_motion(carry_along(workcell, np.zeros(6), 0.3), HAND_SETTINGS)
    wrench = HandSimulation(workcell, turned=angle, arms=arms).simulate(motion, 200.0).wrench
    moments, forces = in_box(workcell, wrench[:, 3:]), in_box(workcell, wrench[:, :3]) - WEIGHT
    moved = np.cross(turned, [0.0, a, 0.0])
    np.testing.assert_allclose(moments, [-about * turned, about * (angle - turned)], atol=0.015)
    np.testing.assert_allclose(
        forces, [-along * moved, along * moved], atol=0.035 * np.abs(along * moved).max()
    )


def in_box(workcell: Workcell, values: Array) -> Array:
    """Vectors (2, 3) of both hands along the axes of the box."""
    turned = np.array([contact.T_box_pad[:3, :3] for contact in workcell.contacts])
    return np.asarray(np.einsum("nij,nj->ni", turned, values))


def test_a_rim_lifts_where_the_pressure_leaves_the_kern() -> None:
    """Accelerated across the line of both cups, with the centre of mass below them."""
    workcell = two_hands(ABOVE)
    payload = replace(workcell.payload, centre_of_mass=np.zeros(3))
    workcell = replace(workcell, payload=payload)
    a = 3.0
    moment = MASS * a * SIZE[2] / 2.0
    needed = (moment / (RADIUS / 2.0) + MASS * G) / 2.0
    motion = carriage_motion(carry_along(workcell, np.zeros(6), 0.3), HAND_SETTINGS)
    simulation = HandSimulation(workcell, disturbance=(a, 0.0, 0.0))
    found = bisected(partial(simulation.simulate, motion, needed), 0.9, 1.1, 4)
    assert found.slips.lifts
    assert found.factor == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_points_have_the_patchs_mean_squares(kind: str) -> None:
    for hand in draw(kind, np.random.default_rng(1)).workcell.pads:
        points = lip_points(hand, 37)
        sides = hand.half_sides or (hand.patch_radius,) * 2
        expected = np.array(sides) * kern(hand)
        np.testing.assert_allclose((points**2).mean(axis=0), expected, rtol=1e-9)
        np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-12)


def test_swings_do_not_depend_on_the_place_of_the_box_frame() -> None:
    workcell, by = two_hands(ABOVE), np.array([0.03, -0.05, 0.08])
    low = replace(workcell.payload, centre_of_mass=np.zeros(3))
    expected = HandSprings(replace(workcell, payload=low), HAND_SETTINGS).swing_frequency
    first, second = (
        replace(contact, T_box_pad=transform(np.eye(3), by) @ contact.T_box_pad)
        for contact in workcell.contacts
    )
    moved = replace(workcell, payload=replace(low, centre_of_mass=by), contacts=(first, second))
    assert HandSprings(moved, HAND_SETTINGS).swing_frequency == pytest.approx(expected, rel=1e-9)


def test_a_payload_swings_as_its_layers_let_it() -> None:
    """Up and down: k A of each hand, and nothing else where the centre of mass is between them."""
    workcell = two_hands(BESIDE)
    area = np.pi * RADIUS**2
    stiffness = 2.0 * HAND_SETTINGS.layer * area
    # About the line of both: the torsion of two rings along their layers.
    about = stiffness / 3.0 * RADIUS**2
    expected = np.sqrt(about / workcell.payload.inertia[1, 1]) / (2.0 * np.pi)
    assert HandSprings(workcell, HAND_SETTINGS).swing_frequency == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("kind", "seed"), [("magnets", 2), ("fingers", 3)])
def test_hands_of_a_carry_need_what_the_model_says(kind: str, seed: int) -> None:
    """Where the rim of one hand decides; with half of it the payload is lost."""
    carry = draw(kind, np.random.default_rng([1, seed]))
    motion, needed = carriage_motion(carry, HAND_SETTINGS), needed_force(carry)
    simulate = partial(HandSimulation(carry.workcell).simulate, motion, needed)
    assert simulate(0.97).lifts
    assert simulate(1.02).holds
    assert not simulate(0.5).holds


def test_shorter_steps_change_nothing_where_a_payload_swings_slowly() -> None:
    """Between facing hands, where swings grow with longer steps."""
    carry = draw("cups beside", np.random.default_rng([9, 10]), 4.0)
    needed = needed_force(carry)
    assert HandSprings(carry.workcell, HAND_SETTINGS).swing_frequency * carry.duration < 10.0

    def slip(step: float) -> float:
        settings = replace(HAND_SETTINGS, time_step=step)
        simulation = HandSimulation(carry.workcell, settings)
        found = simulation.simulate(carriage_motion(carry, settings), 1.3 * needed)
        assert found.holds
        return float(found.slip[-1].max())

    step = HAND_SETTINGS.time_step
    # An error matters in relation to the slip at which a hand no longer holds.
    assert slip(step) == pytest.approx(slip(step / 2.0), abs=0.03 * HAND_SETTINGS.slip)


@pytest.mark.slow
def test_thresholds_of_forty_carries_are_on_the_safe_side() -> None:
    """As planned where a rim decides."""
    for k in range(40):
        kind = KINDS[k % len(KINDS)]
        found = threshold(kind, draw(kind, np.random.default_rng([1, k])))
        most = 1.02 + RESOLUTION / 2.0
        assert max(0.97 * found.rims, 0.8) <= found.ratio <= most, str(found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 7, 15, 19, 21, 27, 33, 38, 39])
def test_a_disturbance_covers_what_slow_swings_need(seed: int) -> None:
    """The model is quasi-static; these payloads swing fewer than 15 times in a carry."""
    carry = draw(KINDS[seed % len(KINDS)], np.random.default_rng([1, seed]), 4.0)
    assert HandSprings(carry.workcell, HAND_SETTINGS).swing_frequency * carry.duration < SWINGS
    doubt = Uncertainty(disturbance=np.full(3, 0.5))
    force = interpreted_robust_model(carry.workcell).commanded(box_motion(carry), doubt, 0).max()
    motion = carriage_motion(carry, HAND_SETTINGS)
    assert HandSimulation(carry.workcell).simulate(motion, force).holds


def test_pads_that_squeeze_are_refused() -> None:
    with refused(SettingsError, "needs-hands"):
        HandSimulation(hand_cell())
