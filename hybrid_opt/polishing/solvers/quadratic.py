"""Convex quadratic programs, solved by DAQP, and convex models of a Lagrangian.

    minimise  d^T H d / 2 + g.d   where  A d <= b,  low <= d <= high

DAQP is a dual active-set method (Arnström, Bemporad and Axehill 2022): it adds and removes active
rows one by one, so it is fast if it starts with nearly the right ones. Its answers are checked by
their residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np
from scipy.linalg import cholesky, solve_triangular

from symbolic.array import Array

ACCEPTED_RESIDUAL = 1e-5
"""Largest residual of an accepted answer; of the objective relative to its own terms."""

MOST_ITERATIONS = 2000
"""Iterations after which a solve ends without an answer; a few hundred are the rule."""

LEAST_CURVATURE, LEAST_SHARE = 1e-3, 1e-13
"""Least eigenvalue of a convex model, absolute and as a share of the largest."""

NEGATIVE_CURVATURE_SHARE = 0.1
"""Factor that turns the absolute value of a negative curvature into the curvature of the convex
model: positive, and so small that the trust region bounds steps along it."""


@dataclass(frozen=True)
class QuadraticProgram:
    """A convex quadratic program: minimise d^T H d / 2 + g . d with A d <= b and low <= d <= high.

    Attributes:
        H, g: positive definite matrix (n, n) and vector (n,) of the objective.
        A, b: matrix (rows, n) and right side (rows,) of the rows.
        low, high: (n,) bounds of the variables, finite, low < high.
    """

    H: Array
    g: Array
    A: Array
    b: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class QuadraticAnswer:
    """Solution of a quadratic program.

    Attributes:
        d: (n,) solution.
        rows: (rows,) nonnegative multipliers of the rows.
        bounds: (n,) multipliers of the bounds, positive for upper, negative for lower ones.
    """

    d: Array
    rows: Array
    bounds: Array

    def satisfies_optimality(self, program: QuadraticProgram) -> bool:
        """Return True if this answer satisfies the optimality conditions of a quadratic program,
        which are recomputed here.

        Args:
            program: the quadratic program.
        """
        if not all(np.isfinite(part).all() for part in (self.d, self.rows, self.bounds)):
            return False
        bend, pull = program.H @ self.d, self.rows @ program.A
        slope = bend + program.g + pull + self.bounds
        room = program.b - program.A @ self.d
        to_low, to_high = self.d - program.low, program.high - self.d
        to_bound = np.where(self.bounds > 0.0, to_high, to_low)
        size = 1.0 + max(float(np.abs(bend).max()), float(np.abs(pull).max()))
        worth = 1.0 + abs(float(bend @ self.d)) / 2.0 + abs(float(program.g @ self.d))
        violated = max(-min(to_low.min(), to_high.min()), -room.min(initial=0.0))
        products = np.abs(self.rows) @ np.abs(room) + np.abs(self.bounds) @ np.abs(to_bound)
        negative = -self.rows.min(initial=0.0)
        worst = max(np.abs(slope).max() / size, violated, products / worth, negative)
        return bool(worst <= ACCEPTED_RESIDUAL)


def solve_quadratic(program: QuadraticProgram, start: Array) -> QuadraticAnswer | None:
    """Solve a quadratic program with the solver DAQP.

    Args:
        program: the quadratic program.
        start: (n + rows,) multipliers of the n bounds, then of the rows, from a similar quadratic
            program. Constraints whose multiplier is not 0 are active at the start.

    Returns:
        The solution; None if the quadratic program is infeasible, or if DAQP's answer does not
        satisfy the optimality conditions.
    """
    n = len(program.g)
    # DAQP itself would change to these variables z = L^T d, where H = L L^T, more slowly.
    inverse = solve_triangular(cholesky(program.H, lower=True), np.eye(n), lower=True).T
    rows = np.concatenate([inverse, program.A @ inverse])
    upper = np.concatenate([program.high, program.b])
    lower = np.concatenate([program.low, np.full(len(program.b), -np.inf)])
    z, _, _, report = daqp.solve(
        np.eye(n),
        program.g @ inverse,
        rows,
        upper,
        lower,
        dual_start=start,
        iter_limit=MOST_ITERATIONS,
    )
    bounds, multipliers = np.split(report["lam"], [n])
    found = QuadraticAnswer(inverse @ z, multipliers, bounds)
    return found if found.satisfies_optimality(program) else None


def convexify(H: Array, A: Array, b: Array) -> tuple[Array, Array]:
    """Return a convex quadratic model of a Lagrangian.

    The squares (A d - b)^2 of the active rows are added, so the model equals the Lagrangian for all
    steps d with A d = b. Eigenvalues that are then still negative are raised.

    Args:
        H: (n, n) Hessian of the Lagrangian.
        A: (rows, n) matrix of the active rows A d <= b.
        b: (rows,) right side of the active rows.

    Returns:
        Positive definite Hessian (n, n) of the model, and the vector (n,) that the squares add to
        the gradient.
    """
    weight = max(1e-3, float(np.abs(H).max()))
    values, vectors = np.linalg.eigh(H + weight * A.T @ A)
    raised = np.where(values < 0.0, -NEGATIVE_CURVATURE_SHARE * values, values)
    raised = np.maximum(raised, max(LEAST_CURVATURE, LEAST_SHARE * values[-1]))
    return (vectors * raised) @ vectors.T, -weight * (b @ A)
