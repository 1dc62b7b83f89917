"""Matrices of a border and a chain.

The first variables, the border, meet all others. Those behind them are a chain, which meets its
neighbours only: the waypoints of a path and the squared speeds along it. Such a symmetric matrix
is a tridiagonal block with a border, factorised in a time that is linear in the chain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import lapack

from symbolic.array import Array


@dataclass(frozen=True)
class BorderedMatrix:
    """A symmetric matrix.

    Attributes:
        corner: (k, k) of the border.
        beside: (n, k) of the chain by the border.
        diagonal, off: (n,) and (n - 1,) of the chain.
    """

    corner: Array
    beside: Array
    diagonal: Array
    off: Array

    def plus(self, other: BorderedMatrix, weight: float = 1.0) -> BorderedMatrix:
        """The sum with a multiple of another one."""
        return BorderedMatrix(
            self.corner + weight * other.corner,
            self.beside + weight * other.beside,
            self.diagonal + weight * other.diagonal,
            self.off + weight * other.off,
        )

    def raised(self, by: Array) -> BorderedMatrix:
        """With (k + n,) added to its diagonal."""
        k = len(self.corner)
        corner = self.corner.copy()
        corner[np.diag_indices(k)] += by[:k]
        return BorderedMatrix(corner, self.beside, self.diagonal + by[k:], self.off)

    def times(self, d: Array) -> Array:
        """The product with (k + n,)."""
        k = len(self.corner)
        border, chain = d[:k], d[k:]
        product = self.beside @ border + self.diagonal * chain
        product[:-1] += self.off * chain[1:]
        product[1:] += self.off * chain[:-1]
        return np.concatenate([self.corner @ border + chain @ self.beside, product])

    def dense(self) -> Array:
        """(k + n, k + n)."""
        chain = np.diag(self.diagonal) + np.diag(self.off, 1) + np.diag(self.off, -1)
        return np.block([[self.corner, self.beside.T], [self.beside, chain]])

    @property
    def largest(self) -> float:
        """Largest absolute entry."""
        parts = (self.corner, self.beside, self.diagonal, self.off)
        return float(max(np.abs(part).max(initial=0.0) for part in parts))


@dataclass(frozen=True)
class BorderedRows:
    """Rows A that hold at most two neighbours of the chain.

    Attributes:
        border: (rows, k).
        column: (rows,) the first of the two neighbours.
        left, right: (rows,) the entries there.
        n_chain: variables of the chain.
    """

    border: Array
    column: NDArray[np.intp]
    left: Array
    right: Array
    n_chain: int

    def __len__(self) -> int:
        return len(self.border)

    def of(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> BorderedRows:
        """Some of the rows."""
        return BorderedRows(
            self.border[chosen],
            self.column[chosen],
            self.left[chosen],
            self.right[chosen],
            self.n_chain,
        )

    @cached_property
    def _spread(self) -> sparse.csr_array:
        """(n, rows) the chain's part, transposed."""
        entries = np.concatenate([self.left, self.right])
        where = np.concatenate([self.column, self.column + 1]), np.tile(np.arange(len(self)), 2)
        return sparse.csr_array((entries, where), shape=(self.n_chain, len(self)))

    def times(self, d: Array) -> Array:
        """(rows,) A d."""
        k = self.border.shape[1]
        border, chain = d[:k], d[k:]
        beside = self.left * chain[self.column] + self.right * chain[self.column + 1]
        return np.asarray(self.border @ border + beside)

    def pulled(self, y: Array) -> Array:
        """(k + n,) A^T y."""
        n = self.n_chain
        chain = _summed(self.column, self.left * y, n)
        chain += _summed(self.column + 1, self.right * y, n)
        return np.concatenate([y @ self.border, chain])

    def squares(self, weight: Array) -> BorderedMatrix:
        """A^T diag(weight) A."""
        n, weighted = self.n_chain, self.border * weight[:, None]
        by_left, by_right = weight * self.left, weight * self.right
        diagonal = _summed(self.column, by_left * self.left, n)
        diagonal += _summed(self.column + 1, by_right * self.right, n)
        off = _summed(self.column, by_left * self.right, n)[: n - 1]
        return BorderedMatrix(self.border.T @ weighted, self._spread @ weighted, diagonal, off)

    def dense(self) -> Array:
        """(rows, k + n)."""
        return np.hstack([self.border, self._spread.T.toarray()])


def _summed(column: NDArray[np.intp], values: Array, n: int) -> Array:
    """(n,) sums of values by column."""
    return np.asarray(np.bincount(column, values, n), dtype=float)


class Factors:
    """Of a matrix that is to be positive definite.

    Attributes:
        ok: whether it is.
    """

    def __init__(self, matrix: BorderedMatrix) -> None:
        *self._chain, first = lapack.dpttrf(matrix.diagonal, matrix.off)
        self._beside, self.ok = matrix.beside, first == 0
        if not self.ok:
            return
        self._follow = self._along(matrix.beside)
        self.reduced = matrix.corner - matrix.beside.T @ self._follow
        self._corner, second = lapack.dpotrf(self.reduced, lower=1)
        self.ok = second == 0

    def _along(self, right: Array) -> Array:
        return np.asarray(lapack.dpttrs(*self._chain, right)[0])

    def solve(self, right: Array) -> Array:
        """The matrix's inverse times (k + n,)."""
        k = len(self._corner)
        chain = self._along(right[k:, None])[:, 0]
        border = lapack.dpotrs(self._corner, right[:k] - chain @ self._beside, lower=1)[0]
        return np.concatenate([border, chain - self._follow @ border])
