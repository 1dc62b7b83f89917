"""The convex program of one round of a timing within jerk limits, see `hybrid_opt.timing.jerk`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.timing.path_motion import PathMotion
from symbolic.array import Array

if TYPE_CHECKING:
    from scipy import sparse

SUPPORT = 4
"""Functions of a cubic spline's basis that are not zero at a place; they are neighbours."""

Mask = NDArray[np.bool_]

KEPT = 1e-4
"""Share of every limit that the program leaves unused: what the solver rounds off."""

FIRST_ROWS = 0.95
"""Rows that the last coefficients use to more than this share enter a program at once. With 0.4 in
its place, under a force limit, which most cones are near, a timing took three times as long."""


@dataclass(frozen=True)
class Point:
    """Places along the warped path; all arrays by place.

    Attributes:
        s: in [0, 1].
        value: (n, k) basis of v.
        squared_by, acceleration_by: (n, k) from coefficients to u'^2 and u''.
        motion: geometry by u.
        joint_jerk_by, box_jerk_by: (n, joints, k), (n, 3, k) jerk over sqrt(v).
        keep: (n,) share of every limit that a program may use.
    """

    s: Array
    value: Array
    squared_by: Array
    acceleration_by: Array
    motion: PathMotion
    joint_jerk_by: Array
    box_jerk_by: Array
    keep: Array

    @classmethod
    def of(
        cls,
        s: Array,
        basis: list[Array],
        warp: tuple[Array, Array, Array],
        motion: PathMotion,
        third: tuple[Array, Array],
    ) -> Point:
        """basis: of v, v' and v''. warp: rho', rho'', rho'''. third: of joints, box by u."""
        value, first, second = basis
        one, two, three = (part[:, None] for part in warp)

        def jerk(by_u: Array, by_uu: Array, by_uuu: Array) -> Array:
            on_value = by_uuu * one**3 + 3.0 * by_uu * one * two + by_u * three
            on_first = 1.5 * (by_uu * one**2 + by_u * two)
            on_second = 0.5 * by_u * one
            parts = ((on_value, value), (on_first, first), (on_second, second))
            return np.asarray(sum(a[:, :, None] * b[:, None, :] for a, b in parts))

        box = (motion.pose_first[:, :3], motion.pose_second[:, :3])
        return cls(
            s,
            value,
            one**2 * value,
            two * value + one * first / 2.0,
            motion,
            jerk(motion.q_first, motion.q_second, third[0]),
            jerk(*box, third[1]),
            np.full(len(s), 1.0 - KEPT),
        )

    @cached_property
    def first_basis(self) -> NDArray[np.intp]:
        """(n,) index of the first of the basis functions that are not zero at each place."""
        first = np.argmax(self.value != 0.0, axis=1)
        return np.asarray(np.minimum(first, self.value.shape[1] - SUPPORT))

    def local(self, values: Array) -> Array:
        """(n, ..., SUPPORT) those of values (n, ..., k) that belong to these functions."""
        columns = self.first_basis[:, None] + np.arange(SUPPORT)
        shape = (len(columns), *[1] * (values.ndim - 2), SUPPORT)
        return np.take_along_axis(values, columns.reshape(shape), axis=-1)

    def duration(self, c: Array) -> float:
        """[s] by Simpson's rule: the places are uniform, an odd number of them."""
        return float(self._weights() @ (1.0 / np.sqrt(np.maximum(self.value @ c, 1e-300))))

    def _weights(self) -> Array:
        weights = np.where(np.arange(len(self.s)) % 2 == 1, 4.0, 2.0)
        weights[[0, -1]] = 1.0
        return weights / (3.0 * (len(self.s) - 1))

    def time(self, c: Array) -> Array:
        """(n,) [s]; standing still, places are a second apart in all."""
        v = self.value @ c
        if not v.any():
            return self.s
        slowness = 1.0 / np.sqrt(v)
        steps = np.diff(self.s) * (slowness[1:] + slowness[:-1]) / 2.0
        return np.concatenate([[0.0], np.cumsum(steps)])

    def speed(self, c: Array) -> Array:
        """(n,) u' [1/s]."""
        return np.sqrt(np.maximum(self.squared_by @ c, 0.0))

    def acceleration(self, c: Array) -> Array:
        """(n,) u'' [1/s^2]."""
        return np.asarray(self.acceleration_by @ c)

    def jerk(self, c: Array) -> tuple[Array, Array]:
        """(n, joints) and (n, 3) of the joints and the box's frame [rad/s^3, m/s^3]."""
        root = np.sqrt(np.maximum(self.value @ c, 0.0))[:, None]
        return root * (self.joint_jerk_by @ c), root * (self.box_jerk_by @ c)

    def objective(self, c: Array) -> tuple[Array, Array]:
        """Gradient and Hessian of the duration."""
        v, weights = self.value @ c, self._weights()
        gradient = -0.5 * self.value.T @ (weights * v**-1.5)
        return gradient, 0.75 * (self.value.T * (weights * v**-2.5)) @ self.value


