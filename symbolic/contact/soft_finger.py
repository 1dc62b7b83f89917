"""Least contact forces of two soft fingers: elastic pads that press evenly, on arms that keep the
orientation of their pads.

Such a pad carries a normal force N, a tangential force T and a torsion tau about its normal, but
no tilting moment (soft-finger contact: Howe and Cutkosky, IJRR 1996). Two of them with opposite
normals share a load in one way only, up to the squeeze: a difference of their tangential forces
carries the moments across the line between them, torsion carries the moment about it. Friction
holds within the limit surface of a patch under even pressure. With a = mu N and
s = 1 - |T|^2 / a^2 it is

    |tau| <= a sqrt(s) (h / 2 + s (c - h / 2) - 3/80 c s (1 - s))                            (1)

c is the mean distance of the patch's points from its centre, which bounds pure torsion; h is twice
the root of the mean square of their coordinates along T: what is left for torsion when a patch
begins to slide. Both ends are exact. A disc of radius r has c = 2/3 r and h = r: (1) asks for
0.4 % less to 0.3 % more force than its exact limit curve. Rectangles: 0.7 % less to 2.9 % more up
to sides of 2 to 1, 6.5 % more at 5 to 1.

The capacities of both pads add up: the one that slips first hands torsion over to the other.

Coordinates: tangents a, b and normal n = a x b of contact 1. Forces in N, lengths in m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import Expression, number
from symbolic.records import Contact
from symbolic.records.numbered import NumberedContact

NEWTON_STEPS = 3
"""Newton steps for given tangential forces, from `_first_grip`: relative errors of forces are then
below 1e-6, of pads of one size 1e-9. One less where results take two more, see `Detached`."""

LEAST_GRIP = 0.05
"""Least grip that these start from, as a share of what the first pad would need for all torsion:
torsion has no slope where there is no grip, and a step from there leads far away."""

OFFSET_STEPS = 7
"""Secant steps where the pads lie beside one another."""

LEAST_SLOPE = 1e-3
"""Least slope of those steps: where pressing harder asks for nearly as much more, nothing holds."""

LEVER_FLOOR = 1e-12
"""Keeps a slope of the torsion by the grip positive [m]."""

BEND = 3.0 / 80.0
"""Last coefficient of (1): least largest error for a disc."""

FORCE_FLOOR = 1e-9
"""Added in squares to forces [N], so that lengths have slopes where there is no force."""


Load: TypeAlias = tuple[Expression, Expression, Expression]
"""Tangential force (2,) of each contact [N], and the torsion that both carry together [N m]."""

Both: TypeAlias = tuple[Expression, Expression]
"""One value per pad."""


@dataclass
class Detached:
    """Receives what was solved for, as a symbol and its value. Results then depend on the symbol;
    replace it afterwards.

    Attributes:
        steps: of Newton's method from the symbol to what the results depend on. With one, first
            derivatives are exact although they take the symbol for a constant; with two, second
            derivatives as well. None for results without derivatives.
    """

    steps: int = 2
    _found: list[tuple[ca.SX, ca.SX]] = field(default_factory=list)

    def detach(self, value: ca.SX) -> ca.SX:
        """The symbol of what was solved for."""
        symbol = ca.SX.sym("solved")
        self._found.append((symbol, value))
        return symbol

    @property
    def symbols(self) -> ca.SX:
        """(k,) all symbols."""
        return ca.vertcat(ca.SX(0, 1), *[symbol for symbol, _ in self._found])

    @property
    def values(self) -> ca.SX:
        """(k,) what they stand for."""
        return ca.vertcat(ca.SX(0, 1), *[value for _, value in self._found])

    def replaced(self, outputs: list[Expression]) -> list[Expression]:
        """Outputs with what was solved for in the symbols' place."""
        if not self._found:
            return outputs
        found: list[Expression] = ca.substitute(outputs, [self.symbols], [self.values])
        return list(ca.cse(found))


@dataclass(frozen=True)
class SoftPatch:
    """What a patch's shape means for torsion under even pressure.

    Attributes:
        twist: mean distance of the points from the centre [m].
        spread: (2, 2) makes of a unit vector along the tangents of contact 1 one whose length is
            twice the root of the mean square of the points' coordinates along it [m]; the radius
            times a rotation for a disc.
    """

    twist: float | ca.SX
    spread: Array | ca.SX

    @classmethod
    def of(cls, contact: Contact, axes: Array) -> SoftPatch:
        """The patch of a contact.

        Args:
            contact: of a round or rectangular patch.
            axes: (3, 3) those of contact 1 in the box frame.
        """
        if isinstance(contact, NumberedContact):
            return cls(contact.twist, contact.spread)
        in_pad = contact.T_box_pad[:3, :2].T @ axes[:, :2]
        if contact.half_sides is None:
            return cls(2.0 / 3.0 * contact.patch_radius, contact.patch_radius * in_pad)
        x, y = contact.half_sides
        # Integral of the distance over a rectangle about its centre.
        corners = x**2 / y * np.arcsinh(y / x) + y**2 / x * np.arcsinh(x / y)
        twist = (np.hypot(x, y) + corners / 2.0) / 3.0
        return cls(float(twist), 2.0 / np.sqrt(3.0) * np.diag([x, y]) @ in_pad)


