"""Symmetric positive definite systems whose first unknowns are eliminated, written out.

[A  B'] [x]   [f]            S = C - B A^-1 B',  S y = g - B A^-1 f,  x = A^-1 (f - B' y)
[B  C ] [y] = [g]
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from symbolic.expression import reciprocal

Numbers = Sequence[ca.SX]


class Elimination:
    """Factors L D L' of the first k rows and columns.

    Attributes:
        left: S, (n - k) rows of (n - k) entries, empty for k = n.
    """

    def __init__(self, matrix: Sequence[Numbers], k: int) -> None:
        """Eliminate.

        Args:
            matrix: n rows of n entries, of which those on and below the diagonal are read.
        """
        n = len(matrix)
        rows = [list(row[: i + 1]) for i, row in enumerate(matrix)]
        self._k = k
        self._factors: list[list[ca.SX]] = []  # column by column, below the diagonal
        self._over_pivot: list[ca.SX] = []
        for p in range(k):
            over = reciprocal(rows[p][p])
            column = [rows[i][p] for i in range(p + 1, n)]
            factor = [value * over for value in column]
            for i in range(p + 1, n):
                for j in range(p + 1, i + 1):
                    rows[i][j] = rows[i][j] - factor[i - p - 1] * column[j - p - 1]
            self._factors.append(factor)
            self._over_pivot.append(over)
        size = range(k, n)
        self.left = [[rows[max(i, j)][min(i, j)] for j in size] for i in size]

    def reduced(self, right: Numbers) -> list[ca.SX]:
        """f and g (n,) to the first unknowns' part for `first` (k,), and g - B A^-1 f (n - k,)."""
        found = list(right)
        for p, factor in enumerate(self._factors):
            for i, share in enumerate(factor, start=p + 1):
                found[i] = found[i] - share * found[p]
        return found

    def first(self, reduced: Numbers, second: Numbers) -> list[ca.SX]:
        """x (k,) from `reduced` and y (n - k,)."""
        found = [value * over for value, over in zip(reduced, self._over_pivot, strict=False)]
        found += second
        for p in reversed(range(self._k)):
            for i, share in enumerate(self._factors[p], start=p + 1):
                found[p] = found[p] - share * found[i]
        return found[: self._k]
