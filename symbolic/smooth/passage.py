"""How the payload passes an obstacle: along one direction, or over the edge between two.

The clearance of the payload from a box is the largest gap along one of a few directions. A row
that holds one of these gaps is smooth. Where the payload passes an edge, another direction
separates the two after it than before, and the clearance has a kink between. Rows that held the
larger of both gaps would tie each place of the path to its side of the edge. So the height of the
kink is a row of its own: with the gaps g, before and after, and their rates g' along the path,
both taken at a place near the kink,

    height = (g_after' g_before - g_before' g_after) / (g_after' - g_before'),

where the two straight lines meet, wherever along the path that is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.geometry.scene import BOX_NUMBERS
from symbolic.smooth.place import Place, PlaceConstraint

GAPS = "gaps"
"""Name of `gap_function`."""

DIRECTIONS = 12
"""Gaps of `Scene.separations`: both ways along three axes of the obstacle and of the payload."""


@dataclass(frozen=True, order=True)
class Separation(PlaceConstraint):
    """Gap of a separable pair along one direction of `Scene.separations` [m]."""

    pair: int
    direction: int

    scale: ClassVar[float] = 0.01

    @property
    def family(self) -> str:
        """All pairs and directions."""
        return "separation"

    def expression(self, place: Place, numbers: ca.SX) -> ca.SX:
        """The chosen gap."""
        return ca.dot(ca.vertcat(*place.gaps(numbers[:BOX_NUMBERS])), numbers[BOX_NUMBERS:])

    def count(self, place: Place) -> int:
        """Those of the obstacle and a choice."""
        return BOX_NUMBERS + DIRECTIONS

    def numbers(self, place: Place) -> Array:
        """The obstacle, and which gap."""
        return np.concatenate([place.obstacle(self.pair), _chosen(self.direction)])


@dataclass(frozen=True, order=True)
class Passing(PlaceConstraint):
    """Height of the kink from one direction of a separable pair to another [m]."""

    pair: int
    before: int
    after: int

    scale: ClassVar[float] = 0.01
    moving: ClassVar[bool] = True

    @property
    def family(self) -> str:
        """All pairs and directions."""
        return "passing"

    def expression(self, place: Place, numbers: ca.SX) -> ca.SX:
        """Where the lines of both gaps meet."""
        gaps = ca.vertcat(*place.gaps(numbers[:BOX_NUMBERS]))
        before = ca.dot(gaps, numbers[BOX_NUMBERS : BOX_NUMBERS + DIRECTIONS])
        after = ca.dot(gaps, numbers[BOX_NUMBERS + DIRECTIONS :])
        falls, rises = (ca.jtimes(gap, place.pose, place.rate) for gap in (before, after))
        return (rises * before - falls * after) / (rises - falls)

    def count(self, place: Place) -> int:
        """Those of the obstacle and two choices."""
        return BOX_NUMBERS + 2 * DIRECTIONS

    def numbers(self, place: Place) -> Array:
        """The obstacle, and which gaps."""
        chosen = (_chosen(self.before), _chosen(self.after))
        return np.concatenate([place.obstacle(self.pair), *chosen])


def _chosen(direction: int) -> Array:
    return np.asarray(np.eye(DIRECTIONS)[direction])


def gap_function(place: Place) -> ca.Function:
    """pose (6,), obstacle (BOX_NUMBERS,) -> gaps (DIRECTIONS,) along single directions [m]."""
    obstacle = ca.SX.sym("obstacle", BOX_NUMBERS)
    gaps = ca.cse([ca.densify(ca.vertcat(*place.gaps(obstacle)))])
    return ca.Function(GAPS, [place.pose, obstacle], gaps, ["pose", "obstacle"], ["gaps"])
