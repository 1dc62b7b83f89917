"""Least contact forces of two soft fingers: elastic pads that press evenly, on arms that keep the
orientation of their pads.

A soft finger bears a normal force N, a tangential force T and a torsion tau about its normal, but
no tilting moment (soft-finger contact: Howe and Cutkosky, IJRR 1996). For a given squeeze, two of
them with opposite normals share a load in one way only: a difference of their tangential forces
balances the moments across the line between them, torsion balances the moment about it. Friction
holds within the limit surface of a patch under even pressure. With a = mu N and s = 1 - |T|^2 / a^2
it is

    |tau| <= a sqrt(s) (h / 2 + s (c - h / 2) - 3/80 c s (1 - s))                            (1)

c is the mean distance of the patch's points from its centre, which bounds pure torsion. h is twice
the root mean square of their coordinates along T, which bounds torsion as the patch begins to
slide. Both ends are exact. A disc of radius r has c = 2/3 r and h = r; (1) needs 0.4 % less to 0.3
% more force than its exact limit curve. For rectangles it is 0.7 % less to 2.9 % more up to sides
of 2 to 1, and 6.5 % more at 5 to 1.

The torsion capacities of both pads add up: the pad that slips first passes torsion to the other.

Coordinates: tangents a, b and normal n = a x b of contact 1. Forces in N, lengths in m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.contact.model import Both, ImplicitVariables
from symbolic.expression import Expression, number
from symbolic.records import Contact
from symbolic.records.numbered import NumberedContact

GRIP_NEWTON_STEPS = 3
"""Number of Newton steps for given tangential forces, from `_first_grip`. Relative errors of forces
are then below 1e-6, or 1e-9 for pads of equal size. `ImplicitVariables` with two steps replaces
one."""

LEAST_GRIP = 0.05
"""Smallest initial grip, over the grip that the first pad needs for all torsion. Without grip,
torsion has no slope and a Newton step leads far away."""

OFFSET_STEPS = 7
"""Number of secant steps for laterally offset pads."""

LEAST_SLOPE = 1e-3
"""Smallest slope of the secant steps. Nothing holds if a harder squeeze needs nearly as much
more."""

LEVER_FLOOR = 1e-12
"""Lower bound of the slope of the torsion by the grip [m]."""

BEND = 3.0 / 80.0
"""Last coefficient of (1): it minimises the largest error for a disc."""

FORCE_FLOOR = 1e-9
"""Added in squares to forces [N], so that lengths have slopes at zero force."""

Load: TypeAlias = tuple[Expression, Expression, Expression]
"""Tangential force (2,) of each contact [N], and the torsion that both carry together [N m]."""


@dataclass(frozen=True)
class SoftPatch:
    """Lengths of a patch that determine the torsion that it bears under even pressure.

    Attributes:
        twist: mean distance of the patch's points from its centre [m].
        spread: (2, 2) matrix S [m]. For a unit vector t along the tangents of contact 1, the length
            of S t is twice the root mean square of the points' coordinates along t. For a disc S is
            the radius times a rotation.
    """

    twist: float | ca.SX
    spread: Array | ca.SX

    @classmethod
    def of(cls, contact: Contact, axes: Array) -> SoftPatch:
        """Compute the lengths of a contact's patch that determine its torsion.

        Args:
            contact: contact with a round or rectangular patch.
            axes: (3, 3) tangents and normal of contact 1 in the box frame, as columns. The field
                `spread` is along these tangents.
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
    """Forces of two soft fingers, along the tangents a, b and the normal n of contact 1.

    Attributes:
        normal: (2,) normal forces N_1, N_2 [N].
        tangent_1, tangent_2: (2,) tangential force of each contact on the box, along a and b [N].
        torsion: moment about n that both contacts bear together [N m].
        capacity: (2,) largest torsion that each contact can bear in addition to its tangential
            force [N m].
    """

    normal: Expression
    tangent_1: Expression
    tangent_2: Expression
    torsion: Expression
    capacity: Expression


def torsion_capacity(
    grip: Expression, tangent: Expression, patch: SoftPatch
) -> tuple[Expression, Expression]:
    """Compute the largest torsion that a pad can bear beside a tangential force.

    Args:
        grip: friction that the tangential force T leaves, sqrt(mu^2 N^2 - T . T), with friction
            coefficient mu and normal force N [N].
        tangent: (2,) tangential force T [N].
        patch: patch of the pad.

    Returns:
        The torsion [N m], and its derivative by the grip [m].
    """
    return _capacity(grip, _squared(tangent), patch.twist, _half_spread(patch, tangent))


