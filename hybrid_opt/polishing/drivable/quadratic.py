"""Quadratic programs of a step: solved, checked, and how a Lagrangian is made convex.

What the interior-point method of `interior` answers is checked by its residuals. Where they are too
large, which is rare, the solver Clarabel is asked; for all programs it takes four times as long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigvalsh_tridiagonal

from hybrid_opt.polishing.drivable.bordered import BorderedMatrix, BorderedRows, Factors
from hybrid_opt.polishing.drivable.compiled_interior import Method
from hybrid_opt.polishing.drivable.interior import Answer, QuadraticProgram
from hybrid_opt.polishing.drivable.interior import solve as solve_inside
from symbolic.array import Array

TOLERANCE = 1e-8
"""Of the solvers' conditions."""

CHECKED = 1e-6
"""The same of what is believed."""

LEAST_CURVATURE = 1e-6
"""Curvature by the path that is left where the Lagrangian has less."""

TURNED = 0.1
"""Share of a negative curvature that is kept, positive: enough to be convex, and little enough that
the box of trust ends steps along it."""


@dataclass(frozen=True)
class Step:
    """A solution.

    Attributes:
        d: (n,) the step.
        rows: (rows,) multipliers, at least zero.
        bounds: (n,) of the bounds, positive above, negative below.
        solved: whether it satisfies the conditions of optimality.
    """

    d: Array
    rows: Array
    bounds: Array
    solved: bool


def solve(program: QuadraticProgram, method: Method = solve_inside) -> Step:
    """The least value of a program, or that there is none; by a method, and Clarabel's where its
    answer does not hold."""
    found = method(program, TOLERANCE)
    if found.ending != "infeasible" and not holds(program, found):
        found = solve_by_clarabel(program)
    return Step(found.d, found.rows, found.bounds, holds(program, found))


def holds(program: QuadraticProgram, found: Answer) -> bool:
    """Whether an answer satisfies the conditions of optimality, recomputed."""
    if not all(np.isfinite(part).all() for part in (found.d, found.rows, found.bounds)):
        return False
    bend, pull = program.H.times(found.d), program.pulled(found.rows)
    slope = bend + program.g + pull + found.bounds
    room = program.right - program.times(found.d)
    to_low, to_high = found.d - program.low, program.high - found.d
    to_bound = np.where(found.bounds > 0.0, to_high, to_low)
    size = 1.0 + max(float(np.abs(bend).max()), float(np.abs(pull).max()))
    violated = max(-min(to_low.min(), to_high.min()), -room.min(initial=0.0))
    products = np.abs(found.rows) @ np.abs(room) + np.abs(found.bounds) @ np.abs(to_bound)
    negative = -found.rows.min(initial=0.0)
    return bool(max(np.abs(slope).max() / size, violated, products, negative) <= CHECKED)


def solve_by_clarabel(program: QuadraticProgram) -> Answer:
    """The same program by the solver Clarabel."""
    # Not imported at the top: it is hardly ever needed.
    import clarabel
    from scipy import sparse

    n = len(program.g)
    A = program.A.dense()
    if program.whole is not None:
        A = np.vstack([A, program.whole])
    eye = sparse.identity(n, format="csc")
    rows = sparse.vstack([sparse.csc_matrix(A), eye, -eye], format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    settings.max_iter = 60
    found = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(program.H.dense())),
        program.g,
        rows,
        np.concatenate([program.right, program.high, -program.low]),
        [clarabel.NonnegativeConeT(rows.shape[0])],
        settings,
    ).solve()
    z, m = np.array(found.z), len(A)
    solved = str(found.status) in ("Solved", "AlmostSolved")
    bounds = z[m : m + n] - z[m + n :]
    return Answer(np.array(found.x), z[:m], bounds, "solved" if solved else "failed")


def convex(H: BorderedMatrix, A: BorderedRows, b: Array) -> tuple[BorderedMatrix, Array]:
    """A convex model of a Lagrangian that agrees with it where active rows hold.

    Active rows are added as squares (A d - b)^2 until the block of the chain is definite, and what
    the rest lacks is added by the eigenvalues of the border's Schur complement.

    Args:
        A, b: (rows,) that are to hold with equality.

    Returns:
        The matrix, positive definite, and what the squares add to the gradient.
    """
    scale = max(1e-3, H.largest)
    square, weight = A.squares(np.ones(len(A))), scale
    for _ in range(4):
        total = H.plus(square, weight)
        lowest = float(
            eigvalsh_tridiagonal(total.diagonal, total.off, select="i", select_range=(0, 0))[0]
        )
        if lowest > 1e-8 * scale:
            break
        weight *= 10.0
    else:
        weight /= 10.0
        lift = np.full(len(total.diagonal), 1e-6 * scale - min(lowest, 0.0))
        total = total.raised(np.concatenate([np.zeros(len(total.corner)), lift]))
    reduced = Factors(total).reduced
    values, vectors = np.linalg.eigh((reduced + reduced.T) / 2.0)
    lifted = np.maximum(np.where(values < 0.0, -TURNED * values, values), LEAST_CURVATURE)
    corner = total.corner + (vectors * (lifted - values)) @ vectors.T
    corner = (corner + corner.T) / 2.0
    model = BorderedMatrix(corner, total.beside, total.diagonal, total.off)
    return model, -weight * A.pulled(b)
