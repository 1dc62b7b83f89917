"""Interface of nonlinear programs and their solvers, and the polish's compiled part.

A solver's report of optimality is not trusted: `optimality_residuals` recomputes it from the
program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np

from symbolic.array import Array, Figure
from symbolic.extension import compiled_module

OPTIMALITY_TOLERANCE = 1e-6
"""Tolerance of the optimality conditions, in scaled rows and variables."""

FEASIBLE_ROW = 1e-3
"""An iterate counts as feasible if no scaled row is violated by more than this."""

FEASIBILITY_PATIENCE = 3
"""A solve without a feasible iterate ends after this multiple of the wanted iterations. Stopped
earlier, it usually ends in an obstacle."""

MOST_SOLVE_SECONDS = 60.0
"""Wall time after which a solve is stopped [s]. It is large, because a result that depends on it is
not reproducible."""

ACTIVE_SLACK = 0.1
"""Only an inequality with a smaller slack may have a multiplier."""

NNLS_ITERATIONS = 30
"""Iterations of the least-squares method per inequality."""


@cache
def native() -> Any:
    """Return the compiled module of `rows.cpp` and `solvers/dense.cpp`. It is the same for every
    cell and was compiled at installation.

    Raises:
        BridgeError: it is missing or cannot be loaded.
    """
    return compiled_module("hybrid_opt.polishing._native", "the compiled part of the polish")


class NonlinearProgram(Protocol):
    """A nonlinear program: minimise cost . z within bounds, with the value of every row (scalar
    inequality) nonnegative.

    Attributes:
        cost: (n_variables,) gradient of the linear objective.
        start, low, high: (n_variables,) start and bounds of the variables z.
    """

    cost: Array
    start: Array
    low: Array
    high: Array

    def values(self, z: Array) -> Array:
        """Return the values (n_rows,) of all rows.

        Args:
            z: (n_variables,) variables.
        """

    def rows(self, z: Array) -> tuple[Array, Array]:
        """Return values (n_rows,) and derivatives (n_rows, n_variables) of all rows.

        Args:
            z: (n_variables,) variables.
        """

    def curvature(self, z: Array, weights: Array) -> Array:
        """Return the Hessian (n_variables, n_variables) of the weighted sum of all rows.

        Args:
            z: (n_variables,) variables.
            weights: (n_rows,) weights of the rows.
        """


@dataclass(frozen=True)
class Residuals:
    """Residuals of the optimality conditions of a program.

    Attributes:
        stationarity: largest entry of the Lagrangian's gradient, in scaled variables.
        feasibility: largest violation of a row or bound.
        complementarity: largest product of a multiplier and the slack of its row or bound.
    """

    stationarity: Figure
    feasibility: Figure
    complementarity: Figure

    def scaled(self, unit: float) -> Residuals:
        """Return the residuals for an objective that is multiplied by a factor.

        Args:
            unit: the factor.
        """
        return Residuals(unit * self.stationarity, self.feasibility, unit * self.complementarity)


UNKNOWN = Residuals(np.nan, np.nan, np.nan)
"""Residuals of a solve without a result."""


@dataclass(frozen=True)
class Answer:
    """Result of a solver of nonlinear programs.

    Attributes:
        z: (n_variables,) last iterate.
        message: status message of the solver.
        converged: whether the solver reports an optimum.
        usable: whether z is finite.
        iterations: number of iterations.
    """

    z: Array
    message: str
    converged: bool
    usable: bool
    iterations: int


Solve = Callable[[NonlinearProgram, int, float], Answer]
"""A solver: function of a program, the wanted number of iterations and the first barrier
parameter."""


def optimality_residuals(
    program: NonlinearProgram, z: Array, bounds: tuple[Array, Array] | None = None
) -> Residuals:
    """Compute the optimality residuals of a nonlinear program at z with least-squares multipliers.

    Args:
        program: the nonlinear program.
        z: (n_variables,) variables.
        bounds: lower and upper bounds of the variables, (n_variables,) each; None for the program's
            own.
    """
    low, high = bounds or (program.low, program.high)
    rows, slopes = program.rows(z)
    slacks = np.abs(rows), np.abs(z - low), np.abs(high - z)
    at_bounds, y = estimate_multipliers(program.cost, slopes, slacks)
    return residuals(program, z, at_bounds, y, (low, high))


def residuals(
    program: NonlinearProgram, z: Array, at_bounds: Array, y: Array, bounds: tuple[Array, Array]
) -> Residuals:
    """Compute the residuals of the optimality conditions of a nonlinear program at z with given
    multipliers.

    Args:
        program: the nonlinear program.
        z: (n_variables,) variables.
        at_bounds: (n_variables,) multipliers of the bounds, positive for upper and negative for
            lower ones.
        y: (n_rows,) multipliers of the rows.
        bounds: lower and upper bounds of the variables, (n_variables,) each.
    """
    (low, high), (rows, slopes) = bounds, program.rows(z)
    lagrangian = program.cost - slopes.T @ y + at_bounds
    lack = -min(rows.min(initial=0.0), (z - low).min(), (high - z).min())
    slack = np.where(at_bounds > 0.0, high - z, z - low)
    products = np.concatenate([y * rows, at_bounds * slack])
    return Residuals(
        float(np.max(np.abs(lagrangian))), float(max(lack, 0.0)), float(np.abs(products).max())
    )


def estimate_multipliers(
    cost: Array, A: Array, slacks: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Estimate multipliers by nonnegative least squares on the optimality conditions.

    If a solver stopped early, they are more accurate than the solver's own multipliers.

    Args:
        cost: (n,) gradient of the objective.
        A: (m, n) gradients of the inequalities.
        slacks: distances from equality: of the m inequalities (m,), of the lower bounds (n,) and of
            the upper bounds (n,).

    Returns:
        Multipliers (n,) of the bounds, positive for upper and negative for lower ones; then
        multipliers (m,) of the inequalities, nonnegative.
    """
    # Not imported at the top: it takes long, and records of polishes are read without it.
    from scipy.optimize import nnls

    n, m = len(cost), len(A)
    slack = np.concatenate(slacks)
    near = np.flatnonzero(slack < ACTIVE_SLACK)
    found = np.zeros(len(slack))
    if not len(near):
        # Nothing can have a multiplier; SciPy ends the process at a matrix without columns.
        return np.zeros(n), np.zeros(m)
    slopes = np.hstack([A.T, np.eye(n), -np.eye(n)])[:, near]
    conditions = np.vstack([slopes, np.diag(np.abs(slack[near]))])
    try:
        right = np.concatenate([cost, np.zeros(len(near))])
        found[near], _ = nnls(conditions, right, maxiter=NNLS_ITERATIONS * len(near))
    except RuntimeError:
        # Its iterations ran out: no multipliers, which the residuals tell.
        pass
    y, low, high = np.split(found, [m, m + n])
    return high - low, y
