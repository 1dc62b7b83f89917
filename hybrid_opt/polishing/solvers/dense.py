"""Dense interior-point method for programs of few variables and many inequalities.

The polish's programs have about twenty variables and two hundred rows, nearly all of them
inequalities. Condensed to the variables, Newton's system is a matrix of twenty by twenty, where a
sparse solver factorises one of four hundred. The barrier falls as its problems are solved, as with
Waechter and Biegler (2006). In place of their filter, satisfied rows stay satisfied in every
iterate: a step is shortened until they do, and their slacks are the rows' values (feasible mode of
Byrd, Nocedal and Waltz 2003). So a solve can be stopped at any iterate, and large steps do not pass
through obstacles. Violated rows have slacks of their own and a penalty.

With all inequalities h(z) >= 0, h(z) - s = 0 and the multipliers y, each step solves

    (W + A^T D A + E) dz = -c + A^T (mu / s - D r) + mu / (z - low) - mu / (high - z),

with A = dh/dz, D = y / s, r = h - s, W the Hessian of the Lagrangian, and E the Hessian of the
bounds' barrier. The iteration is in `dense.cpp`, which calls the program.
"""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.solvers.base import (
    FEASIBILITY_PATIENCE,
    FEASIBLE_ROW,
    OPTIMALITY_TOLERANCE,
    Answer,
    NonlinearProgram,
    native,
)


def dense(program: NonlinearProgram, iterations: int, barrier: float) -> Answer:
    """Solve a nonlinear program by the dense interior-point method.

    Args:
        program: the nonlinear program.
        iterations: number of iterations after which the solve stops at the next feasible iterate.
        barrier: first weight of the logarithmic barrier.

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
