"""A round contact patch: what it can carry, and how the allocation's method works with it.

A rigid flat patch of radius r may carry its load with any pressure on it, and at each point
Coulomb friction holds. With normal force N, tangential force T, shift d of the centre of pressure
and torsion tau about the normal through it, the wrenches that such pressures give are exactly
those with

    N >= 0,  |d| <= r,  |T|^2 + tau^2 / (r^2 - |d|^2) <= (mu N)^2.

This is an ellipsoidal limit surface (Howe and Cutkosky, Practical force-motion models for sliding
manipulation, IJRR 1996) whose coefficient sqrt(r^2 - |d|^2) is that of a pressure at the rim: the
largest that a pressure with this centre has, and zero where the centre is at the rim. (A uniform
pressure has 2/3 r.) It is for a disc what Caron's cone is for a rectangle (Caron, Pham and
Nakamura, Stability of surface contacts for humanoid robots, ICRA 2015): the convex hull of point
contacts all over the patch.

Proof: M = d x T + tau is the moment about the patch's centre. The largest a.T + b M that a pressure
allows is the mean over it of mu |a + b J x| = mu sqrt(|a|^2 + b^2 |x|^2 + 2 b a.(J x)), J turning
by a right angle. It grows with |x| and is concave in a.(J x), so that two points on the rim with
the same a.(J x) as the centre of pressure are best. They give
mu N sqrt(|a + b J d|^2 + b^2 (r^2 - |d|^2)), which is the support of the ellipse above.

With forces over N, T over mu, the first moment q = N d over r and M over mu r, membership reads

    (N^2 - |q|^2) (N^2 - |T|^2) >= (N M - q x T)^2,  |q| <= N,  |T| <= N:

a positive semidefinite Hermitian matrix with N on its diagonal and q, T and z + i M beside it, z
being free. Its determinant, largest over z, gives the barrier.

In the interior-point method a state is the scaled wrench, and z follows. The multipliers' matrix
has nothing real at z's place, so that eight numbers tell it.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symbolic.contact.central_path import Patch, Step, symmetric
from symbolic.contact.force_closure import WRENCH_SIZE
from symbolic.expression import Expression, reciprocal

Complex = tuple[ca.SX, ca.SX]
"""Real and imaginary part."""

HERMITIAN_SIZE = 9
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
    def vector(self) -> ca.SX:
        """What `of` takes."""
        return ca.vertcat(*self.diagonal, *(part for number in self.below for part in number))

    def at(self, i: int, j: int) -> Complex:
        """One entry."""
        if i == j:
            return self.diagonal[i], ca.SX(0.0)
        re, im = self.below[SLOTS.index((max(i, j), min(i, j)))]
        return (re, im) if i > j else (re, -im)

    def scaled(self, factor: ca.SX) -> Hermitian:
        """Times a real number."""
        return Hermitian.of(self.vector * factor)

    def less(self, other: Hermitian) -> Hermitian:
        """This one less another one."""
        return Hermitian.of(self.vector - other.vector)

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


# --- the cone ---


BARRIER_DEGREE = 3.0
"""A path-following minimiser of s f + barrier is within this over s of the least f, per patch."""


def cross_2(a: Expression, b: Expression) -> Expression:
    """Out-of-plane component of the cross product of two vectors (2,)."""
    return a[0] * b[1] - a[1] * b[0]


def patch_slack(wrench: Expression) -> Expression:
    """What a scaled wrench (6,) leaves of its cone, left side less right side of the above."""
    normal, tangent, moment = wrench[0], wrench[1:3], wrench[3:5]
    pressure = normal**2 - ca.sumsqr(moment)
    friction = normal**2 - ca.sumsqr(tangent)
    return pressure * friction - (normal * wrench[5] - cross_2(moment, tangent)) ** 2


def patch_potential(wrench: Expression) -> Expression:
    """The barrier log N - log slack at a scaled wrench (6,)."""
    return ca.log(wrench[0]) - ca.log(patch_slack(wrench))


# --- the method's patch ---


FREE_SIZE, MULTIPLIER_SIZE = WRENCH_SIZE + 1, HERMITIAN_SIZE - 1
"""Wrench and z; the multipliers' matrix."""

COSINE = (0.50018, 0.57449, -0.09524, 0.02072)
"""Polynomial in v that bounds cos(pi / 3 - 2 / 3 asin(v)) from above, within 2e-4 on [0, 1]."""

