"""A program's rows as one set of inequalities h(z) >= 0."""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.program import Program
from symbolic.array import Array


class Inequalities:
    """The sides of a program's rows that have a bound: the upper ones first, then the lower."""

    def __init__(self, program: Program) -> None:
        self._program = program
        upper = np.flatnonzero(np.isfinite(program.above))
        lower = np.flatnonzero(np.isfinite(program.below))
        self._rows = np.concatenate([upper, lower])
        self._sign = np.concatenate([-np.ones(len(upper)), np.ones(len(lower))])
        self._shift = np.concatenate([program.above[upper], -program.below[lower]])

    def at(self, z: Array) -> tuple[Array, Array]:
        """Values (m,) and gradients (m, n_variables)."""
        values, jacobian = self._program.constraints(z)
        return (
            self._sign * values[self._rows] + self._shift,
            self._sign[:, None] * jacobian[self._rows],
        )

    def multipliers(self, y: Array) -> Array:
        """(n_rows,) multipliers of the rows in CasADi's convention, from those (m,) of the
        inequalities."""
        multipliers = np.zeros(len(self._program.below))
        np.add.at(multipliers, self._rows, -self._sign * y)
        return multipliers
