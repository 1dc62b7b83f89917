"""What is solved, and what comes of it, whichever solver is chosen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from hybrid_opt.polishing.residuals import Residuals
from symbolic.array import Array


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
class Answer:
    """What a solver returned.

    Attributes:
        z: (n_variables,) where it ended.
        message: its status.
        converged: whether it claims an optimum.
        usable: whether z is finite.
        multipliers: of the variables' bounds (n_variables,) and of the rows (n_rows,), in CasADi's
            convention.
        residuals: recomputed here.
        iterations: its own.
    """

    z: Array
    message: str
    converged: bool
    usable: bool
    multipliers: tuple[Array, Array]
    residuals: Residuals
    iterations: int
