"""A rectangular patch in the allocation's interior-point method.

It carries what pressures on it with Coulomb friction can: the sum of what its four corners carry,
each a force in its circular friction cone, because a force within the rectangle can be shared out
among the corners without changing its wrench. With pyramids in place of the circles this is the
cone of Caron, Pham and Nakamura (Stability of surface contacts for humanoid robots: closed-form
formulae of the contact wrench cone for rectangular support areas, ICRA 2015).

A corner's force (N, T / mu) is a real symmetric matrix [[N + T_x, T_y], [T_y, N - T_x]], so that
inverses and products of three are those of vectors: 1 / f = J f / det f with J = diag(1, -1, -1)
and det f = f . J f, and sym(a b c) = a (b . c) + c (a . b) - (a . J c) J b.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symbolic.contact.central_path import Patch, Step, least
from symbolic.contact.force_closure import POINT_SIZE, STATE_SIZE, WRENCH_SIZE
from symbolic.expression import reciprocal

CORNERS = 4.0
WAVES = 4
"""Ways in which a number varies over the corners: all the same, alternating along x, along y, and
along both."""

_J = ca.DM([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class RectangularPatch(Patch):
    """A rectangle.

    Attributes:
        half_x, half_y: half its sides along the pad's x and y axes [m].
    """

    half_x: float | ca.SX
    half_y: float | ca.SX
    wrench_size, iterate_size, degree = WRENCH_SIZE, 2 * STATE_SIZE, CORNERS
    state_size = correction_size = STATE_SIZE

    def centred(self, state: ca.SX, weight: ca.SX) -> ca.SX:
        """See `symbolic.contact.central_path.Patch`."""
        return ca.vertcat(state, *[weight * _inverse(f) for f in self._corners(state)])

    def local(self, iterate: ca.SX) -> LocalRectangle:
        """See `symbolic.contact.central_path.Patch`."""
        return LocalRectangle(self, iterate)

    def potential(self, state: ca.SX) -> ca.SX:
        """See `symbolic.contact.central_path.Patch`."""
        return -0.5 * sum(ca.log(_determinant(f)) for f in self._corners(state))

    def barrier(self, state: ca.SX) -> tuple[ca.SX, ca.SX]:
        """See `symbolic.contact.central_path.Patch`; shorter than what CasADi derives."""
        local, one = self.local(self.centred(state, ca.SX(1.0))), ca.SX(1.0)
        return -local.pull(one, ca.SX.zeros(STATE_SIZE)), local.stiffness

    def lowest(self, state: ca.SX, change: ca.SX) -> ca.SX:
        """Exactly: each corner has two eigenvalues."""
        return least(list(map(_lowest, self._corners(state), self._corners(change))))

    def slack(self, state: ca.SX) -> ca.SX:
        """What friction leaves at the corner where it leaves least."""
        return least([f[0] - ca.sqrt(ca.sumsqr(f[1:])) for f in self._corners(state)])

    def _corners(self, state: ca.SX) -> list[ca.SX]:
        """The corners' forces (3,)."""
        return corners_of(self.waves(state))

    @property
    def _sides(self) -> tuple[float | ca.SX, float | ca.SX]:
        """Over the whole diagonal."""
        radius = (self.half_x**2 + self.half_y**2) ** 0.5
        return self.half_x / radius, self.half_y / radius

    def waves(self, state: ca.SX) -> list[list[ca.SX]]:
        """Four times what the corners' N, T_x and T_y are sums of, wave by wave."""
        x, y = self._sides
        n, t_x, t_y, q_x, q_y, m, n_xy, x_x, x_xy, y_y, y_xy, more = ca.vertsplit(state)
        return [
            [n, q_x * (1.0 / x), q_y * (1.0 / y), n_xy],
            [t_x, x_x, x * more - y * m, x_xy],
            [t_y, x * m + y * more, y_y, y_xy],
        ]

    def gathered(self, waves: list[list[ca.SX]]) -> list[ca.SX]:
        """The transposed map: what acts on the waves, as it acts on the state, a quarter of it."""
        x, y = self._sides
        (n, n_x, n_y, n_xy), (t_x, x_x, x_y, x_xy), (t_y, y_x, y_y, y_xy) = waves
        outer = [n, t_x, t_y, n_x * (1.0 / x), n_y * (1.0 / y), x * y_x - y * x_y]
        return [*outer, n_xy, x_x, x_xy, y_y, y_xy, x * x_y + y * y_x]


