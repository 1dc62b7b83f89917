"""Separating-axis gaps between the payload and an obstacle, and the height of the kink between two.

The clearance of the payload from a box is the largest gap along one of a few directions: the axes
of both, and the cross products of an edge of each (the separating axis theorem, Gottschalk, Lin and
Manocha 1996). A row with one of these gaps is smooth. Where the payload passes an edge, the
separating direction changes, and the clearance has a kink. Rows with the larger of both gaps would
tie each point of the path to its side of the edge. So the height of the kink is a row of its own:
with the gaps g, before and after, and their rates g' along the path, both at a point near the kink,

    height = (g_after' g_before - g_before' g_after) / (g_after' - g_before'),

where the two straight lines meet, wherever along the path that is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import named_function, sx_parameters
from symbolic.geometry.clearance import BOX_NUMBERS
from symbolic.smooth.path_points import PathConstraint, PathPointSymbols

GAPS = "gaps"
"""Name of the function of `gap_function`."""

PARALLEL_SINE = 0.1
"""If the sine of the angle between two edges is smaller, their cross product is no separating
direction."""

PARALLEL_GAP = -1e3
"""Gap along such a direction [m]. It is so small that it never is the largest."""


DIRECTION_NUMBERS = 12
"""Number of entries of `direction_numbers`."""


def _directions() -> Array:
    """Return the coefficients of all separating directions of two boxes, one row each,
    (SEPARATING_DIRECTIONS, DIRECTION_NUMBERS). They are laid out as in `direction`, except that
    axes and edges of the obstacle are along the obstacle's own axes, not the world's."""
    found = []
    for first, axes in ((0, 1), (3, 1), (6, 3)):
        for k in range(3):
            for j in range(axes):
                one = np.zeros(DIRECTION_NUMBERS)
                one[first + k] = 1.0
                if axes > 1:
                    one[9 + j] = 1.0
                back = one.copy()
                back[first : first + 3] *= -1.0
                found += [one, back]
    return np.array(found)


_SHARES = _directions()

SEPARATING_DIRECTIONS = len(_SHARES)
"""Number of separating directions: both signs of three axes of the obstacle, of three axes of the
payload, and of the cross products of their edges. One of these separates two disjoint boxes."""


def direction_numbers(obstacle: Array, k: int) -> Array:
    """Return the coefficients (DIRECTION_NUMBERS,) of one separating direction, as `direction`
    takes them.

    Args:
        obstacle: (BOX_NUMBERS,) parameters of the obstacle; the first nine are its rotation in the
            world.
        k: index of the direction, below SEPARATING_DIRECTIONS.
    """
    along_obstacle, along_payload, edge, other = _SHARES[k].reshape(4, 3)
    rotation = obstacle[:9].reshape(3, 3)
    turned = rotation @ along_obstacle, rotation @ edge
    return np.concatenate([turned[0], along_payload, turned[1], other])


def direction(point: PathPointSymbols, numbers: ca.SX) -> ca.SX:
    """Return a direction (3,), world frame, that may separate an obstacle from the payload. It is
    not normalised.

    The direction is the sum of three terms, two of which are zero: an axis of the obstacle, an axis
    of the payload, and the cross product of an edge of the obstacle and an edge of the payload.

    Args:
        point: symbols of box pose and joints at one point of the path.
        numbers: (DIRECTION_NUMBERS,) four vectors (3,): axis of the obstacle, world frame; axis of
            the payload, box frame; edge of the obstacle, world frame; edge of the payload, box
            frame.
    """
    fixed, own, edge, other = ca.vertsplit(numbers, 3)
    turned = ca.mtimes(point.rotation, ca.horzcat(own, other))
    return fixed + turned[:, 0] + ca.cross(edge, turned[:, 1])


def gap(point: PathPointSymbols, obstacle: ca.SX, numbers: ca.SX) -> ca.SX:
    """Build the expression of the gap between payload and obstacle along one separating direction
    [m], smoothed at its kinks. It is positive where the direction separates the two bodies.

    Args:
        point: symbols of the box pose and the joints at one point of the path.
        obstacle: (BOX_NUMBERS,) rotation, centre and half edges of the obstacle, a box, in the
            world.
        numbers: (DIRECTION_NUMBERS,) coefficients of the direction, as `direction` takes them.
    """
    n = direction(point, numbers)
    return point.scene.separation(obstacle, n / ca.norm_2(n))


@dataclass(frozen=True, order=True)
class SeparatingAxisGap(PathConstraint):
    """Constraint on the gap [m] between the payload and a box-shaped obstacle along one separating
    direction.

    Attributes:
        pair: index of payload and obstacle among the active pairs.
        direction: index of the separating direction, below SEPARATING_DIRECTIONS.
    """

    pair: int
    direction: int

    family: ClassVar[str] = "separation"
    scale: ClassVar[float] = 0.01

    def expression(self, point: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Build the expression of the gap along the constraint's direction [m], negative if payload
        and obstacle overlap along it.

        Args:
            point: symbols of the box pose and the joints at one point of the path.
            numbers: (count,) parameters of the obstacle, then coefficients of the direction.
        """
        return gap(point, numbers[:BOX_NUMBERS], numbers[BOX_NUMBERS:])

    def count(self, point: PathPointSymbols) -> int:
        """Return the number of parameters: BOX_NUMBERS of the obstacle and DIRECTION_NUMBERS of the
        direction."""
        return BOX_NUMBERS + DIRECTION_NUMBERS

    def numbers(self, point: PathPointSymbols) -> Array:
        """Return the parameters (count,) of this constraint: those of the obstacle, then the
        coefficients of the direction."""
        obstacle = point.obstacle(self.pair)
        return np.concatenate([obstacle, direction_numbers(obstacle, self.direction)])


