"""Path and speed profile as one program, and its quadratic model about an iterate.

Variables z = (xi, phi, omega): the free waypoints scaled to [-1, 1] by their bounds, the force
limit as F (1 + phi), the squared speeds at the grid points between both ends as
u'^2_i = w_i (1 + omega_i). With T the duration, and all of it about the iterate (xi, F, w) with
duration T_0,

    minimise    T / T_0  (aim 'duration', without phi)   or   phi  (aim 'force', T <= T_wanted)
    subject to  every limit at both ends of every interval <= 1, normal forces <= F (1 + phi)
                c_r(x) / scale_r >= required_r / scale_r   chosen geometric rows, as in
                `hybrid_opt.polishing.program`.

Derivatives are exact, first and second. Rows of the timing are scaled so that their slope by omega
is around one. Every row but that of the duration holds the speeds of one interval only, so that
matrices are those of `hybrid_opt.polishing.drivable.bordered`, the speeds being the chain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.drivable.bordered import BorderedMatrix, BorderedRows
from hybrid_opt.polishing.drivable.intervals import IntervalGrid, IntervalValues
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.place_values import PlaceValues
from hybrid_opt.polishing.residuals import Residuals
from symbolic.array import Array
from symbolic.records.task import extended_waypoints

NEAR = 0.85
"""Limits used this far have a row from the start."""

NEAR_FORCE = 0.6
"""The same for the normal forces, of what the limit leaves above the force at rest."""

REST_MARGIN = 2e-3
"""Share of the patches that is kept free standing still: only the intervals' beginnings have rows,
and where rest uses a patch up there is no timing at all."""

LEAST_SCALE = 1e-2
"""A row's slope by the squared speeds below which it is not scaled up further."""


@dataclass(frozen=True)
class Multipliers:
    """Of one program's rows.

    Attributes:
        timing: (points, kinds), of the unscaled rows.
        geometry: (geometric rows,), of the scaled values.
        duration: of the duration's row.
    """

    timing: Array
    geometry: Array
    duration: float


@dataclass(frozen=True)
class Iterate:
    """Where a program is formed.

    Attributes:
        x: (n_var,) decision vector.
        squared: (intervals + 1,) u'^2.
        force: force limit [N].
        duration: wanted [s] for the aim 'force', None for 'duration'.
    """

    x: Array
    squared: Array
    force: float
    duration: float | None


@dataclass(frozen=True)
class Linear:
    """Rows A d <= b: the chosen ones of the timing, the geometric ones, a wanted duration's.

    Attributes:
        A: the rows but the duration's.
        b: (rows,) of these.
        scale: (rows,) what they were divided by.
        point, kind: (timing rows,) which ones they are.
        whole: (n_variables,) the duration's, None without.
        most: its bound.
    """

    A: BorderedRows
    b: Array
    scale: Array
    point: NDArray[np.intp]
    kind: NDArray[np.intp]
    whole: Array | None
    most: float


