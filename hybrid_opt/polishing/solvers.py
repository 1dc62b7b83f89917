"""What is solved, and what comes of it, whichever solver is chosen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
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


Conditions = tuple[tuple[Array, Array], Residuals]
"""Multipliers and residuals."""


@dataclass(frozen=True)
class Answer:
    """What a solver returned.

    Attributes:
        z: (n_variables,) where it ended.
        message: its status.
        converged: whether it claims an optimum.
        usable: whether z is finite.
        iterations: its own.
        conditions: tells the multipliers and the residuals, when somebody asks for them.
    """

    z: Array
    message: str
    converged: bool
    usable: bool
    iterations: int
    conditions: Callable[[], Conditions] = field(repr=False)

    @cached_property
    def _told(self) -> Conditions:
        return self.conditions()

    @property
    def multipliers(self) -> tuple[Array, Array]:
        """Of the variables' bounds (n_variables,) and of the rows (n_rows,), in CasADi's
        convention."""
        return self._told[0]

    @property
    def residuals(self) -> Residuals:
        """Recomputed from the program."""
        return self._told[1]