@dataclass(frozen=True)
class SoftFingers:
    """Forces of both contacts, in the coordinates of the module.

    Attributes:
        normal: (2,) N_1, N_2 [N].
        tangent_1, tangent_2: (2,) tangential forces on the box [N].
        torsion: moment about n that both carry together [N m].
        capacity: (2,) torsion that each could carry beside its tangential force [N m].
    """

    normal: Expression
    tangent_1: Expression
    tangent_2: Expression
    torsion: Expression
    capacity: Expression


def torsion_capacity(
    grip: Expression, tangent: Expression, patch: SoftPatch
) -> tuple[Expression, Expression]:
    """The right side of (1) [N m], and its slope by sqrt(grip^2 - |tangent|^2) [m].

    Args:
        grip: sqrt(mu^2 N^2 - |T|^2), what friction leaves beside the tangential force [N].
        tangent: (2,) tangential force [N].
        patch: the pad's.
    """
    s = grip**2 / (grip**2 + _squared(tangent))
    half = _half_spread(patch, tangent)
    bend = BEND * patch.twist
    # h / 2 + s (c - h / 2) - bend s (1 - s)
    linear = patch.twist - half - bend
    lever = half + s * (linear + s * bend)
    lever_slope = 2.0 * s * (1.0 - s) * (linear + 2.0 * s * bend)
    return grip * lever, lever + lever_slope


def _squared(tangent: Expression) -> Expression:
    return ca.sumsqr(tangent) + FORCE_FLOOR**2


def _half_spread(patch: SoftPatch, tangent: Expression) -> Expression:
    """h / 2 of (1) [m]."""
    spread = ca.mtimes(number(patch.spread), tangent)
    return ca.sqrt(ca.sumsqr(spread) / _squared(tangent) + 1e-24) / 2.0


def least_soft_squeeze(
    force: Expression,
    moment: Expression,
    arms: tuple[Expression, Expression],
    friction: Expression,
    patches: tuple[SoftPatch, SoftPatch],
    offset: bool = False,
    detached: Detached | None = None,
) -> SoftFingers:
    """The least normal forces that hold.

    Args:
        force, moment: (3,) that the contacts have to give, about the payload's centre of mass.
        arms: (3,) each, from there to the contacts.
        friction: (2,) Coulomb coefficients.
        patches: of both pads.
        offset: whether the contacts may lie beside one another, seen along n; tangential forces
            and torsion then depend on the squeeze.
        detached: see `Detached`; without effect where `offset` is set.
    """
    apart = arms[0] - arms[1]
    # About the middle of the contacts: apart x half the difference of both forces, and torsion.
    rest = moment - ca.cross((arms[0] + arms[1]) / 2.0, force)

    def shared(squeeze: Expression) -> Load:
        """What both contacts carry under N_1 + N_2 = squeeze."""
        half = ca.vertcat(
            (rest[1] + apart[0] * squeeze / 2.0) / apart[2],
            (apart[1] * squeeze / 2.0 - rest[0]) / apart[2],
        )
        torsion = rest[2] - (apart[0] * half[1] - apart[1] * half[0])
        return force[:2] / 2.0 + half, force[:2] / 2.0 - half, torsion

    squeeze = ca.fabs(force[2]) if offset else ca.SX(0.0)
    load = shared(squeeze)
    normal, capacity = _pressed(load, force[2], friction, patches, None if offset else detached)
    # The least squeeze for what a squeeze asks is a convex function of it: secants reach the one
    # that asks for itself.
    before = squeeze
    for step in range(OFFSET_STEPS if offset else 0):
        found = normal[0] + normal[1]
        if step == 0:
            squeeze, before, excess = found, squeeze, found - squeeze
        else:
            now = found - squeeze
            slope = (now - excess) / (squeeze - before + FORCE_FLOOR)
            slope = ca.fmin(slope, -LEAST_SLOPE)
            squeeze, before, excess = squeeze - now / slope, squeeze, now
        load = shared(squeeze)
        normal, capacity = _pressed(load, force[2], friction, patches, None)
    return SoftFingers(normal, *load, capacity)


