"""Hands that hold by themselves: cups, magnets and grippers, each with a holding force of its own.

A hand pulls the payload against itself with the holding force G. Of the load it bears a share
(`symbolic.contact.elastic.layer_shares`): the normal force N, positive if it presses, the
tangential force T, moments M_x and M_y about the tangents and the torsion tau. Its patch presses
with G + N. It needs

    G >= |M| / kern - N                                             so that no rim lifts off,    (1)
    G >= sqrt(|T|^2 + t^2 + kappa |T| t) / mu - N,  t = |tau| / c,  so that nothing slides.      (2)

The kern is the shift of the centre of pressure that takes the pressure off a rim; of a rectangle
both axes add up. c is the mean distance of the patch's points from its centre. kappa fits (2) to
the limit curve of a patch under even pressure (Howe and Cutkosky, IJRR 1996): a disc needs 0 to
2.1 % more than exact, the ring of a cup's lip 0 to 3.0 %, a rectangle -0.2 to 10.5 % up to sides of
2 to 1. Both right sides are convex in the load and of degree one: a multiple of the load needs the
multiple of the force, and a sum needs at most the sum.

Each hand is to hold its own share, although others could take over what it cannot: a cup that
slides or lifts leaks.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from symbolic.contact.elastic import kern
from symbolic.contact.soft_finger import SoftPatch
from symbolic.expression import Expression, number
from symbolic.records import Contact

KAPPA_DISC, KAPPA = 0.3, 0.5
"""Coefficients of (2) for discs, and for rings and rectangles: the least of one digit that never
asks a disc or a ring for less than its limit curve does."""

FLOOR = 1e-9
"""Added in squares to forces [N] and moments [N m], so that lengths have slopes at zero."""


@dataclass(frozen=True)
class HandPatch:
    """Lengths of a hand's patch.

    Attributes:
        kern: along the axes of the hand [m].
        is_round: whether the patch is a disc or a ring.
        twist: c of (2) [m].
        kappa: of (2).
    """

    kern: tuple[Expression, Expression]
    is_round: bool
    twist: Expression
    kappa: float

    @classmethod
    def of(cls, hand: Contact) -> HandPatch:
        """Return the patch of a hand, whose lengths may be symbols."""
        is_round = hand.half_sides is None
        twist = hand.patch_radius if hand.is_ring else SoftPatch.of(hand, np.eye(3)).twist
        kappa = KAPPA_DISC if is_round and not hand.is_ring else KAPPA
        return cls(kern(hand), is_round, number(twist), kappa)


def needed_holding_forces(
    wrench: Expression, friction: Expression, patch: HandPatch
) -> tuple[Expression, Expression]:
    """Return the holding forces that (1) and (2) ask of a hand [N]; below zero where the load
    presses it on.

    Args:
        wrench: (6,) of the hand on the payload, T, N, M_x, M_y, tau in its axes [N, N m].
        friction: Coulomb coefficient.
        patch: of the hand.
    """
    normal = wrench[2]
    # A moment about x shifts the pressure along y.
    tilting = wrench[3] / patch.kern[1], wrench[4] / patch.kern[0]
    lifting = _length(*tilting) if patch.is_round else sum(map(_length, tilting))
    tangential, torsion = _length(wrench[0], wrench[1]), _length(wrench[5] / patch.twist)
    sliding = ca.sqrt(tangential**2 + torsion**2 + patch.kappa * tangential * torsion)
    return lifting - normal, sliding / friction - normal


def _length(*components: Expression) -> Expression:
    return ca.sqrt(sum(component**2 for component in components) + FLOOR**2)
