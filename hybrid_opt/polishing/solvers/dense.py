"""A dense interior-point method for programs of few variables and many inequalities.

The polish's programs have about twenty variables and two hundred rows, nearly all of them
inequalities. Condensed to the variables, Newton's system is a matrix of twenty by twenty, where a
sparse solver factorises one of four hundred. The barrier falls as its problems are solved, as with
Waechter and Biegler (2006), but rows that hold go on to hold in every iterate, in place of their
filter: a step is shortened until they do, and its slacks are what the rows keep (Byrd, Nocedal and
Waltz 2003 call it the feasible mode). A solve may then be cut off anywhere, and large steps do not
wander through obstacles. Rows that do not hold yet have slacks of their own and a price.

With h(z) >= 0 all inequalities, h(z) - s = 0 and the multipliers y, each step solves

    (W + A^T D A + E) dz = -c + A^T (mu / s - D r) + mu / (z - low) - mu / (high - z),

A = dh/dz, D = y / s, r = h - s, W the curvature of the Lagrangian, E that of the bounds' barrier.
The iteration is in `dense.cpp`, which calls the program.
"""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.native import native
from hybrid_opt.polishing.solvers.base import (
    FEASIBILITY_PATIENCE,
    FEASIBLE_ROW,
    OPTIMALITY_TOLERANCE,
    Answer,
    NonlinearProgram,
)


def dense(program: NonlinearProgram, iterations: int, barrier: float) -> Answer:
    """Solve a program, see `solvers.base.Solve`.

    Raises:
        BridgeError: the compiled part is missing.
    """
    given = program, barrier, iterations, FEASIBILITY_PATIENCE, OPTIMALITY_TOLERANCE, FEASIBLE_ROW
    z, message, taken = native().dense(*given)
    z = np.clip(z, program.low, program.high)
    usable = bool(np.isfinite(z).all())
    return Answer(
        z=z,
        message=message if usable else "Not_Finite",
        converged=usable and message == "Solve_Succeeded",
        usable=usable,
        iterations=taken,
    )