def _capacity(
    grip: Expression, squared: Expression, twist: Expression, half: Expression
) -> tuple[Expression, Expression]:
    """Compute the largest torsion that a pad can bear beside a tangential force.

    Args:
        grip: friction that the tangential force T leaves, sqrt(mu^2 N^2 - T . T), with friction
            coefficient mu and normal force N [N].
        squared: squared tangential force T . T [N^2].
        twist: mean distance of the patch's points from its centre [m].
        half: root mean square of the coordinates of the patch's points along T [m].

    Returns:
        The torsion [N m], and its derivative by the grip [m].
    """
    s = grip**2 / (grip**2 + squared)
    bend = BEND * twist
    # h / 2 + s (c - h / 2) - bend s (1 - s)
    linear = twist - half - bend
    lever = half + s * (linear + s * bend)
    lever_slope = 2.0 * s * (1.0 - s) * (linear + 2.0 * s * bend)
    return grip * lever, lever + lever_slope


def _squared(tangent: Expression) -> Expression:
    return ca.sumsqr(tangent) + FORCE_FLOOR**2


def _half_spread(patch: SoftPatch, tangent: Expression) -> Expression:
    """Compute the root mean square of the coordinates of a patch's points along a tangential force
    [m].

    Args:
        patch: shape of the contact patch.
        tangent: (2,) tangential force; only its direction counts.
    """
    spread = ca.mtimes(number(patch.spread), tangent)
    return ca.sqrt(ca.sumsqr(spread) / _squared(tangent) + 1e-24) / 2.0


def least_soft_squeeze(
    force: Expression,
    moment: Expression,
    arms: tuple[Expression, Expression],
    friction: Expression,
    patches: tuple[SoftPatch, SoftPatch],
    offset: bool = False,
    implicit: ImplicitVariables | None = None,
) -> SoftFingers:
    """Compute the forces of two soft fingers that balance a load with the least squeeze.

    Args:
        force, moment: (3,) force [N] and moment about the centre of mass [N m] that both contacts
            exert together on the payload. These and `arms` are along the two tangents and the
            normal of contact 1.
        arms: for each contact the vector (3,) from the centre of mass to the contact point [m].
        friction: (2,) Coulomb coefficients.
        patches: patches of both pads.
        offset: True if the contacts may be laterally offset. Tangential forces and torsion then
            depend on the squeeze, which is found by iteration.
        implicit: stores the results of Newton's method, so that derivatives of the forces become
            exact; None if no derivatives are needed. Not used with `offset`.
    """
    apart = arms[0] - arms[1]
    # About the middle of the contacts: apart x half the difference of both forces, and torsion.
    rest = moment - ca.cross((arms[0] + arms[1]) / 2.0, force)

    def shared(squeeze: Expression) -> Load:
        """Compute how two contacts share the load if the sum of their normal forces is `squeeze`
        [N].

        Returns:
            Tangential force (2,) of each contact [N], and the torsion that both bear together [N
            m].
        """
        half = ca.vertcat(
            (rest[1] + apart[0] * squeeze / 2.0) / apart[2],
            (apart[1] * squeeze / 2.0 - rest[0]) / apart[2],
        )
        torsion = rest[2] - (apart[0] * half[1] - apart[1] * half[0])
        return force[:2] / 2.0 + half, force[:2] / 2.0 - half, torsion

    squeeze = ca.fabs(force[2]) if offset else ca.SX(0.0)
    load = shared(squeeze)
    normal, capacity = _pressed(load, force[2], friction, patches, None if offset else implicit)
    # The least squeeze for the load of a squeeze is a convex function of it: secants converge to
    # its fixed point.
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
    implicit: ImplicitVariables | None,
) -> tuple[Expression, Expression]:
    """Compute the least normal forces of two pads that bear given tangential forces and a torsion.

    Args:
        load: tangential force (2,) of each contact [N], and the torsion that both bear together [N
            m].
        difference: normal force of contact 1 minus normal force of contact 2 [N].
        friction: (2,) Coulomb coefficients.
        patches: patches of both pads.
        implicit: stores the results of Newton's method, so that derivatives of the forces become
            exact; None if no derivatives are needed.

    Returns:
        Normal forces (2,) [N]; and the largest torsion (2,) that each pad can bear beside its
        tangential force at these forces [N m].
    """
    *tangents, torsion = load
    asked, squares = ca.fabs(torsion), [_squared(tangent) for tangent in tangents]
    least = [ca.sqrt(square) / friction[i] for i, square in enumerate(squares)]
    # Unknown: the grip of the pad that slips first, its friction left beside the tangential force.
    first_binds = least[0] - difference > least[1]

    def in_order(of: Sequence[Expression] | Expression) -> Both:
        return ca.if_else(first_binds, of[0], of[1]), ca.if_else(first_binds, of[1], of[0])

    halves = [_half_spread(patch, tangents[i]) for i, patch in enumerate(patches)]
    mu, squared, half = in_order(friction), in_order(squares), in_order(halves)
    twist = in_order([patch.twist for patch in patches])
    # Excess of the other pad's normal force over the first's, and ratio of the coefficients.
    beyond = ca.if_else(first_binds, -difference, difference)
    share, ahead = mu[1] / mu[0], mu[0] * beyond

    def other_grip_squared(bound: Expression) -> Expression:
        """Compute the squared grip of the pad that slips second [N^2]. A pad's grip is the friction
        that its tangential force leaves.

        Args:
            bound: friction coefficient times normal force of the pad that slips first [N].
        """
        return ca.fmax((share * (bound + ahead)) ** 2 - squared[1], 0.0) + FORCE_FLOOR**2

    def newton(grip: Expression) -> Expression:
        bound = ca.sqrt(grip**2 + squared[0])
        other = ca.sqrt(other_grip_squared(bound))
        carried, slope = _capacity(grip, squared[0], twist[0], half[0])
        carried_too, by_other = _capacity(other, squared[1], twist[1], half[1])
        # The other grip changes by share^2 grip (bound + ahead) / (other bound).
        below = other * bound
        slope = slope * below + by_other * share**2 * grip * (bound + ahead)
        missing = asked - carried - carried_too
        return ca.fmax(grip + missing * below / (slope + LEVER_FLOOR * below), FORCE_FLOOR)

    more = implicit.steps if implicit is not None else 0
    beginning = other_grip_squared(in_order([ca.sqrt(square) for square in squares])[0])
    grip = _first_grip(asked, (twist, half), share, squared, beginning)
    for _ in range(GRIP_NEWTON_STEPS - max(0, more - 1)):
        grip = newton(grip)
    if implicit is not None:
        grip = implicit.detach(grip)
    for _ in range(more):
        grip = newton(grip)
    bound = ca.sqrt(grip**2 + squared[0])
    grips, normal = (grip, ca.sqrt(other_grip_squared(bound))), bound / mu[0]
    capacities = [_capacity(grips[i], squared[i], twist[i], half[i])[0] for i in (0, 1)]
    return ca.vertcat(*in_order((normal, normal + beyond))), ca.vertcat(*in_order(capacities))


