"""A program's rows as one set of inequalities h(z) >= 0."""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.solvers import Program
from symbolic.array import Array


class Inequalities:
    """The sides of a program's rows that have a bound: the upper ones first, then the lower.

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
        values = self._program.values(z).take(self.rows)
        values *= self.sign
        values += self.shift
        return values

    def slopes(self, z: Array) -> Array:
        """(m, n_variables) gradients at z."""
        slopes = self._program.constraints(z)[1].take(self.rows, axis=0)
        slopes *= self.sign[:, None]
        return slopes

    def multipliers(self, y: Array) -> Array:
        """(n_rows,) multipliers of the rows in CasADi's convention, from those (m,) of the
        inequalities."""
        multipliers = np.zeros(len(self._program.below))
        multipliers[self._upper] = y[: len(self._upper)]
        multipliers[self._lower] -= y[len(self._upper) :]
        return multipliers
