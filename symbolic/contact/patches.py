"""What the allocation's interior-point method asks of a contact patch, and how patches eliminate.

A patch's state lies within its cone and begins with its scaled wrench, see
`symbolic.contact.force_closure`. The cone is one of positive semidefinite matrices X: those of a
rectangle's corners are real 2 by 2 (`symbolic.contact.rectangular_patch`), a disc's is complex 3 by
3 (`symbolic.contact.round_patch`). An iterate of the method has such an X and as large a matrix S
of multipliers, both positive definite, whose product is a multiple of one on the central path.

Newton's step takes S + dS = weight / X - sym(X^-1 dX S) - correction: the direction of Helmberg,
Rendl, Vanderbei and Wolkowicz (SIAM J. Optim. 6, 1996), seen from X.

Symmetric positive definite systems whose first unknowns are eliminated are written out
(`Elimination`):

[A  B'] [x]   [f]            S = C - B A^-1 B',  S y = g - B A^-1 f,  x = A^-1 (f - B' y)
[B  C ] [y] = [g]
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import casadi as ca

from symbolic.expression import reciprocal


class Patch(ABC):
    """A kind of patch.

    Attributes:
        wrench_size: entries m of a scaled wrench: all six, or those that the patch can bear.
        state_size: entries of a program's state, with which an iterate begins.
        iterate_size: entries of an iterate: state, then multipliers.
        correction_size: entries of a correction.
        degree: pairing of X with S over the weight on the central path.
    """

    wrench_size: ClassVar[int]
    state_size: ClassVar[int]
    iterate_size: ClassVar[int]
    correction_size: ClassVar[int]
    degree: ClassVar[float]

    @abstractmethod
    def centred(self, state: ca.SX, weight: ca.SX) -> ca.SX:
        """An iterate whose X S is the weight, from a program's state."""

    @abstractmethod
    def local(self, iterate: ca.SX) -> LocalPatch:
        """What steps from an iterate need."""

    @abstractmethod
    def barrier(self, iterate: ca.SX, weight: ca.SX) -> BarrierPatch:
        """The patch's weighted barrier at an iterate's state, whatever the multipliers."""

    @abstractmethod
    def potential(self, state: ca.SX) -> ca.SX:
        """The barrier at a program's state, of which `centred` has the multipliers."""

    @abstractmethod
    def lowest(self, state: ca.SX, change: ca.SX) -> ca.SX:
        """As `StateStep.lowest_of_state`, of a change of a program's state."""

    @abstractmethod
    def slack(self, state: ca.SX) -> ca.SX:
        """Positive within the cone, not so beyond its boundary; of a program's state."""


@dataclass(frozen=True)
class StateStep:
    """A step of a patch's state alone.

    Attributes:
        change: (iterate_size,) of the iterate.
        lowest_of_state: bound from below of what it adds to the eigenvalues of X, over them.
    """

    change: ca.SX
    lowest_of_state: ca.SX


@dataclass(frozen=True)
class Step(StateStep):
    """A step of state and multipliers.

    Attributes:
        lowest: the bound for both X and S.
        second_order: () to (correction_size,) what the whole step leaves out: sym(X^-1 dX dS).
        gap_after: a share of the step to the pairing of X with S after it.
    """

    lowest: ca.SX
    second_order: Callable[[], ca.SX]
    gap_after: Callable[[ca.SX], ca.SX]


@dataclass(frozen=True)
class Aim:
    """A weight and a correction that a step is to lead to.

    Attributes:
        pull: (m,) what the multipliers give to the wrench where that does not change.
        step: that changes the wrench by (m,).
    """

    pull: ca.SX
    step: Callable[[ca.SX], Step]


class LocalPatch(Protocol):
    """A patch at an iterate.

    Attributes:
        wrench: (m,) scaled.
        stiffness: (m, m) what the multipliers give less for a change of the wrench, the rest of the
            state moving as is best.
        gap: pairing of X with S.
    """

    wrench: ca.SX
    stiffness: ca.SX
    gap: ca.SX

    def aim(self, weight: ca.SX, correction: ca.SX) -> Aim:
        """Prepare the step to a weight."""


@dataclass(frozen=True)
class BarrierPatch:
    """The barrier that keeps a patch's state within the cone, over its wrench.

    Attributes:
        stiffness: (m, m) curvature.
        pull: (m,) downhill.
        step: that changes the wrench by (m,) and leaves the multipliers.
    """

    stiffness: ca.SX
    pull: ca.SX
    step: Callable[[ca.SX], StateStep]


def least(values: list[ca.SX]) -> ca.SX:
    """The least of some values."""
    found = values[0]
    for value in values[1:]:
        found = ca.fmin(found, value)
    return found


# --- elimination ---


Numbers = Sequence[ca.SX]


class Elimination:
    """Factors L D L' of the first k rows and columns.

    Attributes:
        left: S (n - k, n - k).
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
        self.left = ca.vertcat(
            *[ca.horzcat(*[rows[max(i, j)][min(i, j)] for j in size]) for i in size]
        )

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

    @classmethod
    def whole(cls, matrix: ca.SX) -> Elimination:
        """All unknowns eliminated."""
        n = range(matrix.shape[0])
        return cls([[matrix[i, j] for j in n] for i in n], len(n))

    def solved(self, right: ca.SX) -> ca.SX:
        """x (n,) of A x = f, where all unknowns are eliminated."""
        return ca.vertcat(*self.first(self.reduced(ca.vertsplit(right)), []))