class LocalRectangle:
    """See `symbolic.contact.central_path.LocalPatch`."""

    def __init__(self, patch: RectangularPatch, iterate: ca.SX) -> None:
        """Inverses of the corners' matrices, and the stiffness."""
        self._patch = patch
        self.state = iterate[:STATE_SIZE]
        self._force = corners_of(patch.waves(self.state))
        self._multiplier = list(ca.vertsplit(iterate[STATE_SIZE:], POINT_SIZE))
        self._inverse = [_inverse(f) for f in self._force]
        self.gap = sum(map(ca.dot, self._force, self._multiplier))
        self._stiff = list(map(_both_sides, self._multiplier, self._inverse))
        self.stiffness = self._matrix()

    def pull(self, weight: ca.SX, correction: ca.SX) -> ca.SX:
        """See `symbolic.contact.central_path.LocalPatch`."""
        given = self._given(weight, correction)
        waves = [_wave_sums([g[i] for g in given]) for i in range(POINT_SIZE)]
        return ca.vertcat(*self._patch.gathered(waves)) * (1.0 / WAVES)

    def _given(self, weight: ca.SX, correction: ca.SX) -> list[ca.SX]:
        """What the multipliers become where nothing moves, per corner."""
        corrections = ca.vertsplit(correction, POINT_SIZE)
        return [weight * own - c for own, c in zip(self._inverse, corrections, strict=True)]

    def step(self, weight: ca.SX, correction: ca.SX, change: ca.SX) -> Step:
        """See `symbolic.contact.central_path.LocalPatch`."""
        given = self._given(weight, correction)
        force, multiplier = corners_of(self._patch.waves(change)), self._multiplier
        corners = zip(given, self._stiff, force, multiplier, strict=True)
        turned = [g - ca.mtimes(stiff, df) - s for g, stiff, df, s in corners]
        lowest = least(list(map(_lowest, self._force, force)))

        def second_order() -> ca.SX:
            return ca.vertcat(*map(_product, self._inverse, force, turned))

        def gap_after(length: ca.SX) -> ca.SX:
            moves = zip(self._force, force, multiplier, turned, strict=True)
            return sum(ca.dot(f + length * df, s + length * ds) for f, df, s, ds in moves)

        return Step(
            ca.vertcat(change, *turned),
            lowest,
            least([lowest, *map(_lowest, multiplier, turned)]),
            second_order,
            gap_after,
        )

    def _matrix(self) -> ca.SX:
        """(12, 12) stiffness of the state.

        Of two waves it is the sum over the corners with both waves' signs: that of a third one.
        """
        parts, waves = range(POINT_SIZE), range(WAVES)
        sums = [
            [_wave_sums([stiff[i, j] * WAVES**-2 for stiff in self._stiff]) for j in range(i + 1)]
            for i in parts
        ]

        def column(i: int, wave: int) -> list[ca.SX]:
            entry = [sums[max(i, j)][min(i, j)] for j in parts]
            return self._patch.gathered([[each[wave ^ other] for other in waves] for each in entry])

        columns = [[column(i, wave) for wave in waves] for i in parts]
        rows = [
            self._patch.gathered([[of_wave[k] for of_wave in of_part] for of_part in columns])
            for k in range(STATE_SIZE)
        ]
        return ca.vertcat(*[ca.horzcat(*row) for row in rows])


def corners_of(waves: list[list[ca.SX]]) -> list[ca.SX]:
    """The corners' forces (3,) from `RectangularPatch.waves`."""
    sums = [_wave_sums(wave) for wave in waves]
    # Corners (+, +), (-, +), (-, -), (+, -) have these waves' signs in common with the waves.
    return [ca.vertcat(*[each[k] for each in sums]) * (1.0 / WAVES) for k in (0, 3, 1, 2)]


def _wave_sums(values: list[ca.SX]) -> list[ca.SX]:
    """Sums of four numbers at the corners with each wave's signs."""
    a, b, c, d = values
    ab, cd, a_b, d_c = a + b, c + d, a - b, d - c
    # Corners (+, +), (-, +), (-, -), (+, -).
    return [ab + cd, a_b + d_c, ab - cd, a_b - d_c]


def _inverse(f: ca.SX) -> ca.SX:
    return _J * f * reciprocal(_determinant(f))


def _determinant(f: ca.SX) -> ca.SX:
    return f[0] ** 2 - ca.sumsqr(f[1:])


def _both_sides(a: ca.SX, c: ca.SX) -> ca.SX:
    """(3, 3) matrix of sym(a b c) as a function of b."""
    outer = ca.mtimes(a, c.T)
    return outer + outer.T - ca.dot(a, _J * c) * ca.diag(_J)


def _product(a: ca.SX, b: ca.SX, c: ca.SX) -> ca.SX:
    """sym(a b c)."""
    return a * ca.dot(b, c) + c * ca.dot(a, b) - ca.dot(a, _J * c) * (_J * b)


def _lowest(f: ca.SX, move: ca.SX) -> ca.SX:
    """What a move adds to the lower eigenvalue of a corner's matrix, over the matrix."""
    over = reciprocal(_determinant(f))
    mean = ca.dot(f, _J * move) * over
    return mean - ca.sqrt(ca.fmax(mean**2 - _determinant(move) * over, 0.0))
