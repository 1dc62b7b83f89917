"""Path and speed profile as one program, and its quadratic model about an iterate.

Variables z = (xi, omega, phi): the free waypoints scaled to [-1, 1] by their bounds, the squared
speeds at the grid points between both ends as u'^2_i = w_i (1 + omega_i), the force limit as
F (1 + phi). With T the duration, and all of it about the iterate (xi, w, F) with duration T_0,

    minimise    T / T_0  (aim 'duration', phi = 0)   or   phi  (aim 'force', T <= T_wanted)
    subject to  every limit at both ends of every interval <= 1, normal forces <= F (1 + phi)
                c_r(x) / scale_r >= required_r / scale_r   chosen geometric rows, as in
                `hybrid_opt.polishing.program`.

Derivatives are exact, first and second. Rows of the timing are scaled so that their slope by omega
is around one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.drivable.intervals import IntervalGrid, IntervalValues
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.place_values import PlaceValues
from hybrid_opt.polishing.residuals import Residuals
from symbolic.array import Array
from symbolic.workcell.decision import extended_waypoints

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
        geometry: by row, of the scaled values.
        duration: of the duration's row.
    """

    timing: Array
    geometry: Mapping[PlaceRow, float]
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
    """Rows A d <= b with their names.

    Attributes:
        A: (rows, n_variables).
        b: (rows,).
    """

    A: Array
    b: Array


