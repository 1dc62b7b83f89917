"""Path and speed profile as one program, and its quadratic model about an iterate.

Variables z = (xi, omega): the waypoints that are moved, scaled to [-1, 1] by their bounds, and the
squared speeds at the grid points between both ends as u'^2_i = w_i (1 + omega_i). With T the
duration, F the force limit, and all of it about the iterate (xi, w) with duration T_0,

    minimise    T / T_0
    subject to  every limit at both ends of every interval <= 1, normal forces <= F
                c_r(x) / scale_r >= required_r / scale_r   chosen geometric rows, as in
                `hybrid_opt.polishing.force`.

Derivatives are exact, first and second. Rows of the timing are scaled so that their slope by omega
is around one. Every row holds the speeds of one interval only, so that matrices are those of
`hybrid_opt.polishing.solvers.quadratic`, the speeds being the chain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.carry import PlacedCarry
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.intervals import IntervalGrid, IntervalValues
from hybrid_opt.polishing.rows import Layout, Row, Rows
from hybrid_opt.polishing.solvers.base import Residuals
from hybrid_opt.polishing.solvers.quadratic import BorderedMatrix, BorderedRows
from symbolic.array import Array

NEAR = 0.85
"""Limits used this far have a row from the start."""

NEAR_FORCE = 0.6
"""The same for the normal forces, of what the limit leaves above the force at rest."""

REST_MARGIN = 2e-3
"""Share of the patches, or of the force limit, that is kept free standing still: only the
intervals' beginnings have rows, and where rest uses all of it there is no timing at all."""

NEGLIGIBLE = 1e-8
"""Scaled multipliers below this count as none."""

LEAST_SCALE = 1e-2
"""A row's slope by the squared speeds below which it is not scaled up further."""


@dataclass(frozen=True)
class Linear:
    """Rows A d <= b: the chosen ones of the timing, then the geometric ones.

    Attributes:
        A, b: the rows.
        scale: (rows,) what they were divided by.
        point, kind: (timing rows,) which ones they are.
    """

    A: BorderedRows
    b: Array
    scale: Array
    point: NDArray[np.intp]
    kind: NDArray[np.intp]