LEAST_SPREAD = 1e-60
"""Square of the eigenvalues' spread that counts as none."""


@dataclass(frozen=True)
class RoundPatch(Patch):
    """A disc."""

    wrench_size = state_size = WRENCH_SIZE
    iterate_size, correction_size = FREE_SIZE + MULTIPLIER_SIZE, HERMITIAN_SIZE
    degree = 3.0

    def centred(self, state: ca.SX, weight: ca.SX) -> ca.SX:
        """See `symbolic.contact.central_path.Patch`."""
        moment, tangent = state[3:5], state[1:3]
        # The z with the largest determinant.
        matrix = _matrix(ca.vertcat(state, ca.dot(moment, tangent) / state[0]))
        adjugate = matrix.adjugate()
        inverse = adjugate.scaled(weight / matrix.determinant(adjugate))
        return ca.vertcat(state, ca.dot(moment, tangent) / state[0], *_numbers(inverse))

    def local(self, iterate: ca.SX) -> LocalDisc:
        """See `symbolic.contact.central_path.Patch`."""
        return LocalDisc(iterate)

    def potential(self, state: ca.SX) -> ca.SX:
        """See `symbolic.contact.central_path.Patch`."""
        return patch_potential(state)

    def lowest(self, state: ca.SX, change: ca.SX) -> ca.SX:
        """By Samuelson's inequality: no eigenvalue of three lies below their mean less sqrt(2) of
        their deviation; the barrier's derivatives along the change are their sums."""
        slope, curvature = self.barrier(state)
        mean = -ca.dot(slope, change) / 3.0
        variance = ca.dot(change, ca.mtimes(curvature, change)) / 3.0 - mean**2
        return mean - ca.sqrt(2.0 * ca.fmax(variance, 0.0))

    def slack(self, state: ca.SX) -> ca.SX:
        """The least of what pressure, friction and both leave."""
        pressure = state[0] - ca.sqrt(ca.sumsqr(state[3:5]))
        friction = state[0] - ca.sqrt(ca.sumsqr(state[1:3]))
        return ca.fmin(ca.fmin(pressure, friction), patch_slack(state))


class LocalDisc:
    """See `symbolic.contact.central_path.LocalPatch`."""

    def __init__(self, iterate: ca.SX) -> None:
        """The inverse, and the stiffness."""
        self.state = iterate[:FREE_SIZE]
        self._matrix = _matrix(self.state)
        numbers = ca.vertsplit(iterate[FREE_SIZE:])
        self._multiplier = Hermitian.of(ca.vertcat(*numbers[:-1], 0.0, numbers[-1]))
        self.gap = self._matrix.trace_with(self._multiplier)
        self._adjugate = self._matrix.adjugate()
        over = reciprocal(self._matrix.determinant(self._adjugate))
        self._inverse = self._adjugate.scaled(over)
        self.stiffness = _stiffness(self._inverse, self._multiplier)

    def pull(self, weight: ca.SX, correction: ca.SX) -> ca.SX:
        """See `symbolic.contact.central_path.LocalPatch`."""
        return _paired(self._given(weight, correction))

    def _given(self, weight: ca.SX, correction: ca.SX) -> Hermitian:
        """What the multipliers become where nothing moves."""
        return self._inverse.scaled(weight).less(Hermitian.of(correction))

    def step(self, weight: ca.SX, correction: ca.SX, change: ca.SX) -> Step:
        """What S + dS is to give to the wrench tells all of it but how its diagonal is shared."""
        given = self._given(weight, correction)
        left = _paired(given) - ca.mtimes(self.stiffness, change)
        matrix, multiplier = _matrix(change), self._multiplier
        by_row = self._inverse.product(matrix)
        shares = []
        for k in (0, 1):
            terms = [times(by_row[k][j], multiplier.at(j, k))[0] for j in range(3)]
            shares.append(given.diagonal[k] - sum(terms))
        half = 0.5 * left
        target = Hermitian(
            (shares[0], shares[1], left[0] - shares[0] - shares[1]),
            ((half[3], half[4]), (half[1], half[2]), (ca.SX(0.0), half[5])),
        )
        turned = target.less(multiplier)
        lowest = _lowest(self._matrix, self._adjugate, matrix)

        def second_order() -> ca.SX:
            return hermitian_part(multiplied(by_row, turned.rows)).vector

        def gap_after(length: ca.SX) -> ca.SX:
            after = self._matrix.vector + length * matrix.vector
            held = Hermitian.of(multiplier.vector + length * turned.vector)
            return Hermitian.of(after).trace_with(held)

        return Step(
            ca.vertcat(change, *_numbers(turned)),
            lowest,
            ca.fmin(lowest, _lowest(multiplier, multiplier.adjugate(), turned)),
            second_order,
            gap_after,
        )