class JointProgram:
    """The program about one iterate.

    Attributes:
        n_path, n_border: variables of the path, and with the force limit where it is one.
        speeds: place of the squared speeds among the variables.
        total: duration of the iterate [s].
        rows: (points, kinds) values of the timing's rows less their bounds, unscaled.
    """

    def __init__(
        self,
        grid: IntervalGrid,
        at: Iterate,
        values: IntervalValues,
        half: Array,
        places: tuple[tuple[PlaceRow, ...], PlaceValues, Array],
    ) -> None:
        """Form it.

        Args:
            values: at the iterate.
            half: (n_path,) half ranges of the path's variables.
            places: geometric rows, their values, and what each has to keep.
        """
        self._grid, self._at, self._values, self._half = grid, at, values, half
        self.n_path = len(half)
        self.n_border = self.n_path + (at.duration is not None)
        self.n = self.n_border + grid.intervals - 1
        self.speeds = slice(self.n_border, self.n)
        kinds = grid.kinds
        self.scale = np.where(kinds.is_force, at.force, 1.0)
        self.rows = values.rows() / self.scale - 1.0
        self._geometric(places, at)
        self._still(values)
        self._speeds()

    def _geometric(
        self, places: tuple[tuple[PlaceRow, ...], PlaceValues, Array], at: Iterate
    ) -> None:
        self.place_rows, self._places, self._required = places
        self._place_scale = np.array([row.constraint.scale for row in self.place_rows])
        if not self.place_rows:
            self.geometry, self._geometry_slope = np.zeros(0), np.zeros((0, self.n_path))
            return
        value, slope = self._places.first(extended_waypoints(self._grid.workcell.task, at.x))
        self.geometry = (self._required - value) / self._place_scale
        self._geometry_slope = -slope * self._half / self._place_scale[:, None]

    def _still(self, values: IntervalValues) -> None:
        """Rows of the pressure at rest, after the geometric ones; they bend little."""
        share, slope = values.pressure_at_rest()
        near = np.flatnonzero(share > NEAR)
        begins = 2 * (near // (len(share) // self._grid.intervals))
        by_path = self._grid.by_path(slope[near], begins) * self._half
        self.geometry = np.append(self.geometry, share[near] - 1.0 + REST_MARGIN)
        self._geometry_slope = np.concatenate([self._geometry_slope, by_path])

    def _speeds(self) -> None:
        """Duration with its derivatives, and what u'' and u'^2 of each point are by omega."""
        n, w = self._grid.intervals, self._at.squared
        root = np.sqrt(w)
        pair = root[:-1] + root[1:]
        self.total = float((2.0 / n / pair).sum())
        # dT/dw_i of the intervals before and after the grid point i = 1 ... n - 1.
        inner, share = root[1:-1], 2.0 / n / self.total
        before, after = share / pair[:-1] ** 2, share / pair[1:] ** 2
        by_root = -(before + after)
        self.cost = by_root * inner / 2.0
        # root_i = root_i0 sqrt(1 + omega): first derivative root / 2, second -root / 4.
        own = 2.0 * share * (1.0 / pair[:-1] ** 3 + 1.0 / pair[1:] ** 3)
        self.cost_diagonal = own * inner**2 / 4.0 - by_root * inner / 4.0
        self.cost_beside = 2.0 * share / pair[1:-1] ** 3 * inner[:-1] * inner[1:] / 4.0
        # By omega at two neighbours, of the beginning and the end of the point's interval; those of
        # both ends of the path are fixed.
        begins, ends = np.repeat(w[:-1], 2), np.repeat(w[1:], 2)
        at_end = np.tile([0.0, 1.0], n)
        local = np.zeros((2 * n, 2, 2))
        local[:, 0, 0], local[:, 0, 1] = -begins * n / 2.0, ends * n / 2.0
        local[:, 1, 0], local[:, 1, 1] = (1.0 - at_end) * begins, at_end * ends
        local[:2, :, 0], local[:2, :, 1] = local[:2, :, 1], 0.0
        local[-2:, :, 1], local[-2:, :, 0] = local[-2:, :, 0], 0.0
        self._local = local
        self._column = np.clip(np.repeat(np.arange(n), 2) - 1, 0, n - 3)

    def geometry_after(self, d: Array) -> Array:
        """(geometric rows,) what they lack after a step, beyond what their slopes foretell."""
        beyond = np.zeros(len(self.geometry))
        if not self.place_rows:
            return beyond
        x = self._at.x.copy()
        x[: self.n_path] += self._half * d[: self.n_path]
        value = self._places.values(extended_waypoints(self._grid.workcell.task, x))
        lacking = (self._required - value) / self._place_scale
        foretold = self.geometry + self._geometry_slope @ d[: self.n_path]
        beyond[: len(lacking)] = lacking - foretold[: len(lacking)]
        return beyond

    def near(self) -> NDArray[np.bool_]:
        """(points, kinds) rows that the iterate uses far."""
        rest = min(self._grid.workcell.task.force_limit[0] / self._at.force, 1.0)
        for_forces = (1.0 - NEAR_FORCE) * (rest - 1.0)
        threshold = np.where(self._grid.kinds.is_force, for_forces, NEAR - 1.0)
        return np.asarray(self.rows > threshold)

    def predicted(self, d: Array) -> Array:
        """(points, kinds) linear prediction of the timing's rows after a step."""
        omega = d[self.speeds]
        moved = self._grid.moved(self._half * d[: self.n_path])
        beside = np.stack([omega[self._column], omega[self._column + 1]], axis=1)
        speeds = np.matmul(self._local, beside[:, :, None])[:, :, 0]
        change = np.matmul(self._values.slope, np.hstack([moved, speeds])[:, :, None])[:, :, 0]
        phi = d[self.n_path] * self._grid.kinds.is_force if self.n_border > self.n_path else 0.0
        return np.asarray(self.rows + change @ self._grid.kinds.mix.T / self.scale - phi)

    def linear(self, chosen: NDArray[np.bool_], bent: Array | float = 0.0) -> Linear:
        """Chosen rows of the timing (points, kinds), and all others.

        Args:
            bent: (geometric rows,) what these lack after a step beyond what is foretold.
        """
        point, kind = np.nonzero(chosen)
        kinds, m, count = self._grid.kinds, len(point), len(self.geometry)
        local = kinds.slopes(self._values.slope, point, kind) / self.scale[kind, None]
        moving, n = self._grid.moving, self.n_path
        by_speed = np.matmul(local[:, None, moving:], self._local[point])[:, 0]
        border = np.zeros((m + count, self.n_border))
        border[:m, :n] = self._grid.by_path(local[:, :moving], point) * self._half
        border[m:, :n] = self._geometry_slope
        if self.n_border > n:
            border[:m, n] = -1.0 * kinds.is_force[kind]
        scale = np.ones(m + count)
        scale[:m] = np.maximum(np.abs(by_speed).max(axis=1, initial=0.0), LEAST_SCALE)
        sides = np.zeros((2, m + count))
        sides[:, :m] = (by_speed / scale[:m, None]).T
        column = np.zeros(m + count, dtype=np.intp)
        column[:m] = self._column[point]
        b = -np.concatenate([self.rows[point, kind], self.geometry + bent]) / scale
        whole, most = None, 0.0
        if self._at.duration is not None:
            whole, most = np.zeros(self.n), self._at.duration / self.total - 1.0
            whole[self.speeds] = self.cost
        left, right = sides
        A = BorderedRows(border / scale[:, None], column, left, right, len(self.cost))
        return Linear(A, b, scale, point, kind, whole, most)

    def gradient(self) -> Array:
        """(n_variables,) of the objective."""
        g = np.zeros(self.n)
        if self._at.duration is None:
            g[self.speeds] = self.cost
        else:
            g[self.n_path] = 1.0
        return g

    def gain(self, d: Array) -> float:
        """What a step is to take off the objective, as a share of it."""
        if self._at.duration is not None:
            return -float(d[self.n_path])
        omega = d[self.speeds]
        bent = self.cost_diagonal @ omega**2 / 2.0 + self.cost_beside @ (omega[:-1] * omega[1:])
        return -float(self.cost @ omega + bent)

    def curvature(self, multipliers: Multipliers | None) -> BorderedMatrix:
        """Second derivatives of the Lagrangian; of the duration alone without multipliers."""
        share = float(self._at.duration is None)
        if multipliers is None:
            share = 1.0
        else:
            share += multipliers.duration
        corner, beside = np.zeros((self.n_border,) * 2), np.zeros((len(self.cost), self.n_border))
        diagonal, off = share * self.cost_diagonal, share * self.cost_beside
        if multipliers is None:
            return BorderedMatrix(corner, beside, diagonal, off)
        x, m, n = slice(0, self.n_path), self._grid.moving, len(diagonal)
        at, local = self._values.curvature((multipliers.timing / self.scale) @ self._grid.kinds.mix)
        over, speeds, column = self._grid.carry_over[at], self._local[at], self._column[at]
        corner[x, x] = np.einsum("pia,pij->aj", over, local[:, :m, :m] @ over, optimize=True)
        mixed = np.swapaxes(speeds, 1, 2) @ local[:, m:, :m] @ over
        own = np.swapaxes(speeds, 1, 2) @ local[:, m:, m:] @ speeds
        for side in (0, 1):
            np.add.at(beside[:, x], column + side, mixed[:, side] * self._half)
            diagonal += np.bincount(column + side, own[:, side, side], n)
        off += np.bincount(column, own[:, 0, 1], n)[:-1]
        corner[x, x] *= np.outer(self._half, self._half)
        weight = multipliers.geometry[: len(self.place_rows)]
        if weight.any():
            corner[x, x] -= self._places.second(weight / self._place_scale) * np.outer(
                self._half, self._half
            )
        return BorderedMatrix(corner, beside, diagonal, off)

    def residuals(self, bounds: Array, linear: Linear, multipliers: Array) -> Residuals:
        """How well the iterate satisfies the optimality conditions with a step's multipliers.

        Args:
            bounds: (n_variables,) multipliers of the path's own bounds, signed.
            linear: the step's rows at the iterate.
            multipliers: (all rows,) theirs, the duration's last.
        """
        m = len(linear.b)
        lagrangian = self.gradient() + linear.A.pulled(multipliers[:m]) + bounds
        products = multipliers[:m] * linear.b
        if linear.whole is not None:
            lagrangian += multipliers[m] * linear.whole
            products = np.append(products, multipliers[m] * linear.most)
        worst = float(max(self.rows.max(), self.geometry.max(initial=-1.0), 0.0))
        product = float(np.abs(products).max(initial=0.0))
        return Residuals(float(np.abs(lagrangian).max()), worst, product)