class Rows:
    """Rows b - A c, at least zero or in second-order cones of four, collected.

    A row has few neighbouring coefficients: A holds those alone, from column `first` on.
    """

    def __init__(self, k: int) -> None:
        self._k = k
        self._linear: list[tuple[sparse.csr_array, Array]] = []
        self._cones: list[tuple[sparse.csr_array, Array]] = []

    def below(self, A: Array, b: Array, first: NDArray[np.intp]) -> None:
        """A c <= b, (n, width) and (n,), columns from first (n,) on."""
        self._linear.append((self._placed(A, first), b))

    def within(
        self, A: Array, b: Array, head: Array, bound: Array, first: NDArray[np.intp]
    ) -> None:
        """|A c + b| <= bound - head c, by (n, 3, width), (n, 3), (n, width), (n,), columns from
        first (n,) on."""
        rows = np.concatenate([head[:, None], -A], axis=1).reshape(-1, A.shape[2])
        placed = self._placed(rows, np.repeat(first, 4))
        self._cones.append((placed, np.column_stack([bound, b])))

    def _placed(self, A: Array, first: NDArray[np.intp]) -> sparse.csr_array:
        from scipy import sparse

        n, width = A.shape
        columns = first[:, None] + np.arange(width)
        starts = width * np.arange(n + 1)
        return sparse.csr_array((A.reshape(-1), columns.reshape(-1), starts), shape=(n, self._k))

    def assembled(self) -> Program:
        """All of them."""
        from scipy import sparse

        none = sparse.csr_array((0, self._k))
        linear = sparse.vstack([none, *[A for A, _ in self._linear]], format="csr")
        cones = sparse.vstack([none, *[A for A, _ in self._cones]], format="csr")
        return Program(
            linear,
            np.concatenate([np.zeros(0), *[b for _, b in self._linear]]),
            cones,
            np.concatenate([np.zeros((0, 4)), *[b for _, b in self._cones]]),
        )


@dataclass(frozen=True)
class Program:
    """Linear rows (n, k), (n,) and cones (4 m, k), (m, 4), of which few matter at a time."""

    A: sparse.csr_array
    b: Array
    cone_A: sparse.csr_array
    cone_b: Array

    def used(self, c: Array, share: float) -> tuple[Mask, Mask]:
        """Which linear rows and which cones c uses to more than a share."""
        inside = self.cone_b - (self.cone_A @ c).reshape(-1, 4)
        lengths = np.linalg.norm(inside[:, 1:], axis=1)
        return np.asarray(self.A @ c > share * self.b), np.asarray(lengths > share * inside[:, 0])

    def minimised(self, H: Array, g: Array, about: Array) -> Array | None:
        """Least c^T H c / 2 + g.c; None without any. Rows that an answer violates are added."""
        rows, cones = self.used(about, FIRST_ROWS)
        while True:
            c = self._solved(H, g, about, rows, cones)
            if c is None:
                return None
            more_rows, more_cones = self.used(c, 1.0 + KEPT / 2.0)
            fresh = (more_rows & ~rows).any() or (more_cones & ~cones).any()
            if not fresh:
                return c
            rows, cones = rows | more_rows, cones | more_cones

    def _solved(self, H: Array, g: Array, scale: Array, rows: Mask, cones: Mask) -> Array | None:
        """The same with some of the rows; variables are scaled to be around one."""
        # Not imported at the top: only jerk limits need it.
        import clarabel
        from scipy import sparse

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        kinds: list[Any] = [clarabel.NonnegativeConeT(int(rows.sum()))]
        kinds += [clarabel.SecondOrderConeT(4)] * int(cones.sum())
        A = sparse.vstack([self.A[rows], self.cone_A[np.repeat(cones, 4)]], format="csc")
        A.data *= np.repeat(scale, np.diff(A.indptr))
        A.eliminate_zeros()
        found = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(H * np.outer(scale, scale))),
            g * scale,
            sparse.csc_matrix(A),
            np.concatenate([self.b[rows], self.cone_b[cones].reshape(-1)]),
            kinds,
            settings,
        ).solve()
        answer = np.array(found.x) * scale
        solved = str(found.status) in ("Solved", "AlmostSolved") and np.isfinite(answer).all()
        return answer if solved else None
