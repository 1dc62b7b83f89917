"""Hermitian 3 by 3 matrices as nine real expressions: what a round patch's cone consists of."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

Complex = tuple[ca.SX, ca.SX]
"""Real and imaginary part."""

SIZE = 9
SLOTS = ((1, 0), (2, 0), (2, 1))
"""Row and column of the entries below the diagonal."""


def times(x: Complex, y: Complex) -> Complex:
    """The product of two numbers."""
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


@dataclass(frozen=True)
class Hermitian:
    """A matrix by its diagonal and by what is below it, in the order of `SLOTS`."""

    diagonal: tuple[ca.SX, ca.SX, ca.SX]
    below: tuple[Complex, Complex, Complex]

    @classmethod
    def of(cls, entries: ca.SX) -> Hermitian:
        """From (9,): the diagonal, then real and imaginary part of each entry below it."""
        below = [(entries[3 + 2 * k], entries[4 + 2 * k]) for k in range(3)]
        return cls((entries[0], entries[1], entries[2]), (below[0], below[1], below[2]))

    @property
    def entries(self) -> list[ca.SX]:
        """What `of` takes."""
        return [*self.diagonal, *(part for number in self.below for part in number)]

    def at(self, i: int, j: int) -> Complex:
        """One entry."""
        if i == j:
            return self.diagonal[i], ca.SX(0.0)
        re, im = self.below[SLOTS.index((max(i, j), min(i, j)))]
        return (re, im) if i > j else (re, -im)

    def scaled(self, factor: ca.SX) -> Hermitian:
        """Times a real number."""
        return Hermitian.of(ca.vertcat(*self.entries) * factor)

    def less(self, other: Hermitian) -> Hermitian:
        """This one less another one."""
        return Hermitian.of(ca.vertcat(*self.entries) - ca.vertcat(*other.entries))

    def moved(self, change: Hermitian, length: ca.SX) -> Hermitian:
        """After so much of a change."""
        return Hermitian.of(ca.vertcat(*self.entries) + length * ca.vertcat(*change.entries))

    def adjugate(self) -> Hermitian:
        """Whose product with this matrix is the determinant times one."""
        (d0, d1, d2), (a, b, c) = self.diagonal, self.below

        def size(x: Complex) -> ca.SX:
            return x[0] ** 2 + x[1] ** 2

        def minor(x: Complex, y: Complex, d: ca.SX, z: Complex) -> Complex:
            one = times(x, y)
            return one[0] - d * z[0], one[1] - d * z[1]

        return Hermitian(
            (d1 * d2 - size(c), d0 * d2 - size(b), d0 * d1 - size(a)),
            (
                minor(b, (c[0], -c[1]), d2, a),
                minor(a, c, d1, b),
                minor((a[0], -a[1]), b, d0, c),
            ),
        )

    def trace_with(self, other: Hermitian) -> ca.SX:
        """The trace of the product with another one."""
        total = ca.SX(0.0)
        for mine, its in zip(self.diagonal, other.diagonal, strict=True):
            total += mine * its
        for one, two in zip(self.below, other.below, strict=True):
            total += 2.0 * (one[0] * two[0] + one[1] * two[1])
        return total

    def determinant(self, adjugate: Hermitian) -> ca.SX:
        """The determinant, given the adjugate; to some digits also where two eigenvalues vanish."""
        (_, p, q), (re, im) = adjugate.diagonal, adjugate.below[2]
        return (p * q - re**2 - im**2) / self.diagonal[0]

    def product(self, other: Hermitian) -> list[list[Complex]]:
        """All entries of the product with another one, which need not be Hermitian."""
        return multiplied(self.rows, other.rows)

    @property
    def rows(self) -> list[list[Complex]]:
        """All entries."""
        return [[self.at(i, j) for j in range(3)] for i in range(3)]


def multiplied(x: list[list[Complex]], y: list[list[Complex]]) -> list[list[Complex]]:
    """The product of two 3 by 3 matrices."""
    found = []
    for i in range(3):
        row = []
        for j in range(3):
            terms = [times(x[i][k], y[k][j]) for k in range(3)]
            row.append((sum(t[0] for t in terms), sum(t[1] for t in terms)))
        found.append(row)
    return found


def hermitian_part(x: list[list[Complex]]) -> Hermitian:
    """Half the sum of a matrix and its conjugate transpose."""
    below = [(0.5 * (x[i][j][0] + x[j][i][0]), 0.5 * (x[i][j][1] - x[j][i][1])) for i, j in SLOTS]
    return Hermitian((x[0][0][0], x[1][1][0], x[2][2][0]), (below[0], below[1], below[2]))
