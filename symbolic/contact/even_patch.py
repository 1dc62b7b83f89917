"""A patch under even pressure in the interior-point method of contact forces, disc or rectangle.

Its cone is the limit surface of `symbolic.contact.soft_finger`. With grip = sqrt(N^2 - |T|^2), the
friction left beside the tangential force (forces over N, tangential ones over mu), torsion is at
most f = grip lever(grip / N). f is concave and of degree one, so that

    -log(f^2 - M^2)

is a barrier of degree 2. The cone is not a cone of positive semidefinite matrices and its dual has
no closed form, so steps use the barrier alone. An iterate has the state x, multipliers z and a
weight w. On the central path z = -w grad; the distance of z from this value shows how near the path
the iterate is. With the barrier's second and third derivatives H and T,

    z + dz = -weight grad - w H dx - correction,   correction = w / 2 T[dx, dx] - w H dx.

The correction has the second-order terms of a step to weight zero (Coey, Kapelevich and Vielma,
Math. Program. Comput. 15, 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symbolic.contact.central_path import Factors, NewtonStep, Patch
from symbolic.contact.force_closure import EVEN
from symbolic.contact.soft_finger import SoftPatch, torsion_capacity

DEGREE = 2.0

CHORDS = 5
"""Number of secant steps on the concave slack along a step. Each ends within the cone."""

LEAST_LENGTH = 1e-12
"""Smallest length of a step."""

NEAR_PATH, OFF_PATH = 0.1, 0.6
"""Distances of the multipliers from the barrier's, in the norm of its Hessian. Below the first a
step aims freely; above the second it aims back at the central path."""

LEAST_TRUST = 1e-3
"""Share of the way to the boundary that a step far from the central path may aim at."""

SAFE = 0.9
"""Largest share of the way to the boundary in one step: Newton's method leaves the boundary
slowly."""


@dataclass(frozen=True)
class EvenPatch(Patch):
    """Contact patch under uniform pressure. Its state (4,) is N, T / mu (2,), M / (mu r): normal
    force N, tangential force T, torsion M, friction coefficient mu, patch radius r.

    Attributes:
        shape: lengths of the patch over its radius, along the pad's axes.
    """

    shape: SoftPatch
    wrench_size = state_size = correction_size = len(EVEN)
    iterate_size, degree = 2 * len(EVEN) + 1, DEGREE

    def centred(self, state: ca.SX, weight: ca.SX) -> ca.SX:
        """Return the iterate (9,): the state (4,), the multipliers (4,), which are -weight times
        the barrier's gradient, and the weight."""
        return ca.vertcat(state, -weight * self.barrier(state)[0], weight)

    def local(self, iterate: ca.SX) -> LocalEven:
        """Return the barrier's derivatives at an iterate (9,)."""
        return LocalEven(self, iterate)

    def potential(self, state: ca.SX) -> ca.SX:
        """Compute the barrier -log(f^2 - M^2) at a state (4,). M is the torsion of the state, and f
        the largest torsion that the patch bears beside the state's tangential force."""
        grip = ca.sqrt(self._grip_squared(state))
        return -ca.log(torsion_capacity(grip, state[1:3], self.shape)[0] ** 2 - state[3] ** 2)

    def lowest(self, state: ca.SX, change: ca.SX) -> ca.SX:
        """Compute -1 / t, where t > 0 is a step length with which `state` + t `change`, both (4,),
        lies inside the cone; t is nearly the largest such length.
        """
        # The friction limit: the lower eigenvalue of (N, T).
        square = self._grip_squared(state)
        mean = (state[0] * change[0] - ca.dot(state[1:3], change[1:3])) / square
        lower = mean - ca.sqrt(
            ca.fmax(mean**2 - (change[0] ** 2 - ca.sumsqr(change[1:3])) / square, 0.0)
        )
        far = 1.0 / ca.fmax(-lower, LEAST_LENGTH)
        beyond = -ca.fabs(state[3] + far * change[3])
        near, left = ca.SX(0.0), self.slack(state)
        for _ in range(CHORDS):
            near = near + (far - near) * left / (left - beyond)
            left = ca.fmax(self.slack(state + near * change), 0.0)
        return -1.0 / ca.fmax(near, LEAST_LENGTH)

    def slack(self, state: ca.SX) -> ca.SX:
        """Compute the margin of a state (4,) against sliding, in the units of the state: positive
        while the patch holds, negative if it slides.

        If friction bears the tangential force, the margin is the largest torsion beside this force
        minus the absolute torsion of the state. Otherwise it is the normal force minus the
        tangential force over the friction coefficient.
        """
        grip = ca.sqrt(ca.fmax(self._grip_squared(state), 0.0))
        torsion = torsion_capacity(grip, state[1:3], self.shape)[0] - ca.fabs(state[3])
        friction = state[0] - ca.sqrt(ca.sumsqr(state[1:3]))
        return ca.if_else(friction > 0.0, torsion, friction)

    def _grip_squared(self, state: ca.SX) -> ca.SX:
        tangent = ca.sqrt(ca.sumsqr(state[1:3]) + 1e-300)
        return (state[0] - tangent) * (state[0] + tangent)


