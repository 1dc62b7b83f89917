"""What one solve of the smooth problem aims at: the scalarisations and their parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symbolic.array import Array

NO_LIMIT = 1e3
"""Offset that leaves an objective free, in units of the range."""

CLOSED_SIDE = 1e-4
"""By this share of the range a side may be exceeded: what the solver rounds off."""

LARGER = 0.5
"""Weight of the larger objective beside the sum of both in the balanced middle."""

TIE = 1e-4
"""Weight of the sum of both objectives beside the level: excludes weakly efficient points."""


@dataclass(frozen=True)
class Target:
    """See `hybrid_opt.polishing.program`; all (2,) but cost (3,): of the level and both peaks."""

    anchor: Array
    span: Array
    direction: Array
    offset: Array
    cost: Array

    @property
    def limits(self) -> tuple[bool, bool]:
        """Per robot whether its force matters for more than ties."""
        first, second = (self.offset < NO_LIMIT).tolist()
        return first, second


def pascoletti_serafini(anchor: Array, span: Array, direction: Array | None = None) -> Target:
    """Go from the anchor against the direction as far as possible, never above either side.

    Pascoletti and Serafini 1984; with the normal of a chord as direction it is the normal
    boundary intersection of Das and Dennis 1998.

    Args:
        anchor, span: (2,) point started from, and the scale of each objective.
        direction: (2,) in units of the span, ones by default.
    """
    ahead = np.ones(2) if direction is None else direction
    return Target(anchor, span, ahead, np.zeros(2), np.array([1.0, TIE, TIE]))


def epsilon_constraint(anchor: Array, span: Array, objective: int) -> Target:
    """Minimise one objective while the other stays at most at the anchor."""
    direction = np.eye(2)[objective]
    return Target(anchor, span, direction, np.zeros(2), np.array([1.0, TIE, TIE]))


def extreme(anchor: Array, span: Array, objective: int) -> Target:
    """Minimise one objective; the other only breaks ties."""
    free = np.where(np.arange(2) == objective, 0.0, NO_LIMIT)
    return Target(anchor, span, np.eye(2)[objective], free, np.array([1.0, TIE, TIE]))


def balance(anchor: Array, span: Array) -> Target:
    """Minimise the sum of both objectives and half of the larger one: where one robot can relieve
    the other at little cost, both carry alike, which leaves most room for payload."""
    middle = np.full(2, anchor.mean())
    return Target(middle, span, np.ones(2), np.zeros(2), np.array([LARGER, 1.0, 1.0]))


def needed_level(target: Target, phi: Array) -> float:
    """The least level a that scaled peak forces (2,) allow."""
    ahead = target.direction > 0.0
    return float(np.max((phi - target.offset)[ahead] / target.direction[ahead]))


def level(target: Target, peak: Array) -> float:
    """What the smooth problem minimises, at given peak forces (2,) over their references.

    Infinite where a side that the direction does not open is exceeded.
    """
    phi = (peak - target.anchor) / target.span
    if np.any((phi > target.offset + CLOSED_SIDE) & (target.direction <= 0.0)):
        return float("inf")
    return float(target.cost @ np.concatenate([[needed_level(target, phi)], phi]))
