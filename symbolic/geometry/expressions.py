"""Operations that are exact or err to a known side, for bounds of distances; placements of frames.

A lower bound of a distance stays a lower bound if every operation in it errs downwards, or upwards
where its result is subtracted. `EXACT` computes the sharpest bound, with kinks. `Softness(w)`
replaces each kink by a hyperbola of width w, which has derivatives of every order::

  |x|  <=  sqrt(x^2 + w^2)              exceeds |x| by at most w,
  max(a, b)  >=  (a + b + sqrt((a-b)^2 + w^2) - w) / 2    falls short by at most w / 2,
  min(a, b)  >=  (a + b - sqrt((a-b)^2 + w^2)) / 2        falls short by at most w / 2,
  |v|  >=  sqrt(v.v + w^2) - w          falls short by at most w.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, Protocol

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import number

_TINY = 1e-12
"""Added under roots, so that derivatives stay finite."""


@dataclass(frozen=True)
class Softness:
    """Operations on expressions, such as absolute value or maximum, whose kinks are smoothed.

    The smoothing errs to a known side: methods with `above` in their name return at least the true
    value, those with `below` at most the true value. With width 0 they are exact.

    Attributes:
        width: width of the kinks of lengths [m].
        turn: width of the kinks of entries of rotations [1], whose effect is multiplied by the size
            of a body; None for the same number as `width`.
    """

    width: float = 0.0
    turn: float | None = None

    def absolute_above(self, x: ca.SX) -> ca.SX:
        """Compute a smooth upper bound of abs(x), at most `width` larger."""
        return ca.sqrt(x * x + self.width**2) if self.width else ca.fabs(x)

    def entry_above(self, x: ca.SX) -> ca.SX:
        """Compute a smooth upper bound of abs(x), at most `turn` larger, for an entry x of a
        rotation matrix."""
        turn = self.width if self.turn is None else self.turn
        return ca.sqrt(x * x + turn**2) if turn else ca.fabs(x)

    def absolute_below(self, x: ca.SX) -> ca.SX:
        """Compute a smooth lower bound of abs(x), at most `width` smaller."""
        return self.absolute_above(x) - self.width

    def ramp_above(self, x: ca.SX) -> ca.SX:
        """Compute a smooth upper bound of max(x, 0), at most half of `width` larger; it is never
        negative."""
        return (x + ca.sqrt(x * x + self.width**2)) / 2.0 if self.width else ca.fmax(x, 0.0)

    def maximum_above(self, values: Sequence[ca.SX]) -> ca.SX:
        """Compute a smooth upper bound of the largest of n values, at most (n - 1) / 2 times
        `width` larger."""
        return _fold(self._pair_above if self.width else ca.fmax, values)

    def maximum_below(self, values: Sequence[ca.SX]) -> ca.SX:
        """Compute a smooth lower bound of the largest of n values, at most (n - 1) / 2 times
        `width` smaller."""
        if not self.width:
            return _fold(ca.fmax, values)
        return _fold(lambda a, b: self._pair_above(a, b) - self.width / 2.0, values)

    def minimum_below(self, values: Sequence[ca.SX]) -> ca.SX:
        """Compute a smooth lower bound of the least of n values, at most (n - 1) / 2 times `width`
        smaller."""
        if not self.width:
            return _fold(ca.fmin, values)
        return -self.maximum_above([-value for value in values])

    def norm_below(self, squared: ca.SX) -> ca.SX:
        """Compute a smooth lower bound of a length [m], at most `width` smaller, from the squared
        length [m^2]."""
        if self.width:
            return ca.sqrt(squared + self.width**2) - self.width
        return ca.sqrt(ca.fmax(squared, _TINY)) - _TINY**0.5

    def cosine_above(self, sine: ca.SX) -> ca.SX:
        """Compute a smooth upper bound of the absolute cosine of an angle, sqrt(1 - sine^2), at
        most `width` larger.

        Args:
            sine: sine of the angle.
        """
        rest = 1.0 - sine * sine
        if self.width:
            # 1 - sine^2 may be -1e-16 by roundoff; the width keeps the root's argument positive.
            return ca.sqrt(rest + self.width**2)
        return ca.sqrt(ca.fmax(rest, _TINY))

    def _pair_above(self, a: ca.SX, b: ca.SX) -> ca.SX:
        return (a + b + ca.sqrt((a - b) ** 2 + self.width**2)) / 2.0


def _fold(operation: Callable[[ca.SX, ca.SX], ca.SX], values: Sequence[ca.SX]) -> ca.SX:
    return reduce(operation, values)


EXACT = Softness()


# --- placements ---


class BasePose(Protocol):
    """Pose of an arm's base in the world, as arrays or symbols."""

    @property
    def rotation(self) -> Any:
        """Rotation (3, 3) of the base in the world."""

    @property
    def position(self) -> Any:
        """Position (3,) of the base in the world [m]."""


def world_placements(base: BasePose, placements: tuple[ca.SX, ca.SX]) -> list[tuple[ca.SX, ca.SX]]:
    """Compute the rotation (3, 3) and position (3,) [m] of each joint frame in the world.

    Args:
        base: pose of the arm's base.
        placements: rotations (3, 3 n) and positions (3, n) of the n joint frames in the root, side
            by side [m].
    """
    rotations, positions = placements
    R, p = ca.SX(number(base.rotation)), ca.SX(number(base.position))
    return [
        (ca.mtimes(R, rotations[:, 3 * j : 3 * j + 3]), ca.mtimes(R, positions[:, j]) + p)
        for j in range(positions.shape[1])
    ]


def clean(matrix: Array) -> Array:
    """Return a matrix whose entries within 1e-15 of -1, 0 or 1 are rounded, so that expressions
    simplify."""
    rounded = np.round(matrix)
    near = (np.abs(matrix - rounded) < 1e-15) & (np.abs(rounded) <= 1.0)
    return np.where(near, rounded, matrix)


def quaternion(R: ca.SX) -> ca.SX:
    """Compute the unit quaternion (4,), w x y z, of a rotation matrix R (3, 3), accurately for
    every angle.

    The matrix of all products of two components of the quaternion follows from R. The quaternion is
    its longest column, divided by its length (Shepperd 1978).
    """
    trace = ca.trace(R)
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    squares = [1.0 + trace] + [1.0 + 2.0 * R[k, k] - trace for k in range(3)]
    columns = [
        ca.vertcat(squares[0], x, y, z),
        ca.vertcat(x, squares[1], xy, xz),
        ca.vertcat(y, xy, squares[2], yz),
        ca.vertcat(z, xz, yz, squares[3]),
    ]
    best, largest = columns[0], squares[0]
    for column, square in zip(columns[1:], squares[1:], strict=True):
        best = ca.if_else(square > largest, column, best)
        largest = ca.fmax(largest, square)
    return best / ca.norm_2(best)