def _numbers(multiplier: Hermitian) -> list[ca.SX]:
    """Without what is zero at z's place."""
    *first, _, last = ca.vertsplit(multiplier.vector)
    return [*first, last]


def _matrix(free: ca.SX) -> Hermitian:
    """Matrix of a wrench and z (7,), or of their change."""
    n, t_x, t_y, q_x, q_y, m, z = ca.vertsplit(free)
    return Hermitian((n, n, n), ((q_x, q_y), (t_x, t_y), (z, m)))


def _paired(matrix: Hermitian) -> ca.SX:
    """(7,) what a matrix of multipliers does to the wrench and z."""
    q, t, c = matrix.below
    trace = sum(matrix.diagonal)
    return ca.vertcat(trace, *[2.0 * part for part in (*t, *q, c[1], c[0])])


def _stiffness(inverse: Hermitian, multiplier: Hermitian) -> ca.SX:
    """(7, 7) Re tr(A_i X^-1 A_j S) for the wrench and z; A is what an entry adds to the matrix."""
    # An entry's slot, and whether it is imaginary there.
    q, t, c = SLOTS
    entries = [None, (t, 0), (t, 1), (q, 0), (q, 1), (c, 1), (c, 0)]
    product = multiplier.product(inverse)

    def pair(one: tuple[int, int], two: tuple[int, int]) -> list[list[ca.SX]]:
        (i, j), (m, n) = one, two
        at, s = inverse.at, multiplier.at
        a, b = times(at(j, m), s(n, i)), times(at(j, n), s(m, i))
        d, e = times(at(i, m), s(n, j)), times(at(i, n), s(m, j))
        return [
            [a[0] + b[0] + d[0] + e[0], b[1] + e[1] - a[1] - d[1]],
            [d[1] + e[1] - a[1] - b[1], b[0] + d[0] - a[0] - e[0]],
        ]

    pairs = {(i, j): pair(SLOTS[i], SLOTS[j]) for i in range(3) for j in range(i + 1)}
    rows: list[list[ca.SX]] = []
    for i, first in enumerate(entries):
        row = []
        for second in entries[: i + 1]:
            if first is None or second is None:
                row.append(_with_normal(product, first or second))
                continue
            (slot, part), (other, its) = first, second
            i_1, i_2 = SLOTS.index(slot), SLOTS.index(other)
            row.append(pairs[i_1, i_2][part][its] if i_1 >= i_2 else pairs[i_2, i_1][its][part])
        rows.append(row)
    return symmetric(rows)


def _with_normal(product: list[list[Complex]], entry: tuple[tuple[int, int], int] | None) -> ca.SX:
    """Re tr(A S X^-1) for an entry's A; the normal force's is one."""
    if entry is None:
        return sum(product[k][k][0] for k in range(3))
    (i, j), imaginary = entry
    above, below = product[j][i], product[i][j]
    return below[1] - above[1] if imaginary else above[0] + below[0]


def _lowest(matrix: Hermitian, adjugate: Hermitian, change: Hermitian) -> ca.SX:
    """A bound from below of the least eigenvalue of change over matrix, to 2e-4 of their spread.

    The roots of the characteristic polynomial about their mean are those of t^3 - 3 s^2 t + q, the
    least of which is -2 s cos(a / 3), cos(a) = q / (2 s^3): a smooth function of sin((pi - a) / 2),
    for which a cubic from above stands.
    """
    over = reciprocal(matrix.determinant(adjugate))
    of_change = change.adjugate()
    trace = adjugate.trace_with(change) * over
    minors = matrix.trace_with(of_change) * over
    product = change.determinant(of_change) * over
    mean = trace * (1.0 / 3.0)
    s = ca.sqrt(ca.fmax(mean**2 - minors * (1.0 / 3.0), LEAST_SPREAD))
    q = ((mean - trace) * mean + minors) * mean - product
    v = ca.sqrt(ca.fmin(ca.fmax(0.5 + q / (4.0 * s**3), 0.0), 1.0))
    c_0, c_1, c_2, c_3 = COSINE
    return mean - 2.0 * s * (c_0 + v * (c_1 + v * (c_2 + v * c_3)))