class JointProgram:
    """The program about one iterate.

    Attributes:
        n_path, n_speeds: variables of each block; the force limit is the last variable.
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
        self.n_path, self.n_speeds = len(half), grid.intervals - 1
        self.n = self.n_path + self.n_speeds + 1
        kinds = grid.kinds
        self.scale = np.where(kinds.is_force, at.force, 1.0)
        self.rows = values.rows() / self.scale - 1.0
        self._mix = kinds.mix / self.scale[:, None]
        self._geometric(places, at)
        self._still(values)
        self._speeds()
        self._carry_over = grid.carry_over * half

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
        by_path = np.matmul(slope[near, None], self._grid.carry_over[begins])[:, 0] * self._half
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
        # By omega at both ends of the point's interval; those of the path's ends are fixed.
        begins, ends = np.repeat(w[:-1], 2), np.repeat(w[1:], 2)
        at_end = np.tile([0.0, 1.0], n)
        self._local = np.zeros((2 * n, 2, 2))
        self._local[:, 0, 0], self._local[:, 0, 1] = -begins * n / 2.0, ends * n / 2.0
        self._local[:, 1, 0], self._local[:, 1, 1] = (1.0 - at_end) * begins, at_end * ends
        interval = np.repeat(np.arange(n), 2)
        self._column = np.stack([interval - 1, interval], axis=1)
        self._held = (self._column < 0) | (self._column >= self.n_speeds)
        self._local[np.broadcast_to(self._held[:, None, :], self._local.shape)] = 0.0
        self._column = np.clip(self._column, 0, self.n_speeds - 1)

    def geometry_after(self, d: Array) -> Array:
        """(geometric rows,) what they lack after a step, beyond what their slopes foretell."""
        beyond = np.zeros(len(self.geometry))
        if not self.place_rows:
            return beyond
        x = self._at.x.copy()
        x[: self.n_path] += self._half * d[: self.n_path]
        value, _ = self._places.first(extended_waypoints(self._grid.workcell.task, x))
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
        moving = self._grid.moving
        local = np.zeros((len(self._local), moving + 2))
        local[:, :moving] = self._carry_over @ d[: self.n_path]
        omega = d[self.n_path : -1]
        local[:, moving:] = (self._local * omega[self._column][:, None, :]).sum(axis=2)
        change = np.matmul(self._values.slope, local[:, :, None])[:, :, 0]
        phi = np.where(self._grid.kinds.is_force, d[-1], 0.0)
        return np.asarray(self.rows + change @ self._mix.T - phi)

    def linear(self, chosen: NDArray[np.bool_], bent: Array | float = 0.0) -> tuple[Linear, Array]:
        """The chosen timing rows, then the geometric ones, then a wanted duration's.

        Args:
            bent: (geometric rows,) what these lack after a step beyond what is foretold.

        Returns:
            The rows, and the scales (rows,) that they were divided by.
        """
        point, kind = np.nonzero(chosen)
        local = np.matmul(self._mix[kind][:, None, :], self._values.slope[point])[:, 0]
        A = np.zeros((len(point) + len(self.geometry) + self.has_duration, self.n))
        m, moving = len(point), self._grid.moving
        A[:m, : self.n_path] = np.matmul(local[:, None, :moving], self._carry_over[point])[:, 0]
        by_speed = np.matmul(local[:, None, moving:], self._local[point])[:, 0]
        rows = np.arange(m)
        for side in (0, 1):
            columns = self.n_path + self._column[point, side]
            np.add.at(A, (rows, columns), by_speed[:, side])
        A[:m, -1] = np.where(self._grid.kinds.is_force[kind], -1.0, 0.0)
        scales = np.ones(len(A))
        scales[:m] = np.maximum(np.abs(by_speed).max(axis=1), LEAST_SCALE)
        b = np.zeros(len(A))
        b[:m] = -self.rows[point, kind]
        A[m : m + len(self.geometry), : self.n_path] = self._geometry_slope
        b[m : m + len(self.geometry)] = -self.geometry - bent
        if self._at.duration is not None:
            A[-1, self.n_path : -1] = self.cost
            b[-1] = self._at.duration / self.total - 1.0
        return Linear(A / scales[:, None], b / scales), scales

    @property
    def has_duration(self) -> int:
        """Whether a wanted duration is the last row."""
        return int(self._at.duration is not None)

    def gradient(self) -> Array:
        """(n_variables,) of the objective."""
        g = np.zeros(self.n)
        if self._at.duration is None:
            g[self.n_path : -1] = self.cost
        else:
            g[-1] = 1.0
        return g

    def gain(self, d: Array) -> float:
        """What a step is to take off the objective, as a share of it."""
        if self._at.duration is not None:
            return -float(d[-1])
        omega = d[self.n_path : -1]
        bent = self.cost_diagonal @ omega**2 / 2.0 + self.cost_beside @ (omega[:-1] * omega[1:])
        return -float(self.cost @ omega + bent)

    def curvature(self, multipliers: Multipliers | None) -> Array:
        """(n_variables, n_variables) second derivatives of the Lagrangian; of the objective alone
        without multipliers."""
        H = np.zeros((self.n, self.n))
        share = 1.0 if self._at.duration is None else 0.0
        if multipliers is not None:
            share += multipliers.duration
        elif self._at.duration is not None:
            share = 1.0
        k = np.arange(self.n_path, self.n - 1)
        H[k, k] = share * self.cost_diagonal
        H[k[:-1], k[1:]] = H[k[1:], k[:-1]] = share * self.cost_beside
        if multipliers is None:
            return H
        at, local = self._values.curvature(multipliers.timing @ self._mix)
        over, speeds = self._carry_over[at], self._local[at]
        x, m = slice(0, self.n_path), self._grid.moving
        H[x, x] += np.einsum("pia,pij->aj", over, np.matmul(local[:, :m, :m], over), optimize=True)
        mixed = np.swapaxes(over, 1, 2) @ local[:, :m, m:] @ speeds
        own = np.swapaxes(speeds, 1, 2) @ local[:, m:, m:] @ speeds
        columns = self.n_path + self._column[at]
        for side in (0, 1):
            by_speed = np.zeros((self.n, self.n_path))
            np.add.at(by_speed, columns[:, side], mixed[:, :, side])
            H[:, x] += by_speed
            H[x, :] += by_speed.T
            for other in (0, 1):
                np.add.at(H, (columns[:, side], columns[:, other]), own[:, side, other])
        weight = np.array([multipliers.geometry.get(row, 0.0) for row in self.place_rows])
        if weight.any():
            H[x, x] -= self._places.second(weight / self._place_scale) * np.outer(
                self._half, self._half
            )
        return H

    def residuals(self, d_bounds: Array, A: Linear, multipliers: Array) -> Residuals:
        """How well the iterate satisfies the optimality conditions with a step's multipliers.

        Args:
            d_bounds: (n_variables,) multipliers of the path's own bounds, signed.
            A: the step's rows at the iterate.
            multipliers: (rows,) theirs.
        """
        lagrangian = self.gradient() + A.A.T @ multipliers + d_bounds
        if self._at.duration is None:
            lagrangian[-1] = 0.0
        worst = float(max(self.rows.max(), self.geometry.max(initial=-1.0), 0.0))
        product = float(np.abs(multipliers * A.b).max(initial=0.0))
        return Residuals(float(np.abs(lagrangian).max()), worst, product)
