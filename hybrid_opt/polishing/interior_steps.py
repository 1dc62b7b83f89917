"""Pure pieces of the interior-point method: directions, lengths of steps, multipliers."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import nnls

from symbolic.array import Array

SHIFT, SHIFTED = 1e-7, 8.0
"""First shift of a matrix, as a share of its largest diagonal entry, and the factor to the next."""

LONGEST = 2.0
"""Longest step, in widths of the box; longer ones come of matrices that are nearly singular."""

NEAR = 0.1
"""Slack of inequalities that may have a multiplier."""

TURNS = 30
"""Iterations of the least squares for every inequality."""

DUAL_RANGE = 1e10
"""Multipliers stay within this factor of what the barrier asks for."""


def direction(M: Array, right: Array, width: Array) -> Array | None:
    """The solution of M dz = right, with M shifted until it is definite and no step leads far out
    of a box of some width (n,); None where it never does."""
    shift, scale = 0.0, max(1.0, float(np.abs(np.diag(M)).max()))
    while np.isfinite(scale) and shift < 1e3 * scale:
        factor, info = lapack.dpotrf(M + shift * np.eye(len(M)) if shift else M, lower=1)
        if info == 0:
            dz = np.asarray(lapack.dpotrs(factor, right, lower=1)[0])
            if (np.abs(dz) <= LONGEST * width).all():
                return dz
        shift = max(SHIFT * scale, SHIFTED * shift)
    return None


def largest(value: Array, change: Array, keep: float) -> float:
    """Largest share of a change, at most 1, that leaves values above zero: of each at least the
    share 1 - keep."""
    steepest = float((change / value).min(initial=0.0))
    return min(1.0, keep / -steepest) if steepest < 0.0 else 1.0


def until(value: Array, change: Array, reached: Array) -> float:
    """Share of a step until values reach a tenth of what they were, on parabolas through the value
    and its change at the start and what was reached at the end, all (n,)."""
    bend = np.minimum(reached - value - change, -1e-300)
    room = 0.9 * value
    # The positive root of room + change t + bend t^2, free of cancellation.
    root = np.sqrt(change**2 - 4.0 * bend * room)
    return float((2.0 * room / (root - change)).min())


def kept(value: Array, ideal: Array) -> Array:
    """Multipliers within a range of what the barrier asks for."""
    return np.clip(value, ideal / DUAL_RANGE, ideal * DUAL_RANGE)


def estimated(cost: Array, A: Array, slacks: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Multipliers that satisfy the conditions of optimality best, in least squares: better than
    an iteration's own where it was cut off.

    Args:
        cost, A: gradients of the objective (n,) and of the inequalities (m, n).
        slacks: of the inequalities (m,), of the lower and of the upper bounds (n,).

    Returns:
        Of the bounds (n,) in CasADi's convention, and of the inequalities (m,), not negative.
    """
    n, m = len(cost), len(A)
    slack = np.concatenate(slacks)
    near = np.flatnonzero(slack < NEAR)
    found = np.zeros(len(slack))
    if not len(near):
        # Nothing can have a multiplier; SciPy ends the process at a matrix without columns.
        return np.zeros(n), np.zeros(m)
    slopes = np.hstack([A.T, np.eye(n), -np.eye(n)])[:, near]
    conditions = np.vstack([slopes, np.diag(np.abs(slack[near]))])
    try:
        right = np.concatenate([cost, np.zeros(len(near))])
        found[near], _ = nnls(conditions, right, maxiter=TURNS * len(near))
    except RuntimeError:
        # Its iterations ran out: no multipliers, which the residuals tell.
        pass
    y, low, high = np.split(found, [m, m + n])
    return high - low, y