def _pressed(
    load: Load,
    difference: Expression,
    friction: Expression,
    patches: tuple[SoftPatch, SoftPatch],
    detached: Detached | None,
) -> tuple[Expression, Expression]:
    """Least normal forces (2,) [N] and torsion capacities (2,) [N m] for given tangential forces.

    Args:
        load: tangential force (2,) of each contact, and the torsion.
        difference: N_1 - N_2.
        friction, patches: of both pads.
        detached: see `Detached`.
    """
    *tangents, torsion = load
    asked = ca.fabs(torsion)
    needed = [_squared(tangent) / friction[i] ** 2 for i, tangent in enumerate(tangents)]
    # The pad that slips first: what its friction leaves beside the tangential force is solved for.
    first_binds = ca.sqrt(needed[0]) - difference > ca.sqrt(needed[1])

    def in_order(of: Sequence[Expression] | Expression) -> Both:
        return ca.if_else(first_binds, of[0], of[1]), ca.if_else(first_binds, of[1], of[0])

    needs, coefficients = in_order(needed), in_order(friction)
    own, mu = needs[0], coefficients[0]
    beside = ca.if_else(first_binds, difference, 0.0)

    def normal_at(grip: Expression) -> tuple[Expression, Expression]:
        bound = ca.sqrt(own + (grip / mu) ** 2)
        n_2 = bound - beside
        return ca.vertcat(n_2 + difference, n_2), bound

    def capacity_at(normal: Expression) -> tuple[list[Expression], Expression]:
        """Both capacities, and the slope of their sum by the squeeze."""
        slope, capacity = 0.0, []
        for i, patch in enumerate(patches):
            left = ca.fmax(normal[i] ** 2 - needed[i], 0.0) + FORCE_FLOOR**2
            own_grip = friction[i] * ca.sqrt(left)
            carried, by_grip = torsion_capacity(own_grip, tangents[i], patch)
            capacity.append(carried)
            slope += by_grip * friction[i] ** 2 * normal[i] / own_grip
        return capacity, slope

    def newton(grip: Expression) -> Expression:
        normal, bound = normal_at(grip)
        capacity, slope = capacity_at(normal)
        missing = asked - capacity[0] - capacity[1]
        by_grip = slope * grip / (mu**2 * bound)
        return ca.fmax(grip + missing / (by_grip + LEVER_FLOOR), FORCE_FLOOR)

    half = [_half_spread(patch, tangents[i]) for i, patch in enumerate(patches)]
    levers = in_order([patch.twist for patch in patches]), in_order(half)
    beginning = in_order(normal_at(ca.SX(0.0))[0])
    grip = _first_grip(asked, levers, coefficients, needs, beginning)
    more = detached.steps if detached is not None else 0
    for _ in range(NEWTON_STEPS - max(0, more - 1)):
        grip = newton(grip)
    if detached is not None:
        grip = detached.detach(grip)
    for _ in range(more):
        grip = newton(grip)
    normal, _ = normal_at(grip)
    return normal, ca.vertcat(*capacity_at(normal)[0])


def _first_grip(
    asked: Expression, levers: tuple[Both, Both], friction: Both, needed: Both, normal: Both
) -> Expression:
    """About the grip of the pad that slips first [N], from levers of torsion that are linear in s.

    Args:
        asked: absolute torsion that both pads carry.
        levers: c and h / 2 of both pads; here and in what follows first that which slips first.
        friction: coefficients.
        needed: squares of the normal forces that hold without torsion.
        normal: normal forces with which the first pad begins to slide without torsion.
    """
    twist, half = levers
    ratio = (friction[1] / friction[0]) ** 2
    # The other pad's squared grip is ratio g^2 + ahead, where normal forces are equal.
    ahead = friction[1] ** 2 * ca.fmax(normal[1] ** 2 - needed[1], 0.0)
    grip, (first, other) = ca.SX(0.0), twist
    for _ in range(2):
        # first g + other sqrt(ratio g^2 + ahead) = asked
        left = ca.fmax(asked**2 - other**2 * ahead, 0.0)
        root = (first * asked) ** 2 + (other**2 * ratio - first**2) * left
        grip = left / (first * asked + ca.sqrt(ca.fmax(root, 0.0)) + FORCE_FLOOR**2)
        squared = grip**2, ratio * grip**2 + ahead
        s = [g / (g + friction[i] ** 2 * needed[i]) for i, g in enumerate(squared)]
        first, other = (half[i] + s[i] * (twist[i] - half[i]) for i in (0, 1))
    return ca.fmax(grip, LEAST_GRIP * asked / twist[0])
