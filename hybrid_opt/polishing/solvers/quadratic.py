"""Convex quadratic programs of a border and a chain, and convex models of a Lagrangian.

    minimise  d^T H d / 2 + g.d   where  A d <= b,  low <= d <= high

The first variables, the border, meet all others. Those behind them are a chain, which meets its
neighbours only: the waypoints of a path and the squared speeds along it. Such a symmetric matrix is
a tridiagonal block with a border, factorised in a time that is linear in the chain. The method is
Mehrotra's predictor and corrector (Nocedal and Wright 2006, chapter 16.6), in `quadratic.cpp`, with
slacks s of the rows and multipliers y, z_low, z_high, until with mu -> 0

    H d + g + A^T y - z_low + z_high = 0,   A d + s = b,
    y s = z_low (d - low) = z_high (high - d) = mu.

It needs nothing from former programs. On a drivable polish of the rack with four force limits (230
programs) DAQP 0.11 without a warm start takes 2.2 times the core time in the programs and 1.4 times
in the whole polish; from the multipliers of the last program 1.1 to 1.2 times in the programs and
1.05 to 1.13 times in the whole. Answers are checked by their residuals; Clarabel solves a program
whose answer fails the check.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigvalsh_tridiagonal, lapack

from hybrid_opt.polishing.solvers.base import native
from symbolic.array import Array

QUADRATIC_TOLERANCE = 1e-8
"""Tolerance of the optimality conditions relative to their terms, and of the objective."""

ACCEPTED_RESIDUAL = 1e-5
"""Largest residual of an accepted answer; of the objective relative to its own terms."""

LEAST_CURVATURE = 1e-6
"""Least curvature in the path's variables in the convex model."""

NEGATIVE_CURVATURE_SHARE = 0.1
"""Factor that turns the absolute value of a negative curvature into the curvature of the convex
model: positive, and so small that the trust region bounds steps along it."""

Ending = Literal["solved", "infeasible", "failed"]


@dataclass(frozen=True)
class BorderedMatrix:
    """A symmetric matrix (k + n, k + n) whose last n rows and columns form a tridiagonal block.

    It couples k variables, the border, with all variables. The other n variables, the chain, are
    coupled only with the border and with their neighbours.

    Attributes:
        corner: (k, k) block of the border.
        beside: (n, k) block that couples chain and border.
        diagonal, off: (n,) diagonal and (n - 1,) off-diagonal of the chain's block.
    """

    corner: Array
    beside: Array
    diagonal: Array
    off: Array

    def plus(self, other: BorderedMatrix, weight: float = 1.0) -> BorderedMatrix:
        """Return the sum of this matrix and a multiple of another one.

        Args:
            other: the other matrix.
            weight: factor of the other matrix.
        """
        return BorderedMatrix(
            self.corner + weight * other.corner,
            self.beside + weight * other.beside,
            self.diagonal + weight * other.diagonal,
            self.off + weight * other.off,
        )

    def add_diagonal(self, by: Array) -> BorderedMatrix:
        """Return this matrix with the vector `by` (k + n,) added to its diagonal."""
        k = len(self.corner)
        corner = self.corner.copy()
        corner[np.diag_indices(k)] += by[:k]
        return BorderedMatrix(corner, self.beside, self.diagonal + by[k:], self.off)

    def times(self, d: Array) -> Array:
        """Return the product (k + n,) of the matrix and a vector d (k + n,)."""
        k = len(self.corner)
        border, chain = d[:k], d[k:]
        product = self.beside @ border + self.diagonal * chain
        product[:-1] += self.off * chain[1:]
        product[1:] += self.off * chain[:-1]
        return np.concatenate([self.corner @ border + chain @ self.beside, product])

    def dense(self) -> Array:
        """Return the dense matrix (k + n, k + n)."""
        chain = np.diag(self.diagonal) + np.diag(self.off, 1) + np.diag(self.off, -1)
        return np.block([[self.corner, self.beside.T], [self.beside, chain]])

    @property
    def largest(self) -> float:
        """Return the largest absolute entry."""
        parts = (self.corner, self.beside, self.diagonal, self.off)
        return float(max(np.abs(part).max(initial=0.0) for part in parts))