def _first_grip(
    asked: Expression,
    levers: tuple[Both, Both],
    share: Expression,
    squared: Both,
    ahead: Expression,
) -> Expression:
    """Estimate the grip of the pad that slips first [N]. A pad's grip is the friction that its
    tangential force leaves.

    The torsion of a pad is approximated as its grip g times h / 2 + s (c - h / 2), where s is g^2 /
    (g^2 + squared tangential force), c is the mean distance of the patch's points from its centre,
    and h / 2 the root mean square of their coordinates along the tangential force. Of each pair of
    arguments, the first belongs to the pad that slips first.

    Args:
        asked: absolute torsion that both pads bear together [N m].
        levers: pair of lengths c, and pair of lengths h / 2 [m].
        share: friction coefficient of the other pad over the coefficient of the first.
        squared: pair of squared tangential forces [N^2].
        ahead: squared grip of the other pad when the first begins to slide without torsion [N^2].
    """
    twist, half = levers
    # As if the other pad had the same normal force, and the first no tangential force.
    grip = asked / (twist[0] + share * twist[1])
    # The other pad's squared grip is share^2 g^2 + ahead, where normal forces are equal.
    grips = grip**2, (share * grip) ** 2 + ahead
    s = [g / (g + squared[i]) for i, g in enumerate(grips)]
    first, other = (half[i] + s[i] * (twist[i] - half[i]) for i in (0, 1))
    # first g + other sqrt(share^2 g^2 + ahead) = asked
    left = ca.fmax(asked**2 - other**2 * ahead, 0.0)
    root = (first * asked) ** 2 + ((other * share) ** 2 - first**2) * left
    grip = left / (first * asked + ca.sqrt(ca.fmax(root, 0.0)) + FORCE_FLOOR**2)
    return ca.fmax(grip, LEAST_GRIP * asked / twist[0])