class LocalEven:
    """Derivatives of an `EvenPatch`'s barrier at an iterate.

    Attributes:
        slope, curvature: gradient (4,) and Hessian (4, 4) of the barrier by the state.
        stored: weight of the barrier in the iterate.
        weight: weight that steps use, `stored` or more.
        trust: share of the way to the cone's boundary that a step may aim at.
    """

    def __init__(self, patch: EvenPatch, iterate: ca.SX) -> None:
        """Compute the barrier's derivatives at an iterate, and the attributes `weight` and `trust`.

        `weight` is the weight in the iterate or, if larger, x . z / `DEGREE` with state x and
        multipliers z. `trust` is the share of the way to the cone's boundary up to which a step may
        go. It falls from 1 to `LEAST_TRUST` as z departs from its value on the central path.

        Args:
            patch: the patch.
            iterate: (9,) state (4,), multipliers (4,) and weight.
        """
        self.patch = patch
        self.state, self.multiplier, weight = ca.vertsplit(
            iterate, [0, len(EVEN), 2 * len(EVEN), patch.iterate_size]
        )
        self.slope, self.curvature = patch.barrier(self.state)
        self.stored = weight
        self.weight = ca.fmax(weight, ca.dot(self.state, self.multiplier) / DEGREE)
        self.gap = DEGREE * self.weight
        self.stiffness = self.weight * self.curvature
        off = self.multiplier / self.weight + self.slope
        factors = Factors(self.curvature)
        away = ca.sqrt(ca.fmax(ca.dot(off, factors.backward(factors.forward(off))), 0.0))
        near = (OFF_PATH - away) / (OFF_PATH - NEAR_PATH)
        self.trust = ca.fmin(ca.fmax(near, LEAST_TRUST), 1.0)

    def pull(self, weight: ca.SX, correction: ca.SX) -> ca.SX:
        """Compute the multipliers (4,) that a Newton step would give if it left the state
        unchanged.

        Args:
            weight: weight of the barrier after the step.
            correction: (4,) second-order correction of the multipliers; zero in a predictor step.
        """
        return -weight * self.slope - correction

    def step(self, weight: ca.SX, correction: ca.SX, change: ca.SX) -> NewtonStep:
        """Compute the Newton step of an iterate (state, multipliers, weight) in which the state
        changes by `change`.

        Args:
            weight: weight of the barrier after a full step.
            correction: (4,) second-order correction of the multipliers; zero in a predictor step.
            change: (4,) change of the state in a full step.

        Returns:
            Change (9,) of the iterate in a full step, limits of the step length, and functions for
            the correction and the gap after a step (`NewtonStep`).
        """
        lowest, grown = self.patch.lowest(self.state, change), weight - self.stored
        of_state = lowest / self.trust
        left = self.pull(weight, correction) - ca.mtimes(self.stiffness, change)
        turned = left - self.multiplier

        def second_order() -> ca.SX:
            far = ca.fmin(1.0, -1.0 / of_state)
            turning = self.patch.third(self.state, change, change)
            return far**2 * (self.weight * (turning / 2.0 - ca.mtimes(self.curvature, change)))

        def gap_after(length: ca.SX) -> ca.SX:
            state = self.state + length * change
            multiplier = self.multiplier + length * turned
            return ca.fmax(DEGREE * (self.stored + length * grown), ca.dot(state, multiplier))

        return NewtonStep(
            ca.vertcat(change, turned, grown), of_state, lowest / SAFE, second_order, gap_after
        )