@dataclass(frozen=True)
class BorderedRows:
    """A matrix A (rows, k + n) with few entries per row: in the k border variables, and in at most
    two neighbours of the n chain variables.

    Attributes:
        border: (rows, k) entries in the border.
        column: (rows,) index of the first of the two chain variables.
        left, right: (rows,) entries in the first and the second of them.
        n_chain: number n of chain variables.
    """

    border: Array
    column: NDArray[np.intp]
    left: Array
    right: Array
    n_chain: int

    def __len__(self) -> int:
        return len(self.border)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> BorderedRows:
        """Return some of the rows.

        Args:
            chosen: mask (rows,) or indices of these rows.
        """
        border, left, right = (part[chosen] for part in (self.border, self.left, self.right))
        return BorderedRows(border, self.column[chosen], left, right, self.n_chain)

    @cached_property
    def _spread(self) -> sparse.csr_array:
        """The entries of A in the chain variables as a transposed sparse matrix (n, rows)."""
        entries = np.concatenate([self.left, self.right])
        where = np.concatenate([self.column, self.column + 1]), np.tile(np.arange(len(self)), 2)
        return sparse.csr_array((entries, where), shape=(self.n_chain, len(self)))

    def times(self, d: Array) -> Array:
        """Return A d (rows,) for a vector d (k + n,)."""
        k = self.border.shape[1]
        border, chain = d[:k], d[k:]
        beside = self.left * chain[self.column] + self.right * chain[self.column + 1]
        return np.asarray(self.border @ border + beside)

    def transpose_times(self, y: Array) -> Array:
        """Return A^T y (k + n,) for a vector y (rows,)."""
        n = self.n_chain
        chain = _summed(self.column, self.left * y, n)
        chain += _summed(self.column + 1, self.right * y, n)
        return np.concatenate([y @ self.border, chain])

    def squares(self, weight: Array) -> BorderedMatrix:
        """Return the matrix A^T diag(weight) A for weights (rows,)."""
        n, weighted = self.n_chain, self.border * weight[:, None]
        by_left, by_right = weight * self.left, weight * self.right
        diagonal = _summed(self.column, by_left * self.left, n)
        diagonal += _summed(self.column + 1, by_right * self.right, n)
        off = _summed(self.column, by_left * self.right, n)[: n - 1]
        return BorderedMatrix(self.border.T @ weighted, self._spread @ weighted, diagonal, off)

    def dense(self) -> Array:
        """Return the dense matrix (rows, k + n)."""
        return np.hstack([self.border, self._spread.T.toarray()])


def _summed(column: NDArray[np.intp], values: Array, n: int) -> Array:
    """Sum values by column.

    Args:
        column: (m,) column of each value.
        values: (m,) the values.
        n: number of columns.

    Returns:
        (n,) sum of the values of each column.
    """
    return np.asarray(np.bincount(column, values, n), dtype=float)


@dataclass(frozen=True)
class QuadraticProgram:
    """A convex quadratic program: minimise d^T H d / 2 + g . d with A d <= b and low <= d <= high.

    Attributes:
        H, g: matrix and vector (n,) of the objective.
        A, b: matrix and right side (rows,) of the rows.
        low, high: (n,) bounds of the variables, finite, low < high.
    """

    H: BorderedMatrix
    g: Array
    A: BorderedRows
    b: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class QuadraticAnswer:
    """Result of a solver of quadratic programs.

    Attributes:
        d: (n,) solution.
        rows: (rows,) nonnegative multipliers of the rows.
        bounds: (n,) multipliers of the bounds, positive for upper, negative for lower ones.
        ending: how the solve ended; 'infeasible' if multipliers prove infeasibility.
    """

    d: Array
    rows: Array
    bounds: Array
    ending: Ending

    def satisfies_optimality(self, program: QuadraticProgram) -> bool:
        """Return True if the answer satisfies the optimality conditions of a program, recomputed
        here."""
        if not all(np.isfinite(part).all() for part in (self.d, self.rows, self.bounds)):
            return False
        bend, pull = program.H.times(self.d), program.A.transpose_times(self.rows)
        slope = bend + program.g + pull + self.bounds
        room = program.b - program.A.times(self.d)
        to_low, to_high = self.d - program.low, program.high - self.d
        to_bound = np.where(self.bounds > 0.0, to_high, to_low)
        size = 1.0 + max(float(np.abs(bend).max()), float(np.abs(pull).max()))
        worth = 1.0 + abs(float(bend @ self.d)) / 2.0 + abs(float(program.g @ self.d))
        violated = max(-min(to_low.min(), to_high.min()), -room.min(initial=0.0))
        products = np.abs(self.rows) @ np.abs(room) + np.abs(self.bounds) @ np.abs(to_bound)
        negative = -self.rows.min(initial=0.0)
        worst = max(np.abs(slope).max() / size, violated, products / worth, negative)
        return bool(worst <= ACCEPTED_RESIDUAL)


