"""Convex quadratic programs with the solver Clarabel, and how a Lagrangian is made convex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symbolic.array import Array

TOLERANCE = 1e-8
"""Of the solver's conditions."""

LEAST_CURVATURE = 1e-6
"""Curvature by the path that is left where the Lagrangian has less."""


@dataclass(frozen=True)
class Step:
    """A solution.

    Attributes:
        d: (n,) the step.
        rows: (rows,) multipliers, at least zero.
        bounds: (n,) of the bounds, positive above, negative below.
        solved: whether the solver reached its tolerance, or nearly.
    """

    d: Array
    rows: Array
    bounds: Array
    solved: bool


def solve(H: Array, g: Array, A: Array, b: Array, low: Array, high: Array) -> Step:
    """Minimise d^T H d / 2 + g.d where A d <= b and low <= d <= high."""
    # Not imported at the top: only a polish needs it.
    import clarabel
    from scipy import sparse

    n = len(g)
    free = high > low
    k = np.flatnonzero(free)
    fixed = np.where(free, 0.0, low)
    b = b - A @ fixed
    eye = sparse.identity(len(k), format="csc")
    rows = sparse.vstack([sparse.csc_matrix(A[:, k]), eye, -eye], format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    settings.max_iter = 60
    found = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(H[np.ix_(k, k)])),
        g[k] + H[k] @ fixed,
        rows,
        np.concatenate([b, high[k], -low[k]]),
        [clarabel.NonnegativeConeT(len(b) + 2 * len(k))],
        settings,
    ).solve()
    d, bounds = fixed.copy(), np.zeros(n)
    d[k] = found.x
    z = np.array(found.z)
    bounds[k] = z[len(b) : len(b) + len(k)] - z[len(b) + len(k) :]
    solved = str(found.status) in ("Solved", "AlmostSolved") and bool(np.isfinite(d).all())
    return Step(d, z[: len(b)], bounds, solved)


def convex(H: Array, A: Array, b: Array, n_path: int) -> tuple[Array, Array]:
    """A convex model of a Lagrangian that agrees with it where active rows hold.

    Active rows are added as squares (A d - b)^2 until the block of the speeds is definite, and what
    the rest lacks is added by the eigenvalues of the path's Schur complement.

    Args:
        H: symmetric.
        A, b: (rows, n), (rows,) that are to hold with equality.
        n_path: the first variables.

    Returns:
        The matrix, positive definite, and what the squares add to the gradient.
    """
    scale = max(1e-3, float(np.abs(H).max()))
    square = A.T @ A
    speeds, path = slice(n_path, len(H)), slice(0, n_path)
    weight = scale
    for _ in range(4):
        total = H + weight * square
        lowest = float(np.linalg.eigvalsh(total[speeds, speeds])[0])
        if lowest > 1e-8 * scale:
            break
        weight *= 10.0
    else:
        weight /= 10.0
        total[speeds, speeds] += (1e-6 * scale - min(lowest, 0.0)) * np.eye(len(H) - n_path)
    mixed = total[path, speeds]
    reduced = total[path, path] - mixed @ np.linalg.solve(total[speeds, speeds], mixed.T)
    values, vectors = np.linalg.eigh((reduced + reduced.T) / 2.0)
    lifted = np.maximum(np.abs(values), LEAST_CURVATURE)
    total[path, path] += (vectors * (lifted - values)) @ vectors.T
    return np.asarray((total + total.T) / 2.0), np.asarray(-weight * (A.T @ b))
