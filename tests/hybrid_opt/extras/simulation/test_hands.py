"""Simulated hands: against makers' formulas, and the contact model against them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

pytest.importorskip("mujoco")

from hybrid_opt.extras.simulation.box import bisected, carriage_motion
from hybrid_opt.extras.simulation.hands import (
    HAND_SETTINGS,
    HandSimulation,
    lip_points,
    swing_frequency,
)
from hybrid_opt.robust.force import box_motion, interpreted_robust_model
from studies.research.hand_carries import (
    KINDS,
    RESOLUTION,
    SWINGS,
    carry_along,
    draw,
    needed_force,
    threshold,
)
from symbolic.contact.elastic import kern
from symbolic.errors import SettingsError
from symbolic.records import Contact, Uncertainty, Workcell
from symbolic.records.poses import transform
from tests.hybrid_opt.cells import shipped
from tests.refusals import refused
from tests.symbolic.cells import hand_cell

MASS, FRICTION, RADIUS, G = 6.0, 0.5, 0.04, 9.81

SIZE = np.array([0.3, 0.4, 0.2])

ABOVE, BESIDE = "above", "beside"


def two_cups(where: str) -> Workcell:
    """A box held by two cups in line with its centre of mass, which lies between their lips."""
    cell, arms = shipped("palletising").workcell, []
    for side in (1.0, -1.0):
        if where == ABOVE:
            normal, place = np.array([0.0, 0.0, -1.0]), [0.0, 0.12 * side, SIZE[2] / 2.0]
        else:
            normal, place = np.array([0.0, -side, 0.0]), [0.0, side * SIZE[1] / 2.0, 0.0]
        x = np.array([1.0, 0.0, 0.0])
        T = transform(np.column_stack([x, np.cross(normal, x), normal]), np.array(place))
        arms.append(Contact(T, FRICTION, RADIUS, kind="cup", holding_force=1.0))
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
    workcell = two_cups(where)
    motion = carriage_motion(carry_along(workcell, np.zeros(6), 0.3), HAND_SETTINGS)
    simulation = HandSimulation(workcell, disturbance=acceleration)
    found = bisected(partial(simulation.simulate, motion, needed), 0.9, 1.1, 4)
    assert found.factor == pytest.approx(1.0, abs=0.02)


def test_arms_that_pull_against_one_another_lift_a_rim() -> None:
    """One cup of each arm, level, across their faces. Neither arm turns, so each cup also bears
    half of the couple of both. Along their faces a slip relieves both."""
    workcell, pull = two_cups(ABOVE), 8.0
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


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("where", [ABOVE, BESIDE])
def test_a_displaced_arm_loads_the_layers_as_springs_in_series(where: str, axis: int) -> None:
    """Two equal springs in series, whose moments turn the payload between arms that do not turn:
    each bears half of the couple with its stiffness against that rotation."""
    workcell, pull = two_cups(where), 8.0 * np.eye(3)[axis]
    area = np.pi * RADIUS**2
    normal = HAND_SETTINGS.layer * area
    shear, bending, torsion = normal / 3.0, normal * RADIUS**2 / 2.0, normal / 3.0 * RADIUS**2
    distance = float(np.ptp([contact.T_box_pad[1, 3] for contact in workcell.contacts]))
    # Both cups are in line along y: across this line the payload turns.
    along, turning = {
        (ABOVE, 0): (shear, torsion),
        (ABOVE, 1): (shear, np.inf),
        (ABOVE, 2): (normal, bending),
        (BESIDE, 0): (shear, bending),
        (BESIDE, 1): (normal, np.inf),
        (BESIDE, 2): (shear, bending),
    }[where, axis]
    compliance = 2.0 / along + distance**2 / (2.0 * turning)
    motion = carriage_motion(carry_along(workcell, np.zeros(6), 0.3), HAND_SETTINGS)
    simulation = HandSimulation(workcell, opposed=pull)
    rest = HandSimulation(workcell).simulate(motion, 200.0).force
    expected = np.linalg.norm(simulation.displacement) / compliance
    assert expected == pytest.approx(8.0, rel=1e-6)
    loaded = simulation.simulate(motion, 200.0).force - rest
    for contact, force, sign in zip(workcell.pads, loaded, (-1.0, 1.0), strict=True):
        found = contact.T_box_pad[:3, :3] @ force
        np.testing.assert_allclose(found, sign * pull, atol=0.035 * float(expected))


def test_a_rim_lifts_where_the_pressure_leaves_the_kern() -> None:
    """Accelerated across the line of both cups, with the centre of mass below them."""
    workcell = two_cups(ABOVE)
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


def test_a_payload_swings_as_its_layers_let_it() -> None:
    """Up and down: k A of each hand, and nothing else where the centre of mass is between them."""
    workcell = two_cups(BESIDE)
    area = np.pi * RADIUS**2
    stiffness = 2.0 * HAND_SETTINGS.layer * area
    # About the line of both: the torsion of two rings along their layers.
    about = stiffness / 3.0 * RADIUS**2
    expected = np.sqrt(about / workcell.payload.inertia[1, 1]) / (2.0 * np.pi)
    assert swing_frequency(workcell) == pytest.approx(expected, rel=1e-6)


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
    assert swing_frequency(carry.workcell) * carry.duration < 10.0

    def slip(step: float) -> float:
        settings = replace(HAND_SETTINGS, time_step=step)
        simulation = HandSimulation(carry.workcell, settings)
        found = simulation.simulate(carriage_motion(carry, settings), 1.02 * needed)
        assert found.holds
        return float(found.slip[-1].max())

    step = HAND_SETTINGS.time_step
    # An error matters in relation to the slip at which a hand no longer holds.
    assert slip(step) == pytest.approx(slip(step / 2.0), abs=0.005 * HAND_SETTINGS.slip)


@pytest.mark.slow
def test_thresholds_of_forty_carries_are_on_the_safe_side() -> None:
    """As planned where a rim decides; less where others take over what one hand cannot hold."""
    for k in range(40):
        kind = KINDS[k % len(KINDS)]
        found = threshold(kind, draw(kind, np.random.default_rng([1, k])))
        most = 1.02 + RESOLUTION / 2.0
        assert max(0.97 * found.rims, 0.6) <= found.ratio <= most, str(found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 7, 15, 19, 21, 27, 33, 39])
def test_a_disturbance_covers_what_slow_swings_need(seed: int) -> None:
    """The model is quasi-static; these payloads swing fewer than 15 times in a carry."""
    carry = draw(KINDS[seed % len(KINDS)], np.random.default_rng([1, seed]), 4.0)
    assert swing_frequency(carry.workcell) * carry.duration < SWINGS
    doubt = Uncertainty(disturbance=np.full(3, 0.5))
    force = interpreted_robust_model(carry.workcell).commanded(box_motion(carry), doubt, 0).max()
    motion = carriage_motion(carry, HAND_SETTINGS)
    assert HandSimulation(carry.workcell).simulate(motion, force).holds


def test_pads_that_squeeze_are_refused() -> None:
    with refused(SettingsError, "needs-hands"):
        HandSimulation(hand_cell())