@dataclass(frozen=True, order=True)
class AxisSwitchGap(PathConstraint):
    """Constraint on the clearance [m] where the separating direction of payload and obstacle
    changes.

    There the clearance has a kink, the point at which the gaps along both directions are equal. The
    constrained value is the gap at this point.

    Attributes:
        pair: index of payload and obstacle among the active pairs.
        before: index of the separating direction before the kink.
        after: index of the separating direction after the kink.
    """

    pair: int
    before: int
    after: int

    family: ClassVar[str] = "passing"
    scale: ClassVar[float] = 0.01
    moving: ClassVar[bool] = True

    def expression(self, point: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Build the expression of the gap [m] at the kink, where the separating direction changes.
        The gaps along both directions are extended linearly along the path; the expression is their
        value where the two lines meet.

        Args:
            point: symbols of box pose and joints at a point of the path near the kink.
            numbers: (count,) parameters of the obstacle, then coefficients of the directions before
                and after the kink.
        """
        obstacle, both = (
            numbers[:BOX_NUMBERS],
            ca.vertsplit(numbers[BOX_NUMBERS:], DIRECTION_NUMBERS),
        )
        before, after = (gap(point, obstacle, one) for one in both)
        falls, rises = (ca.jtimes(one, point.pose, point.rate) for one in (before, after))
        return (rises * before - falls * after) / (rises - falls)

    def count(self, point: PathPointSymbols) -> int:
        """Return the number of parameters: BOX_NUMBERS of the obstacle and DIRECTION_NUMBERS of
        each of the two directions."""
        return BOX_NUMBERS + 2 * DIRECTION_NUMBERS

    def numbers(self, point: PathPointSymbols) -> Array:
        """Return the parameters (count,) of this constraint: those of the obstacle, then the
        coefficients of the directions before and after the kink."""
        obstacle = point.obstacle(self.pair)
        both = [direction_numbers(obstacle, k) for k in (self.before, self.after)]
        return np.concatenate([obstacle, *both])


def gap_function(point: PathPointSymbols) -> ca.Function:
    """Build the function of the gaps between the payload and a box-shaped obstacle along all
    separating directions, without smoothing.

    Inputs: pose (6,) of the box; obstacle (BOX_NUMBERS,), as from `box_numbers`; then the symbolic
    parameters of the bodies. Output: gaps (SEPARATING_DIRECTIONS,) [m]. The largest gap never
    exceeds the distance of the two bodies. For a box-shaped payload it is positive if the bodies
    are disjoint, except where edges are nearly parallel.
    """
    obstacle = ca.SX.sym("obstacle", BOX_NUMBERS)
    rotation = ca.reshape(obstacle[:9], 3, 3).T
    found = []
    for shares in _SHARES:
        fixed, own, edge, other = (ca.DM(part) for part in shares.reshape(4, 3))
        turned = ca.vertcat(ca.mtimes(rotation, fixed), own, ca.mtimes(rotation, edge), other)
        n = direction(point, turned)
        squared = ca.sumsqr(n)
        unit = n / ca.sqrt(ca.fmax(squared, PARALLEL_SINE**2))
        along = point.sharp_scene.separation(obstacle, unit)
        found.append(ca.if_else(squared < PARALLEL_SINE**2, PARALLEL_GAP, along))
    inputs = {"pose": point.pose, "obstacle": obstacle} | sx_parameters(point.model.screen)
    return named_function(GAPS, inputs, {"gaps": ca.densify(ca.vertcat(*found))})