def solve_quadratic(program: QuadraticProgram) -> QuadraticAnswer | None:
    """Solve a program by `solve_interior_point`; if its result is not optimal, solve by Clarabel.

    Returns:
        The result; None if the program is infeasible or neither method finds a solution.

    Raises:
        BridgeError: the compiled part is missing.
    """
    found = solve_interior_point(program)
    if found.ending == "infeasible":
        return None
    if not found.satisfies_optimality(program):
        found = solve_by_clarabel(program)
    return found if found.satisfies_optimality(program) else None


def solve_interior_point(program: QuadraticProgram) -> QuadraticAnswer:
    """Solve a program by Mehrotra's predictor-corrector method.

    The solve ends when the optimality conditions hold, or when multipliers prove infeasibility.
    """
    return QuadraticAnswer(*native().quadratic(program, QUADRATIC_TOLERANCE))


def solve_by_clarabel(program: QuadraticProgram) -> QuadraticAnswer:
    """Solve a program by Clarabel."""
    # Not imported at the top: it is hardly ever needed.
    import clarabel

    n, A = len(program.g), program.A.dense()
    eye = sparse.identity(n, format="csc")
    rows = sparse.vstack([sparse.csc_matrix(A), eye, -eye], format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = QUADRATIC_TOLERANCE
    settings.max_iter = 60
    found = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(program.H.dense())),
        program.g,
        rows,
        np.concatenate([program.b, program.high, -program.low]),
        [clarabel.NonnegativeConeT(rows.shape[0])],
        settings,
    ).solve()
    z, m = np.array(found.z), len(A)
    solved = str(found.status) in ("Solved", "AlmostSolved")
    bounds = z[m : m + n] - z[m + n :]
    return QuadraticAnswer(np.array(found.x), z[:m], bounds, "solved" if solved else "failed")


def convexify(H: BorderedMatrix, A: BorderedRows, b: Array) -> tuple[BorderedMatrix, Array]:
    """Return a convex quadratic model of a Lagrangian.

    The model agrees with the Lagrangian where the active rows are equalities. The squares (A d -
    b)^2 of the active rows are added until the tridiagonal block is positive definite. Then
    negative eigenvalues of the Schur complement of the first variables, the border, are raised.

    Args:
        H: Hessian of the Lagrangian.
        A, b: matrix and right side of the active rows A d <= b.

    Returns:
        Positive definite Hessian of the model, and the vector (n,) that the squares add to the
        gradient.
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
        total = total.add_diagonal(np.concatenate([np.zeros(len(total.corner)), lift]))
    *chain, _ = lapack.dpttrf(total.diagonal, total.off)
    follow = np.asarray(lapack.dpttrs(*chain, total.beside)[0])
    reduced = total.corner - total.beside.T @ follow
    values, vectors = np.linalg.eigh((reduced + reduced.T) / 2.0)
    lifted = np.maximum(
        np.where(values < 0.0, -NEGATIVE_CURVATURE_SHARE * values, values), LEAST_CURVATURE
    )
    corner = total.corner + (vectors * (lifted - values)) @ vectors.T
    corner = (corner + corner.T) / 2.0
    model = BorderedMatrix(corner, total.beside, total.diagonal, total.off)
    return model, -weight * A.transpose_times(b)
