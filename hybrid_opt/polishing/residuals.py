"""How well an answer satisfies the optimality conditions, recomputed from the program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from symbolic.array import Array


class Constrained(Protocol):
    """What of a program the conditions need; see `hybrid_opt.polishing.program.Program`."""

    cost: Array
    low: Array
    high: Array
    below: Array
    above: Array

    def constraints(self, z: Array) -> tuple[Array, Array]:
        """Values and Jacobian."""


@dataclass(frozen=True)
class Residuals:
    """How well a solution satisfies the optimality conditions of the smooth problem.

    Recomputed from the functions of the problem and the multipliers that the solver returned.

    Attributes:
        stationarity: largest entry of the Lagrangian's gradient (scaled variables).
        feasibility: largest violation of a constraint or bound of the smooth problem.
        complementarity: largest product of a multiplier and its constraint's slack.
    """

    stationarity: float
    feasibility: float
    complementarity: float

    def scaled(self, unit: float) -> Residuals:
        """With the objective in units that are so many times smaller."""
        return Residuals(unit * self.stationarity, self.feasibility, unit * self.complementarity)


UNKNOWN = Residuals(np.nan, np.nan, np.nan)
"""Of a solve that returned nothing."""


def residuals(
    program: Constrained,
    z: Array,
    lam_z: Array,
    lam_g: Array,
    bounds: tuple[Array, Array] | None = None,
) -> Residuals:
    """Residuals of the optimality conditions at z with the given multipliers.

    In CasADi's convention: positive multipliers belong to upper bounds, negative to lower ones.

    Args:
        bounds: lower and upper (n_variables,) in place of the program's.
    """
    values, jacobian = program.constraints(z)
    lagrangian = program.cost + jacobian.T @ lam_g + lam_z
    low, high = bounds or (program.low, program.high)
    sides = (
        (z, low, high, lam_z),
        (values, program.below, program.above, lam_g),
    )
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
