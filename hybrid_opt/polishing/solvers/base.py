"""What is solved, and what comes of it, whichever solver is chosen.

A solver's word is not trusted: `optimality` recomputes residuals from the program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from symbolic.array import Array, Figure

TOLERANCE = 1e-6
"""Tolerance of the optimality conditions, in a program's scaled rows and variables."""

FEASIBLE = 1e-3
"""Violation of a scaled row at which an iterate counts as feasible."""

PATIENCE = 3
"""Times the wanted number of iterations that a solve may take to become feasible: cut off wherever
it stands, it ends in an obstacle more often than not."""

MOST_SECONDS = 60.0
"""Wall time after which a solve is given up. Generous, because a result that depends on it cannot
be repeated."""

NEAR = 0.1
"""Slack of inequalities that may have a multiplier."""

TURNS = 30
"""Iterations of the least squares for every inequality."""


class Program(Protocol):
    """A nonlinear program: minimise cost . z within bounds, constraints within theirs.

    Attributes:
        cost: (n_variables,) gradient of the objective, which is linear.
        start, low, high: (n_variables,).
        below, above: (n_rows,) bounds of the constraints, infinite where there is none.
    """

    cost: Array
    start: Array
    low: Array
    high: Array
    below: Array
    above: Array

    def values(self, z: Array) -> Array:
        """(n_rows,) of the constraints at z."""

    def constraints(self, z: Array) -> tuple[Array, Array]:
        """Values (n_rows,) and Jacobian (n_rows, n_variables) at z."""

    def curvature(self, z: Array, multipliers: Array) -> Array:
        """(n_variables, n_variables) second derivatives of multipliers . constraints at z."""


@dataclass(frozen=True)
class Residuals:
    """How well a solution satisfies the optimality conditions of its program.

    Attributes:
        stationarity: largest entry of the Lagrangian's gradient (scaled variables).
        feasibility: largest violation of a constraint or bound.
        complementarity: largest product of a multiplier and its constraint's slack.
    """

    stationarity: Figure
    feasibility: Figure
    complementarity: Figure

    def scaled(self, unit: float) -> Residuals:
        """The same with the objective in units that are `unit` times smaller."""
        return Residuals(unit * self.stationarity, self.feasibility, unit * self.complementarity)


UNKNOWN = Residuals(np.nan, np.nan, np.nan)
"""Residuals of a solve that returned nothing."""


@dataclass(frozen=True)
class Answer:
    """Answer of a solver of nonlinear programs.

    Attributes:
        z: (n_variables,) where it ended.
        message: its status.
        converged: whether it claims an optimum.
        usable: whether z is finite.
        iterations: its own.
    """

    z: Array
    message: str
    converged: bool
    usable: bool
    iterations: int


Solve = Callable[[Program, int, float], Answer]
"""A solver: from a program, the wanted number of iterations and the barrier at the start."""


class Inequalities:
    """A program's rows as one set h(z) >= 0: the upper sides that have a bound, then the lower.

    Attributes:
        rows, sign, shift: (m,) each is sign * the program's row + shift.
    """

    def __init__(self, program: Program) -> None:
        self._program = program
        self._upper = np.flatnonzero(np.isfinite(program.above))
        self._lower = np.flatnonzero(np.isfinite(program.below))
        self.rows = np.concatenate([self._upper, self._lower])
        self.sign = np.concatenate([-np.ones(len(self._upper)), np.ones(len(self._lower))])
        self.shift = np.concatenate([program.above[self._upper], -program.below[self._lower]])

    def values(self, z: Array) -> Array:
        """(m,) at z."""
        return np.asarray(self._program.values(z)[self.rows] * self.sign + self.shift)

    def slopes(self, z: Array) -> Array:
        """(m, n_variables) gradients at z."""
        return np.asarray(self._program.constraints(z)[1][self.rows] * self.sign[:, None])

    def multipliers(self, y: Array) -> Array:
        """(n_rows,) multipliers of the rows in CasADi's convention, from those (m,) of the
        inequalities."""
        multipliers = np.zeros(len(self._program.below))
        multipliers[self._upper] = y[: len(self._upper)]
        multipliers[self._lower] -= y[len(self._upper) :]
        return multipliers


def optimality(program: Program, z: Array, bounds: tuple[Array, Array] | None = None) -> Residuals:
    """Residuals at z with the multipliers that satisfy the conditions best there.

    Args:
        bounds: lower and upper (n_variables,) in place of the program's.
    """
    low, high = bounds or (program.low, program.high)
    rows = Inequalities(program)
    slacks = np.abs(rows.values(z)), np.abs(z - low), np.abs(high - z)
    lam_z, y = estimated(program.cost, rows.slopes(z), slacks)
    return residuals(program, z, lam_z, rows.multipliers(y), (low, high))


def residuals(
    program: Program, z: Array, lam_z: Array, lam_g: Array, bounds: tuple[Array, Array]
) -> Residuals:
    """Residuals of the optimality conditions at z with the given multipliers.

    In CasADi's convention: positive multipliers belong to upper bounds, negative to lower ones.

    Args:
        bounds: of the variables, lower and upper (n_variables,).
    """
    values, jacobian = program.constraints(z)
    lagrangian = program.cost + jacobian.T @ lam_g + lam_z
    low, high = bounds
    sides = (z, low, high, lam_z), (values, program.below, program.above, lam_g)
    violation, product = 0.0, 0.0
    for value, low, high, multiplier in sides:
        violation = max(
            violation, np.max(low - value, initial=0.0), np.max(value - high, initial=0.0)
        )
        slack = np.where(multiplier > 0.0, high - value, value - low)
        # A multiplier of an absent bound has nothing to be complementary to: it must vanish.
        scaled = np.where(np.isfinite(slack), np.abs(slack), 1.0)
        product = max(product, np.max(np.abs(multiplier) * scaled, initial=0.0))
    return Residuals(float(np.max(np.abs(lagrangian))), float(violation), float(product))


def estimated(cost: Array, A: Array, slacks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Multipliers that satisfy the conditions of optimality best, in least squares: better than
    an iteration's own where it was cut off.

    Args:
        cost, A: gradients of the objective (n,) and of the inequalities (m, n).
        slacks: of the inequalities (m,), of the lower and of the upper bounds (n,).

    Returns:
        Of the bounds (n,) in CasADi's convention, and of the inequalities (m,), not negative.
    """
    # Not imported at the top: it takes long, and records of polishes are read without it.
    from scipy.optimize import nnls

    n, m = len(cost), len(A)
    slack = np.concatenate(slacks)
    near = np.flatnonzero(slack < NEAR)
    found = np.zeros(len(slack))
    if not len(near):
        # Nothing can have a multiplier; SciPy ends the process at a matrix without columns.
        return np.zeros(n), np.zeros(m)
    slopes = np.hstack([A.T, np.eye(n), -np.eye(n)])[:, near]
    conditions = np.vstack([slopes, np.diag(np.abs(slack[near]))])
    try:
        right = np.concatenate([cost, np.zeros(len(near))])
        found[near], _ = nnls(conditions, right, maxiter=TURNS * len(near))
    except RuntimeError:
        # Its iterations ran out: no multipliers, which the residuals tell.
        pass
    y, low, high = np.split(found, [m, m + n])
    return high - low, y