class JointProgram:
    """The program about one iterate.

    Attributes:
        place_rows: the geometric rows, in their order.
        n, n_path: variables, and those that move the path.
        speeds: place of the squared speeds among the variables.
        total: duration of the iterate [s].
        rows: (points, kinds) values of the timing's rows less their bounds, unscaled.
        geometry: (geometric rows,) what they lack.
    """

    def __init__(
        self,
        grid: IntervalGrid,
        values: IntervalValues,
        x: Array,
        squared: Array,
        cell: SmoothCell,
        required: Mapping[Row, float],
        carry: PlacedCarry,
        spread: Array,
    ) -> None:
        """Form it.

        Args:
            values: at the iterate.
            x: (n_var,) decision vector of the iterate, the force limit last.
            squared: (intervals + 1,) its u'^2.
            required: geometric rows, and what each has to keep.
            carry: the iterate on places.
            spread: (the path's variables, n_path) how they follow the program's.
        """
        self._grid, self._values, self._x, self._force = grid, values, x, float(x[-1])
        self._spread, self.n_path = spread, spread.shape[1]
        self.n = self.n_path + grid.intervals - 1
        self.speeds = slice(self.n_path, self.n)
        self.scale = np.where(grid.kinds.is_force, self._force, 1.0)
        self.rows = values.rows() / self.scale - 1.0
        layout = Layout(required)
        self.place_rows = layout.place_rows
        scale = np.array([row.constraint.scale for row in self.place_rows])
        self._required = np.array([required[row] for row in self.place_rows]) / scale
        self._places = Rows(cell, layout, carry.q)
        self.geometry = self._required - self._places.values(x)
        self._geometry_slope = -self._places.slopes()[:, : len(spread)] @ spread
        self._still(values)
        self._speeds(squared)

    def _still(self, values: IntervalValues) -> None:
        """Rows of what rest uses, after the geometric ones; they bend little."""
        share, slope = values.at_rest(self._force)
        near = np.flatnonzero(share > NEAR)
        begins = 2 * (near // (len(share) // self._grid.intervals))
        by_path = self._grid.by_path(slope[near], begins) @ self._spread
        self.geometry = np.append(self.geometry, share[near] - 1.0 + REST_MARGIN)
        self._geometry_slope = np.concatenate([self._geometry_slope, by_path])

    def _speeds(self, w: Array) -> None:
        """Duration with its derivatives, and what u'' and u'^2 of each point are by omega."""
        n = self._grid.intervals
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
        x, step = self._x.copy(), d[: self.n_path]
        x[: len(self._spread)] += self._spread @ step
        lacking = self._required - self._places.values(x)
        beyond = np.zeros(len(self.geometry))
        foretold = self.geometry + self._geometry_slope @ step
        beyond[: len(lacking)] = lacking - foretold[: len(lacking)]
        return beyond

    def near(self) -> NDArray[np.bool_]:
        """(points, kinds) rows that the iterate uses far."""
        rest = min(self._grid.workcell.task.force_limit[0] / self._force, 1.0)
        for_forces = (1.0 - NEAR_FORCE) * (rest - 1.0)
        threshold = np.where(self._grid.kinds.is_force, for_forces, NEAR - 1.0)
        return np.asarray(self.rows > threshold)

    def predicted(self, d: Array) -> Array:
        """(points, kinds) linear prediction of the timing's rows after a step."""
        omega = d[self.speeds]
        moved = self._grid.moved(self._spread @ d[: self.n_path])
        beside = np.stack([omega[self._column], omega[self._column + 1]], axis=1)
        speeds = np.matmul(self._local, beside[:, :, None])[:, :, 0]
        change = np.matmul(self._values.slope, np.hstack([moved, speeds])[:, :, None])[:, :, 0]
        return np.asarray(self.rows + change @ self._grid.kinds.mix.T / self.scale)

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
        border = np.zeros((m + count, self.n_path))
        border[:m, :n] = self._grid.by_path(local[:, :moving], point) @ self._spread
        border[m:, :n] = self._geometry_slope
        scale = np.ones(m + count)
        scale[:m] = np.maximum(np.abs(by_speed).max(axis=1, initial=0.0), LEAST_SCALE)
        sides = np.zeros((2, m + count))
        sides[:, :m] = (by_speed / scale[:m, None]).T
        column = np.zeros(m + count, dtype=np.intp)
        column[:m] = self._column[point]
        b = -np.concatenate([self.rows[point, kind], self.geometry + bent]) / scale
        left, right = sides
        A = BorderedRows(border / scale[:, None], column, left, right, len(self.cost))
        return Linear(A, b, scale, point, kind)

    def gradient(self) -> Array:
        """(n_variables,) of the objective."""
        return np.concatenate([np.zeros(self.n_path), self.cost])

    def gain(self, d: Array) -> float:
        """Reduction of the objective that a step promises, as a share of it."""
        omega = d[self.speeds]
        bent = self.cost_diagonal @ omega**2 / 2.0 + self.cost_beside @ (omega[:-1] * omega[1:])
        return -float(self.cost @ omega + bent)

    def curvature(self, linear: Linear | None = None, rows: Array | None = None) -> BorderedMatrix:
        """Second derivatives of the duration, or of the Lagrangian with multipliers (rows,) of a
        step's rows."""
        n_path, n = self.n_path, len(self.cost)
        corner, beside = np.zeros((n_path, n_path)), np.zeros((n, n_path))
        diagonal, off = self.cost_diagonal.copy(), self.cost_beside.copy()
        if linear is None or rows is None:
            return BorderedMatrix(corner, beside, diagonal, off)
        unscaled, count = rows / linear.scale, len(linear.point)
        timing = np.zeros(self.rows.shape)
        timing[linear.point, linear.kind] = np.where(rows > NEGLIGIBLE, unscaled, 0.0)[:count]
        m = self._grid.moving
        at, local = self._values.curvature((timing / self.scale) @ self._grid.kinds.mix)
        over = self._grid.carry_over[at] @ self._spread
        speeds, column = self._local[at], self._column[at]
        corner += np.einsum("pia,pij->aj", over, local[:, :m, :m] @ over, optimize=True)
        mixed = np.swapaxes(speeds, 1, 2) @ local[:, m:, :m] @ over
        own = np.swapaxes(speeds, 1, 2) @ local[:, m:, m:] @ speeds
        for side in (0, 1):
            np.add.at(beside, column + side, mixed[:, side])
            diagonal += np.bincount(column + side, own[:, side, side], n)
        off += np.bincount(column, own[:, 0, 1], n)[:-1]
        weight = unscaled[count : count + len(self.place_rows)]
        if weight.any():
            whole = len(self._spread)
            second = self._places.curvature(weight)[:whole, :whole]
            corner -= self._spread.T @ second @ self._spread
        return BorderedMatrix(corner, beside, diagonal, off)

    def residuals(self, bounds: Array, linear: Linear, multipliers: Array) -> Residuals:
        """How well the iterate satisfies the optimality conditions with a step's multipliers.

        Args:
            bounds: (n_variables,) multipliers of the path's own bounds, signed.
            linear: the step's rows at the iterate.
            multipliers: (rows,) theirs.
        """
        lagrangian = self.gradient() + linear.A.pulled(multipliers) + bounds
        products = multipliers * linear.b
        worst = float(max(self.rows.max(), self.geometry.max(initial=-1.0), 0.0))
        product = float(np.abs(products).max(initial=0.0))
        return Residuals(float(np.abs(lagrangian).max()), worst, product)
