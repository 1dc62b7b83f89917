"""Carries in hands that hold by themselves: their holding forces, simulated and by the model."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from hybrid_opt.carry import ArmMotion, Carry, box_motion
from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.simulation.box import bisected, carriage_motion
from hybrid_opt.extras.simulation.hand_bodies import HandSprings
from hybrid_opt.extras.simulation.hands import (
    HAND_SETTINGS,
    HandSimulation,
)
from hybrid_opt.robust.force import interpreted_robust_model
from studies.research.plain.motion import angular_rates
from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import Contact, Workcell
from symbolic.records.cell import HandKind
from symbolic.records.poses import transform

CELL = Path(__file__).parents[1] / "workcells" / "palletising.toml"
"""Workcell file of which payload and hands are replaced; its arms have no influence."""

KINDS = ("cups above", "cups beside", "magnets", "fingers")

QUINTIC_SAMPLES = 101

SWINGS = 15.0
"""Least number of natural oscillations of the payload on its layers during a carry. The contact
model does not include oscillations."""

LOW, HIGH = 0.3, 1.5
"""Bounds of the factor on the holding force if the threshold is not near the expected one."""

EXPECTED = (0.97, 1.03)
"""Multiples of the rims' share and of the required force between which the threshold is
expected."""

RESOLUTION = 0.008
"""Difference of the factors on both sides of a threshold."""

BELLOWS = 0.1
"""Stiffness along the normal of cups that face each other, over that of a usual layer. Between
stiffer ones a payload that slides and turns by a millimetre jams, and holds with less force than
statics says."""

ROUGH = 1e6
"""Coefficient of friction with which nothing slides."""


@dataclass(frozen=True)
class HandThreshold:
    """Result of the simulator for one carry of a payload in hands.

    Attributes:
        kind: kind of the hands, one of `KINDS`.
        hands: number of hands.
        swings: number of natural oscillations of the payload on its elastic layers during the
            carry.
        needed: holding force that the contact model requires [N].
        rims: share of `needed` that would suffice if nothing could slide, so that only rims lift
            off.
        ratio: least holding force that suffices in the simulator, over `needed`.
        lifts: True if a rim lifts off below that force, False if a hand slips.
    """

    kind: str
    hands: int
    swings: float
    needed: float
    rims: float
    ratio: float
    lifts: bool

    def __str__(self) -> str:
        return (
            f"{self.kind:12} {self.hands:5} {self.swings:7.1f} {self.needed:9.2f} N "
            f"{self.rims:6.3f} {self.ratio:7.3f}  {'lifts' if self.lifts else 'slips'}"
        )


def draw(kind: str, rng: np.random.Generator, least_swings: float = SWINGS) -> Carry:
    """Return a random carry of a random payload in hands.

    Args:
        kind: kind of the hands.
        rng: source of the random numbers.
        least_swings: least number of oscillations of the payload in its hands during the carry.
    """
    while True:
        workcell = _draw_cell(kind, rng)
        turned = rng.uniform(-0.4, 0.4, 3) * rng.integers(0, 2)
        path = np.concatenate([rng.uniform(-0.4, 0.4, 3), turned])
        carry = carry_along(workcell, path, rng.uniform(0.8, 1.6))
        if HandSprings(workcell, HAND_SETTINGS).swing_frequency * carry.duration >= least_swings:
            return carry


def needed_force(carry: Carry) -> float:
    """Return the holding force that the contact model requires for a carry [N]."""
    model = interpreted_robust_model(carry.workcell)
    return float(model.nominal(box_motion(carry)).max())


def rims_share(carry: Carry) -> float:
    """Compute the holding force that keeps all rims from lifting off, over the force that the carry
    needs. The difference to 1 is due to sliding.
    """
    first, second = (_rough(contact) for contact in carry.workcell.contacts)
    rough = replace(carry, workcell=replace(carry.workcell, contacts=(first, second)))
    return needed_force(rough) / needed_force(carry)


def _rough(contact: Contact) -> Contact:
    further = tuple(replace(hand, friction=ROUGH) for hand in contact.further)
    return replace(contact, friction=ROUGH, further=further)


def threshold(kind: str, carry: Carry) -> HandThreshold:
    """Find the least holding force with which a carry succeeds in the simulator.

    A bisection first searches near the force that the contact model requires. If the threshold is
    not there, it searches the wide range from `LOW` to `HIGH` times this force.

    Args:
        kind: kind of the hands, stored in the result.
        carry: the carry of a payload in hands.
    """
    workcell = carry.workcell
    needed, rims = needed_force(carry), rims_share(carry)
    simulate = partial(
        HandSimulation(workcell).simulate, carriage_motion(carry, HAND_SETTINGS), needed
    )
    low, high = EXPECTED[0] * max(rims, LOW), EXPECTED[1]
    try:
        found = bisected(simulate, low, high, _steps(low, high))
    except SimulationError:
        found = bisected(simulate, LOW, HIGH, _steps(LOW, HIGH))
    return HandThreshold(
        kind,
        len(workcell.pads),
        HandSprings(workcell, HAND_SETTINGS).swing_frequency * carry.duration,
        needed,
        rims,
        found.factor,
        found.slips.lifts,
    )


def _steps(low: float, high: float) -> int:
    """Return the number of bisections that narrow the range from `low` to `high` down to the
    resolution.
    """
    return int(np.ceil(np.log2((high - low) / RESOLUTION)))


def carry_along(workcell: Workcell, path: Array, duration: float) -> Carry:
    """Return a carry without forces that moves the box from rest to rest along a straight pose
    change.

    The motion is the quintic 10 s^3 - 15 s^4 + 6 s^5.

    Args:
        workcell: the cell.
        path: (6,) change of the pose from start to goal [m, rad].
        duration: duration of the motion [s].
    """
    s = np.linspace(0.0, 1.0, QUINTIC_SAMPLES)
    place = 10 * s**3 - 15 * s**4 + 6 * s**5
    speed = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
    growth = (60 * s - 180 * s**2 + 120 * s**3) / duration**2
    start = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    pose, rate, second = (
        start + np.outer(place, path),
        np.outer(speed, path),
        np.outer(growth, path),
    )
    turning = [
        angular_rates(*rows) for rows in zip(pose[:, 3:], rate[:, 3:], second[:, 3:], strict=True)
    ]
    none = np.zeros((QUINTIC_SAMPLES, 6))
    arm = ArmMotion(none, none, none, none, none)
    return Carry(
        workcell=workcell,
        x=np.zeros(1),
        timing="limits",
        parameter=s,
        time=duration * s,
        pose=pose,
        rate=rate,
        second_rate=second,
        angular_velocity=np.array([omega for omega, _ in turning]),
        angular_acceleration=np.array([alpha for _, alpha in turning]),
        normal_force=np.zeros((QUINTIC_SAMPLES, 2)),
        tangential_force=np.zeros((QUINTIC_SAMPLES, 2)),
        contact_force=np.zeros((QUINTIC_SAMPLES, 2, 3)),
        pressure_shift=np.zeros((QUINTIC_SAMPLES, 2)),
        point_moment_residual=np.zeros((QUINTIC_SAMPLES, 3)),
        moment_residual=np.zeros((QUINTIC_SAMPLES, 3)),
        arms=(arm, arm),
    )


def _draw_cell(kind: str, rng: np.random.Generator) -> Workcell:
    """Return a cell whose two arms hold a random payload of 3 to 15 kg at opposite sides or edges.

    Args:
        kind: kind of the hands.
        rng: source of the random numbers.
    """
    is_plate = kind == "fingers"
    lower, upper = ([0.3, 0.4, 0.004], [0.6, 0.8, 0.02]) if is_plate else ([0.3] * 3, [0.6] * 3)
    size = rng.uniform(lower, upper)
    if kind != "cups beside":
        size[2] *= 0.6 if not is_plate else 1.0
    mass = rng.uniform(3.0, 8.0 if is_plate else 15.0)
    friction, radius = rng.uniform(0.3, 0.7), rng.uniform(0.02, 0.04)
    half = np.array([rng.uniform(0.02, 0.04), rng.uniform(0.01, 0.02)])
    apart = rng.uniform(1.2, 3.0) * radius
    arms = []
    for side in (1.0, -1.0):
        along = rng.uniform(-0.1, 0.1) * size[0]
        if is_plate:
            edge = side * (size[1] / 2.0 - 1.2 * half[1])
            places = [([along, edge, z * size[2] / 2.0], [0.0, 0.0, -z]) for z in (1.0, -1.0)]
        elif kind == "cups beside":
            height = rng.uniform(-0.1, 0.3) * size[2]
            places = [
                ([x, side * size[1] / 2.0, height], [0.0, -side, 0.0]) for x in (apart, -apart)
            ]
        else:
            inwards = apart + 1.1 * radius + rng.uniform(0.0, 0.05)
            centre = side * (size[1] / 2.0 - inwards)
            rows = (apart, -apart) if kind == "cups above" else (0.0,)
            down, top = [0.0, 0.0, -1.0], size[2] / 2.0
            places = [([along + x, centre + y, top], down) for x in (apart, -apart) for y in rows]
        sort: HandKind = "cup"
        if kind in ("magnets", "fingers"):
            sort = "magnet" if kind == "magnets" else "fingers"
        bellows = BELLOWS if kind == "cups beside" else 1.0
        hands = [
            Contact(
                transform(_axes(np.array(normal)), np.array(place)),
                friction,
                float(np.hypot(*half)) if is_plate else radius,
                half_sides=(float(half[0]), float(half[1])) if is_plate else None,
                kind=sort,
                holding_force=1.0,
                layer_shear=Contact.layer_shear / bellows,
                layer_stiffness=bellows,
            )
            for place, normal in places
        ]
        arms.append(replace(hands[0], further=tuple(hands[1:])))
    inertia = mass / 12.0 * np.diag(size[[1, 2, 0]] ** 2 + size[[2, 0, 1]] ** 2)
    cell = load(CELL)
    payload = replace(
        cell.payload,
        size=size,
        mass=mass,
        centre_of_mass=rng.uniform(-0.06, 0.06, 3) * size,
        inertia=inertia,
    )
    return replace(cell, payload=payload, contacts=(arms[0], arms[1]))


def _axes(normal: Array) -> Array:
    """Return a rotation (3, 3) whose columns are axes: z along a normal (3,), x along the payload's
    x axis.

    The normal must be perpendicular to the payload's x axis.
    """
    x = np.array([1.0, 0.0, 0.0])
    return np.column_stack([x, np.cross(normal, x), normal])


def summary(found: Sequence[HandThreshold]) -> str:
    """Return one line of text on how the least holding forces in the simulator compare with those
    of the contact model: the range and the median of their ratios.
    """
    ratios = np.array([one.ratio for one in found])
    return (
        f"{len(found)} carries: ratio {ratios.min():.3f} to {ratios.max():.3f}, median "
        f"{np.median(ratios):.3f}; {int(((ratios >= 0.80) & (ratios <= 1.02)).sum())} within 0.80 "
        "to 1.02"
    )


def thresholds(options: argparse.Namespace) -> int:
    """Find and print, for each random carry in the options, the least holding force with which the
    carry succeeds in the simulator. Return the exit code.
    """
    print("hands        count  swings      needed   rims   ratio  below it")
    found = []
    for k, kind in enumerate(islice(cycle(KINDS), options.carries)):
        carry = draw(kind, np.random.default_rng([options.seed, k]), options.swings)
        found.append(threshold(kind, carry))
        print(found[-1], flush=True)
    print(summary(found))
    return 0
