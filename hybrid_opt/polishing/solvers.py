"""What solves one program, whichever solver is chosen."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_opt.polishing.residuals import Residuals
from symbolic.array import Array


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
