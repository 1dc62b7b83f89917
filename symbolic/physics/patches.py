"""The two kinds of contact patch as the allocation's barrier method needs them.

A patch keeps a state that lies within its cone and begins with its scaled wrench, see
`symbolic.physics.closure`. A round patch's is that wrench (`symbolic.physics.patch_cone`).

A rectangular patch carries what pressures on it with Coulomb friction can: the sum of what its four
corners carry, each a force in its circular friction cone, because a force within the rectangle can
be shared out among the corners without changing its wrench. With pyramids in place of the circles
this is the cone of Caron, Pham and Nakamura (Stability of surface contacts for humanoid robots:
closed-form formulae of the contact wrench cone for rectangular support areas, ICRA 2015).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca

from symbolic.physics.closure import POINT_SIZE, STATE_SIZE, WRENCH_SIZE, corner_modes
from symbolic.physics.patch_cone import BARRIER_DEGREE, patch_barrier, patch_slack

CORNERS = 4
POINT_DEGREE = 2.0


class Patch(Protocol):
    """What the barrier method asks of a patch."""

    @property
    def state_size(self) -> int:
        """Entries of a state."""

    @property
    def degree(self) -> float:
        """Of the barrier: a minimiser of s f + barrier is within this over s of the least f."""

    def local(self, state: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Slope (6,) and curvature (6, 6), in the wrench, of the least barrier of its states."""

    def step(self, state: ca.SX, change: ca.SX, share: ca.SX) -> ca.SX:
        """Newton's step of the state that changes the wrench by `change` (6,).

        Args:
            share: the barrier's weight aimed at over the present one.
        """

    def lowest(self, state: ca.SX, step: ca.SX) -> ca.SX:
        """A bound from below of what the step adds to the state's eigenvalues, over them."""

    def slack(self, state: ca.SX) -> ca.SX:
        """Positive within the cone, not so beyond its boundary."""


@dataclass(frozen=True)
class RoundPatch:
    """A disc."""

    state_size: int = WRENCH_SIZE
    degree: float = BARRIER_DEGREE

    def local(self, state: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Those of the barrier."""
        slope, curvature = patch_barrier()(state)
        return slope, curvature

    def step(self, state: ca.SX, change: ca.SX, share: ca.SX) -> ca.SX:
        """The change itself."""
        return change

    def lowest(self, state: ca.SX, step: ca.SX) -> ca.SX:
        """By Samuelson's inequality: no eigenvalue of three lies below their mean less sqrt(2) of
        their deviation, and the barrier's derivatives along the step are their sums."""
        slope, curvature = patch_barrier()(state)
        mean = -ca.dot(slope, step) / 3.0
        variance = ca.dot(step, ca.mtimes(curvature, step)) / 3.0 - mean**2
        return mean - ca.sqrt(2.0 * ca.fmax(variance, 0.0))

    def slack(self, state: ca.SX) -> ca.SX:
        """The least of what pressure, friction and both leave."""
        pressure = state[0] - ca.sqrt(ca.sumsqr(state[3:5]))
        friction = state[0] - ca.sqrt(ca.sumsqr(state[1:3]))
        return ca.fmin(ca.fmin(pressure, friction), patch_slack(state))


@dataclass(frozen=True)
class RectangularPatch:
    """A rectangle.

    Attributes:
        half_x, half_y: half its sides along the pad's x and y axes [m].
    """

    half_x: float
    half_y: float
    state_size: int = STATE_SIZE
    degree: float = CORNERS * POINT_DEGREE

    def local(self, state: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Those of the corners' barriers, where the rest of the state is as it is best."""
        slope, curvature = self._barrier(state)
        outer, inner = slice(WRENCH_SIZE), slice(WRENCH_SIZE, STATE_SIZE)
        coupling = curvature[inner, outer]
        solved = ca.ldl_solve(
            ca.horzcat(slope[inner], coupling), *ca.ldl(curvature[inner, inner], False)
        )
        slope_left = slope[outer] - ca.mtimes(coupling.T, solved[:, 0])
        return slope_left, curvature[outer, outer] - ca.mtimes(coupling.T, solved[:, 1:])

    def step(self, state: ca.SX, change: ca.SX, share: ca.SX) -> ca.SX:
        """The rest of the state moves as is best with the change."""
        slope, curvature = self._barrier(state)
        outer, inner = slice(WRENCH_SIZE), slice(WRENCH_SIZE, STATE_SIZE)
        asked = share * slope[inner] + ca.mtimes(curvature[inner, outer], change)
        moved = -ca.ldl_solve(asked, *ca.ldl(curvature[inner, inner], False))
        return ca.vertcat(change, moved)

    def lowest(self, state: ca.SX, step: ca.SX) -> ca.SX:
        """Exactly: each corner's cone has two eigenvalues."""
        found = []
        for point, move in zip(self._points(state), self._points(step), strict=True):
            left = point[0] ** 2 - ca.sumsqr(point[1:])
            mean = (point[0] * move[0] - ca.dot(point[1:], move[1:])) / left
            product = (move[0] ** 2 - ca.sumsqr(move[1:])) / left
            found.append(mean - ca.sqrt(ca.fmax(mean**2 - product, 0.0)))
        return least(found)

    def slack(self, state: ca.SX) -> ca.SX:
        """What friction leaves at the corner where it leaves least."""
        return least([p[0] - ca.sqrt(ca.sumsqr(p[1:])) for p in self._points(state)])

    @property
    def _modes(self) -> list[ca.DM]:
        modes = ca.sparsify(ca.DM(corner_modes((self.half_x, self.half_y))))
        return list(ca.vertsplit(modes, POINT_SIZE))

    def _points(self, state: ca.SX) -> list[ca.SX]:
        """The corners' forces (3,)."""
        return [ca.mtimes(modes, state) for modes in self._modes]

    def _barrier(self, state: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Slope (12,) and curvature (12, 12) of the sum of -log(N^2 - |T|^2) over the corners."""
        slope, curvature = ca.SX.zeros(STATE_SIZE), ca.SX.zeros(STATE_SIZE, STATE_SIZE)
        signs = ca.diag(ca.DM([1.0, -1.0, -1.0]))
        for modes, point in zip(self._modes, self._points(state), strict=True):
            left = point[0] ** 2 - ca.sumsqr(point[1:])
            down = -2.0 * ca.mtimes(signs, point) / left
            slope += ca.mtimes(modes.T, down)
            own = ca.mtimes(down, down.T) - 2.0 * signs / left
            curvature += ca.mtimes([modes.T, own, modes])
        return slope, curvature


def least(values: list[ca.SX]) -> ca.SX:
    """The least of some values."""
    found = values[0]
    for value in values[1:]:
        found = ca.fmin(found, value)
    return found
