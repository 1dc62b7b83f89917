"""Interface of nonlinear programs and their solvers.

Optimality is not taken from a solver: `optimality_residuals` recomputes it from the program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from symbolic.array import Array, Figure

OPTIMALITY_TOLERANCE = 1e-6
"""Tolerance of the optimality conditions, in scaled rows and variables."""

FEASIBLE_ROW = 1e-3
"""Violation of a scaled row at which an iterate counts as feasible."""

FEASIBILITY_PATIENCE = 3
"""Multiple of the wanted iterations after which a solve ends without a feasible iterate: stopped
earlier, it ends in an obstacle more often than not."""

MOST_SOLVE_SECONDS = 60.0
"""Wall time after which a solve is stopped. Large, because a result that depends on it is not
reproducible."""

ACTIVE_SLACK = 0.1
"""Slack below which an inequality may have a multiplier."""

NNLS_ITERATIONS = 30
"""Iterations of the least squares per inequality."""


class NonlinearProgram(Protocol):
    """A nonlinear program: minimise cost . z within bounds, with every row at least zero.

    Attributes:
        cost: (n_variables,) gradient of the linear objective.
        start, low, high: (n_variables,).
    """

    cost: Array
    start: Array
    low: Array
    high: Array

    def values(self, z: Array) -> Array:
        """Return the rows (n_rows,) at z."""

    def rows(self, z: Array) -> tuple[Array, Array]:
        """Return values (n_rows,) and slopes (n_rows, n_variables) at z."""

    def curvature(self, z: Array, weights: Array) -> Array:
        """Return second derivatives (n_variables, n_variables) of weights . rows at z."""


@dataclass(frozen=True)
class Residuals:
    """Residuals of the optimality conditions of a program.

    Attributes:
        stationarity: largest entry of the Lagrangian's gradient (scaled variables).
        feasibility: largest violation of a row or bound.
        complementarity: largest product of a multiplier and its slack.
    """

    stationarity: Figure
    feasibility: Figure
    complementarity: Figure

    def scaled(self, unit: float) -> Residuals:
        """Return residuals of the objective in units that are `unit` times smaller."""
        return Residuals(unit * self.stationarity, self.feasibility, unit * self.complementarity)


UNKNOWN = Residuals(np.nan, np.nan, np.nan)
"""Residuals of a solve without an answer."""


@dataclass(frozen=True)
class Answer:
    """Answer of a solver of nonlinear programs.

    Attributes:
        z: (n_variables,) last iterate.
        message: its status.
        converged: whether the solver reports an optimum.
        usable: whether z is finite.
        iterations: of the solver.
    """

    z: Array
    message: str
    converged: bool
    usable: bool
    iterations: int


Solve = Callable[[NonlinearProgram, int, float], Answer]
"""A solver: function of a program, the wanted number of iterations and the first barrier."""


def optimality_residuals(
    program: NonlinearProgram, z: Array, bounds: tuple[Array, Array] | None = None
) -> Residuals:
    """Compute residuals at z with the least-squares multipliers there.

    Args:
        bounds: lower and upper (n_variables,) instead of the program's.
    """
    low, high = bounds or (program.low, program.high)
    rows, slopes = program.rows(z)
    slacks = np.abs(rows), np.abs(z - low), np.abs(high - z)
    at_bounds, y = estimate_multipliers(program.cost, slopes, slacks)
    return residuals(program, z, at_bounds, y, (low, high))


def residuals(
    program: NonlinearProgram, z: Array, at_bounds: Array, y: Array, bounds: tuple[Array, Array]
) -> Residuals:
    """Compute residuals of the optimality conditions at z with given multipliers.

    Args:
        at_bounds: (n_variables,) multipliers of upper bounds, negative for lower ones.
        y: (n_rows,) of the rows.
        bounds: of the variables, lower and upper (n_variables,).
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
    """Estimate multipliers by nonnegative least squares of the optimality conditions: better than
    an iteration's own after an early stop.

    Args:
        cost, A: gradients of the objective (n,) and of the inequalities (m, n).
        slacks: of the inequalities (m,), of the lower and of the upper bounds (n,).

    Returns:
        Of upper bounds (n,), negative for lower ones, and of the inequalities (m,), nonnegative.
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
