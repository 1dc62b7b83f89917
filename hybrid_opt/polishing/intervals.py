"""Path and speed profile as one program, and its quadratic model about an iterate.

An interval is a piece of the path with constant u''. Both of its ends are points of their own, so n
intervals have 2 n points, two neighbouring ones per interval. Limits apply at every point. They
depend on the waypoints, which are linear in pose and derivatives, and on the squared speeds at both
ends of the interval: u'' = (w_end - w_begin) n / 2, u'^2 = w.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from hybrid_opt.polishing.cell import PlacedCarry, SmoothCell
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.robust import ROBUST_ROWS, RobustForces
from hybrid_opt.polishing.rows import ConstraintRows, Row, RowLayout
from hybrid_opt.polishing.solvers.base import Residuals
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.limits import LIMITS, limits_of_block
from symbolic.path.spline import path_basis
from symbolic.records.cell import Workcell
from symbolic.smooth.driven import (
    DRIVEN_FIRST,
    DRIVEN_SECOND,
    driven_layout,
    planned_branches,
)
from symbolic.smooth.samples import grasp_force_name

GRASP_ROWS = 2
"""Number of forces that a grasp's program adds, one per robot."""


@dataclass(frozen=True)
class PointInequalities:
    """The k limits that apply at every point of a timed path: linear combinations of quantities,
    each at most a bound.

    Quantities are those of `driven_layout`, followed by robust forces or by the forces that a
    convex program computes. The bound is the force limit [N] or 1.

    Attributes:
        mix: (k, quantities) coefficients of the linear combinations.
        is_force: (k,) True if the bound is the force limit.
        where, weight: (k, terms) indices and values of the nonzero coefficients.
    """

    mix: Array
    is_force: NDArray[np.bool_]
    where: NDArray[np.intp]
    weight: Array

    @classmethod
    def from_workcell(cls, workcell: Workcell, robust: int = 0) -> PointInequalities:
        """Return the inequalities of a workcell.

        A quantity that is limited in both signs has two inequalities. A planned normal force has
        one per branch, the linear functions whose maximum it is.

        Args:
            workcell: the cell.
            robust: number of robust normal forces at a point: forces of either arm in chosen cases
                of the uncertainty, each with one inequality; 0 if planned forces are limited.
        """
        layout = driven_layout(workcell)
        eye = np.eye(layout.size)
        forces = planned_branches(workcell)
        further = robust + (GRASP_ROWS if layout.by_program else 0)
        blocks = []
        for block in dict.fromkeys(limit.block for limit in LIMITS if limit.block != "force"):
            own = eye[layout.block(block)]
            blocks += [own, -own] if limits_of_block(block)[0].is_signed else [own]
        blocks.append(forces.reshape(-1, layout.size))
        planned = np.concatenate(blocks)
        mix = block_diag(planned, np.eye(further))
        is_force = np.arange(len(mix)) >= len(planned) - forces.shape[0] * forces.shape[1]
        terms = int(np.count_nonzero(mix, axis=1).max())
        where = np.argsort(mix == 0.0, axis=1, kind="stable")[:, :terms]
        return cls(mix, is_force, where, np.take_along_axis(mix, where, axis=1))

    def slopes(self, slope: Array, point: NDArray[np.intp], kind: NDArray[np.intp]) -> Array:
        """Return the derivatives (rows, n) of the left sides of chosen inequalities.

        Args:
            slope: (points, quantities, n) derivatives of the quantities by n variables.
            point, kind: (rows,) index of the point, and of the inequality at this point, of each
                chosen row.
        """
        terms = zip(self.where.T, self.weight.T, strict=True)
        return sum(
            (slope[point, where[kind]] * weight[kind, None] for where, weight in terms),
            start=np.zeros((len(point), slope.shape[2])),
        )


class IntervalGrid:
    """Data that the programs of all paths of a workcell share.

    Attributes:
        workcell: the cell.
        intervals: number of intervals with constant path acceleration u''.
        sample: (points,) index of the grid point of each point.
        moving: number of entries, 3 (6 + m), of the extended pose (box pose followed by m redundant
            joints) and its two derivatives by u.
        kinds: inequalities that apply at every point.
        robust: computes robust forces; None if planned ones are limited.
        layout: order of the quantities that are limited at a point.
        load: slice of the load (the force and moment that the box needs) among the quantities.
        rest: slice of the quantities that are limited at rest: the pressure shifts, or without a
            pressure limit the forces or the load from which they follow.
        has_pressure_limit: True if the contact model limits the shift of the pressure.
        variables: number of variables of the quantities at a point, see `DrivenLayout.variables`.
        spread: (free waypoint values, n_path) matrix from the program's path variables to the free
            waypoints.
        moved: (points, moving, n_path) derivatives of the extended pose and its two derivatives by
            the program's path variables.
        threads: number of threads that share the points.
    """

    def __init__(
        self,
        workcell: Workcell,
        intervals: int,
        spread: Array,
        robust: bool = False,
        threads: int = 1,
    ) -> None:
        self.workcell, self.intervals = workcell, intervals
        self.spread, self.threads = spread, threads
        task = workcell.task
        basis = path_basis(len(task.waypoints), np.linspace(0.0, 1.0, intervals + 1))
        self.sample = (np.arange(intervals)[:, None] + np.array([0, 1])).reshape(-1)
        self._bases = (basis.position, basis.first, basis.second)
        self.pose, self.moving = task.extended_size, 3 * task.extended_size
        waypoints = np.zeros((len(task.waypoints), self.pose, spread.shape[1]))
        waypoints[task.free_entries] = spread
        moved = [np.tensordot(basis, waypoints, 1)[self.sample] for basis in self._bases]
        self.moved = np.concatenate(moved, axis=1)
        self.robust = RobustForces(workcell, self.pose) if robust else None
        self.kinds = PointInequalities.from_workcell(
            workcell, 0 if self.robust is None else ROBUST_ROWS
        )
        self.layout = driven_layout(workcell)
        self.load = self.layout.block("load")
        self.has_pressure_limit = contact_model(workcell).has_pressure_limit
        forces = "load" if self.layout.by_program else "force"
        self.rest = self.layout.block("pressure" if self.has_pressure_limit else forces)
        self.variables = self.layout.variables

    def by_path(self, slope: Array, points: NDArray[np.intp]) -> Array:
        """Convert derivatives by the motion at a point to derivatives by the path variables of the
        quadratic program.

        The motion is the box pose followed by m redundant joints, with its first and second
        derivative by u: 3 (6 + m) numbers.

        Args:
            slope: (rows, 3 (6 + m)) derivatives of one value per row by the motion.
            points: (rows,) index of each row's point.

        Returns:
            (rows, n_path) derivatives.
        """
        rows, columns = self.workcell.task.free_entries
        at = self.sample[points]
        by_path = sum(
            (
                basis[at][:, rows] * slope[:, k * self.pose + columns]
                for k, basis in enumerate(self._bases)
            ),
            start=np.zeros((len(points), len(rows))),
        )
        return np.asarray(by_path @ self.spread)

    def path(self, waypoints: Array) -> tuple[Array, Array, Array]:
        """Return the box pose followed by m redundant joints, and its first and second derivative
        by u, at the grid points, (intervals + 1, 6 + m) each.

        Args:
            waypoints: (n_waypoints, 6 + m) waypoints: box poses followed by m redundant joints [m,
                rad].
        """
        first, second, third = (np.ascontiguousarray(b @ waypoints) for b in self._bases)
        return first, second, third


class IntervalValues:
    """Limited quantities at the points of one timed path, and their derivatives.

    Attributes:
        value: (points, quantities) values.
        slope: (points, quantities, moving + 2) derivatives by the extended pose (box pose and
            redundant joints), its two derivatives by u, u'' and u'^2. The joints follow the pose.
    """

    def __init__(
        self,
        grid: IntervalGrid,
        functions: PolishFunctions,
        waypoints: Array,
        squared: Array,
        near: tuple[Array, Array],
    ) -> None:
        """Evaluate the limited quantities at the points of a timing.

        Args:
            grid: data that all evaluations share.
            functions: compiled functions of the polish.
            waypoints: (n_waypoints, 6 + m) box poses followed by m redundant joints [m, rad].
            squared: (intervals + 1,) u'^2 at the grid points [1/s^2].
            near: joint positions of each arm at the grid points, (intervals + 1, n) [rad]. They are
                close to the positions that hold the box.
        """
        self._grid, self._functions = grid, functions
        path, s, threads = grid.path(waypoints), grid.sample, grid.threads
        held = [
            functions.closure(arm, "first").batch(path[0], near[arm], threads=threads)
            for arm in (0, 1)
        ]
        a = np.repeat(np.diff(squared) * grid.intervals / 2.0, 2)
        at_points = [part[s] for part in path]
        self._inputs = (*at_points, *(found["q"][s] for found in held), a, squared[s])
        out = functions.built[DRIVEN_FIRST].batch(*self._inputs, threads=threads)
        self._full = out["slope"]
        self._follow, self._pull = (
            [found[name][s] for found in held] for name in ("follow", "pull")
        )
        slope, value = _followed(grid, self._full, self._follow), out["value"]
        if grid.robust is not None:
            force, by_motion = grid.robust.at(at_points, a, squared[s])
            value = np.hstack([value, force])
            slope = np.concatenate([slope, by_motion], axis=1)
        self._held: Mapping[str, Array] | None = None
        if grid.layout.by_program:
            self._held = functions.built[grasp_force_name("first")].batch(value[:, grid.load])
            value = np.hstack([value, self._held["normal"]])
            slope = np.concatenate([slope, _by_load(self._held, slope[:, grid.load])], axis=1)
        self.value, self.slope = value, slope

    def at_rest(self, force: float) -> tuple[Array, Array]:
        """Compute how far the limit of each contact is used if the box rests at the beginning of
        each interval of the timing.

        The limited quantity is the pressure shift or, for pads without a limit on pressure, the
        normal force.

        Args:
            force: the force limit [N].

        Returns:
            - Ratios (2 intervals,) of value to limit, both contacts of the first interval first.
            - Derivatives (2 intervals, 3 (6 + m)) of the ratios by the box pose with m redundant
              joints, and by its first and second derivative by u.
        """
        begins = [values[::2] for values in self._inputs]
        still, grid = np.zeros(len(begins[-1])), self._grid
        first = self._functions.built[DRIVEN_FIRST]
        out = first.batch(*begins[:-2], still, still, threads=grid.threads)
        follow = [along[::2] for along in self._follow]
        value, slope = out["value"][:, grid.rest], out["slope"][:, grid.rest]
        slope = _followed(grid, slope, follow)[:, :, : grid.moving]
        if grid.layout.by_program:
            pressed = self._functions.built[grasp_force_name("first")].batch(value)
            value, slope = pressed["normal"], _by_load(pressed, slope)
        whole = 1.0 if grid.has_pressure_limit else force
        return value.reshape(-1) / whole, slope.reshape(-1, grid.moving) / whole

    def rows(self) -> Array:
        """Return the left sides (points, k) of the k inequalities at every point: normal forces
        [N], and all other limited quantities over their limits. Each is at most its bound, the
        force limit or 1.
        """
        return np.asarray(self.value @ self._grid.kinds.mix.T)

    def curvature(self, weight: Array) -> tuple[NDArray[np.intp], Array]:
        """Compute the Hessian of the weighted sum of all limited quantities at each point.

        Args:
            weight: (points, quantities) weights. In place of the curvature of robust normal forces,
                which is not computed, that of planned ones is taken.

        Returns:
            Indices (m,) of the points with a nonzero weight, and their Hessians (m, moving + 2,
            moving + 2) by the extended pose, its two derivatives by u, u'' and u'^2.
        """
        if self._grid.robust is not None:
            weight = self._grid.robust.planned_weights(weight, self.value)
        pressing = np.zeros((len(weight), 0))
        if self._held is not None:
            weight, pressing = np.hsplit(weight, [self._grid.layout.size])
            weight = weight.copy()
            weight[:, self._grid.load] += np.einsum("prl,pr->pl", self._held["slope"], pressing)
        at = np.flatnonzero(np.abs(weight).max(axis=1) > 0.0)
        n, variables = len(at), self._grid.variables
        pose, moving = self._grid.pose, self._grid.moving
        local = moving + 2
        spread = np.zeros((n, local, variables))
        spread[:, np.arange(moving), np.arange(moving)] = 1.0
        spread[:, [moving, moving + 1], [variables - 2, variables - 1]] = 1.0
        start = moving
        for along in self._follow:
            stop = start + along.shape[2]
            spread[:, :pose, start:stop] = along[at]
            start = stop
        repeated = [np.repeat(values[at], local, axis=0) for values in self._inputs]
        along_all = np.repeat(weight[at], local, axis=0), spread.reshape(-1, variables)
        second = self._functions.built[DRIVEN_SECOND]
        change = second.batch(*repeated, *along_all, threads=self._grid.threads)["change"]
        total = change.reshape(n, local, variables) @ np.swapaxes(spread, 1, 2)
        # How the joints' own curvature along the path adds to it (`symbolic.smooth.path_points`).
        slope = np.einsum("pk,pkv->pv", weight[at], self._full[at])
        start = moving
        for arm, along in enumerate(self._follow):
            n_joints = along.shape[2]
            by_joints = slope[:, start : start + n_joints]
            nu = np.matmul(self._pull[arm][at], by_joints[:, :, None])[:, :, 0]
            closed = self._functions.closure(arm, "second").batch(
                self._inputs[0][at], self._inputs[3 + arm][at], nu
            )["hessian"]
            follow = np.concatenate([np.tile(np.eye(pose), (n, 1, 1)), along[at]], axis=2)
            total[:, :pose, :pose] += follow @ closed @ np.swapaxes(follow, 1, 2)
            start += n_joints
        if self._held is not None:
            pressed = self._functions.built[grasp_force_name("second")]
            bent = pressed.batch(self._held["state"][at], pressing[at])["curvature"]
            by_motion = self.slope[at][:, self._grid.load]
            total += np.swapaxes(by_motion, 1, 2) @ bent @ by_motion
        return at, (total + np.swapaxes(total, 1, 2)) / 2.0


def _by_load(pressed: Mapping[str, Array], slope: Array) -> Array:
    """Apply the chain rule from the load (the force and moment that the box needs) to the normal
    forces of a convex program.

    Args:
        pressed: outputs of the convex program; `slope` (points, 2, 6) has the derivatives of both
            normal forces by the load.
        slope: (points, 6, n) derivatives of the load by n variables.

    Returns:
        Derivatives (points, 2, n) of both normal forces by the variables.
    """
    return np.asarray(pressed["slope"] @ slope)


def _followed(grid: IntervalGrid, full: Array, follow: Sequence[Array]) -> Array:
    """Eliminate the joint positions from derivatives, because the joints follow the extended pose
    (box pose and redundant joints).

    Args:
        grid: data that all evaluations share.
        full: (points, quantities, variables) derivatives by all variables of a point.
        follow: for each arm, derivatives (points, pose, n) of its n joint positions by the extended
            pose.

    Returns:
        (points, quantities, moving + 2) derivatives by the extended pose, its two derivatives by u,
        u'' and u'^2.
    """
    slope = np.concatenate([full[:, :, : grid.moving], full[:, :, -2:]], axis=2)
    start = grid.moving
    for along in follow:
        n = along.shape[2]
        slope[:, :, : grid.pose] += full[:, :, start : start + n] @ np.swapaxes(along, 1, 2)
        start += n
    return slope


NEARLY_USED = 0.92
"""Limits with a larger utilisation have a row in the program from the start."""

NEARLY_USED_FORCE = 0.8
"""Normal forces above this share of the way from the force at rest to the limit have a row in the
program from the start."""

REST_MARGIN = 2e-3
"""Share of the patches, or of the force limit, that must remain unused at rest. Rows at rest exist
only at the beginnings of intervals, and a path without any reserve at rest has no timing."""

NEGLIGIBLE_MULTIPLIER = 1e-8
"""Scaled multipliers below this count as zero."""

LEAST_SCALE = 1e-2
"""Least divisor of a row. A row is divided by its slope by the squared speeds."""


@dataclass(frozen=True)
class LinearisedRows:
    """Linearised rows A d <= b for a step d: the chosen timing rows, then all geometric rows.

    A timing row is one inequality at one point of the timing.

    Attributes:
        A, b: matrix and right side of the rows, divided by `scale`.
        scale: (rows,) divisors of the rows.
        point, kind: (timing rows,) index of the point and of the inequality of each timing row.
        shape: numbers of points and of inequalities at a point.
    """

    A: Array
    b: Array
    scale: Array
    point: NDArray[np.intp]
    kind: NDArray[np.intp]
    shape: tuple[int, int]


class PathTimingProgram:
    """Program of path and timing about one iterate.

    Its variables z = (xi, omega) are the moved waypoints, scaled to [-1, 1] by their bounds, and
    relative changes omega of the iterate's squared speeds w at the inner grid points: u'^2_i = w_i
    (1 + omega_i). With the duration T, the iterate's duration T_0 and the force limit F, the
    program is::

        minimise    T / T_0
        subject to  every limit at both ends of every interval <= 1, normal forces <= F
                    c_r(x) / scale_r >= required_r / scale_r   chosen geometric rows, as in
                    `hybrid_opt.polishing.force`.

    First and second derivatives are exact. Rows of the timing are scaled so that their slope by
    omega is around one.

    Attributes:
        geometric_rows: geometric rows, in order.
        n, n_path: number of variables, and of those that move the path.
        speeds: slice of omega among the variables.
        total: duration of the iterate [s].
        rows: (points, kinds) timing rows at the iterate: limited quantities over their bounds, less
            one.
        geometry: (geometric rows,) violations at the iterate, negative where a row is satisfied.
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
    ) -> None:
        """Linearise the duration and the geometric rows about an iterate.

        Args:
            grid: data that all quadratic programs of the workcell share.
            values: limited quantities of the iterate.
            x: (n_var,) decision vector of the iterate, the force limit last.
            squared: (intervals + 1,) squared path speeds u'^2 of the iterate [1/s^2].
            cell: shared data of the polish.
            required: value that each geometric row (scalar inequality at a point of the path) has
                to exceed.
            carry: the iterate at points of the path.
        """
        self._grid, self._values, self._x, self._force = grid, values, x, float(x[-1])
        self._spread, self.n_path = grid.spread, grid.spread.shape[1]
        self.n = self.n_path + grid.intervals - 1
        self.speeds = slice(self.n_path, self.n)
        self.scale = np.where(grid.kinds.is_force, self._force, 1.0)
        self.rows = values.rows() / self.scale - 1.0
        layout = RowLayout(required)
        self.geometric_rows = layout.point_rows
        # Slopes of the timing's rows by both parts of z, of those that were chosen so far.
        self._known = np.zeros(self.rows.shape, dtype=np.bool_)
        self._by_path = np.empty((*self.rows.shape, self.n_path))
        self._by_speeds = np.empty((*self.rows.shape, 2))
        scale = np.array([row.constraint.scale for row in self.geometric_rows])
        self._required = np.array([required[row] for row in self.geometric_rows]) / scale
        self._geometry_rows = ConstraintRows(cell, layout, carry.q)
        self.geometry = self._required - self._geometry_rows.values(x)
        self._geometry_slope = -self._geometry_rows.slopes()[:, : len(grid.spread)] @ grid.spread
        self._still(values)
        self._speeds(squared)

    def _still(self, values: IntervalValues) -> None:
        """Append inequalities to the program's geometric rows: the box can be held at rest at the
        beginning of every interval, as far as a force or pressure is near its limit there. Their
        curvature is small and neglected.

        Args:
            values: limited quantities of the iterate.
        """
        share, slope = values.at_rest(self._force)
        near = np.flatnonzero(share > NEARLY_USED)
        begins = 2 * (near // (len(share) // self._grid.intervals))
        by_path = self._grid.by_path(slope[near], begins)
        self.geometry = np.append(self.geometry, share[near] - 1.0 + REST_MARGIN)
        self._geometry_slope = np.concatenate([self._geometry_slope, by_path])

    def _speeds(self, w: Array) -> None:
        """Store value, gradient and Hessian of the duration by omega, the relative changes of the
        iterate's squared speeds; and the derivatives by omega of u'' and u'^2 at each point.

        Args:
            w: (intervals + 1,) squared path speeds u'^2 of the iterate [1/s^2].
        """
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
        """Return the error (geometric rows,) of each geometric row's linear model along a step.

        The error is the violation after the step minus its linear prediction.

        Args:
            d: (n,) the step.
        """
        x, step = self._x.copy(), d[: self.n_path]
        x[: len(self._spread)] += self._spread @ step
        lacking = self._required - self._geometry_rows.values(x)
        beyond = np.zeros(len(self.geometry))
        foretold = self.geometry + self._geometry_slope @ step
        beyond[: len(lacking)] = lacking - foretold[: len(lacking)]
        return beyond

    def near_rows(self) -> NDArray[np.bool_]:
        """Return a mask (points, kinds) of the timing rows, the limits at points of the timing,
        that are near their bounds at the iterate.
        """
        rest = min(self._grid.workcell.task.force_limit[0] / self._force, 1.0)
        for_forces = (1.0 - NEARLY_USED_FORCE) * (rest - 1.0)
        threshold = np.where(self._grid.kinds.is_force, for_forces, NEARLY_USED - 1.0)
        return np.asarray(self.rows > threshold)

    def predicted(self, d: Array) -> Array:
        """Predict linearly the timing rows (points, kinds) after a step: limited quantities over
        their bounds, less one.

        Args:
            d: (n,) the step.
        """
        omega = d[self.speeds]
        moved = self._grid.moved @ d[: self.n_path]
        beside = np.stack([omega[self._column], omega[self._column + 1]], axis=1)
        speeds = np.matmul(self._local, beside[:, :, None])[:, :, 0]
        change = np.matmul(self._values.slope, np.hstack([moved, speeds])[:, :, None])[:, :, 0]
        return np.asarray(self.rows + change @ self._grid.kinds.mix.T / self.scale)

    def linear(self, chosen: NDArray[np.bool_], bent: Array | float = 0.0) -> LinearisedRows:
        """Return the linearised rows of a step.

        Args:
            chosen: (points, kinds) mask of the timing rows (limits at points of the timing) to
                include.
            bent: (geometric rows,) error of the rows' linear model along an earlier step, added to
                the geometric rows.
        """
        self._learn(*np.nonzero(chosen & ~self._known))
        point, kind = np.nonzero(chosen)
        m, count = len(point), len(self.geometry)
        by_speed, column = self._by_speeds[point, kind], self.n_path + self._column[point]
        A = np.zeros((m + count, self.n))
        A[:, : self.n_path] = np.concatenate([self._by_path[point, kind], self._geometry_slope])
        A[np.arange(m), column], A[np.arange(m), column + 1] = by_speed.T
        scale = np.ones(m + count)
        scale[:m] = np.maximum(np.abs(by_speed).max(axis=1, initial=0.0), LEAST_SCALE)
        A /= scale[:, None]
        b = -np.concatenate([self.rows[point, kind], self.geometry + bent]) / scale
        return LinearisedRows(A, b, scale, point, kind, self.rows.shape)

    def _learn(self, point: NDArray[np.intp], kind: NDArray[np.intp]) -> None:
        """Compute and store the derivatives of timing rows.

        Args:
            point, kind: (rows,) index of the point and of the inequality of each row.
        """
        kinds, moving = self._grid.kinds, self._grid.moving
        local = kinds.slopes(self._values.slope, point, kind) / self.scale[kind, None]
        self._by_path[point, kind] = self._grid.by_path(local[:, :moving], point)
        self._by_speeds[point, kind] = np.matmul(local[:, None, moving:], self._local[point])[:, 0]
        self._known[point, kind] = True

    def gradient(self) -> Array:
        """Return the gradient (n,) of the objective: duration over the duration of the iterate."""
        return np.concatenate([np.zeros(self.n_path), self.cost])

    def gain(self, d: Array) -> float:
        """Predict to second order the relative reduction of the duration by a step.

        Args:
            d: (n,) the step.
        """
        omega = d[self.speeds]
        bent = self.cost_diagonal @ omega**2 / 2.0 + self.cost_beside @ (omega[:-1] * omega[1:])
        return -float(self.cost @ omega + bent)

    def curvature(self, linear: LinearisedRows | None = None, rows: Array | None = None) -> Array:
        """Return the Hessian (n, n) of the objective, or of the Lagrangian.

        Args:
            linear: linearised rows; None for the objective alone.
            rows: (rows,) multipliers of the linearised rows; None for the objective alone.
        """
        k = self.n_path
        H = np.zeros((self.n, self.n))
        H[k:, k:] = (
            np.diag(self.cost_diagonal)
            + np.diag(self.cost_beside, 1)
            + np.diag(self.cost_beside, -1)
        )
        if linear is None or rows is None:
            return H
        unscaled, count = rows / linear.scale, len(linear.point)
        timing = np.zeros(self.rows.shape)
        timing[linear.point, linear.kind] = np.where(rows > NEGLIGIBLE_MULTIPLIER, unscaled, 0.0)[
            :count
        ]
        m = self._grid.moving
        at, local = self._values.curvature((timing / self.scale) @ self._grid.kinds.mix)
        over = self._grid.moved[at]
        speeds, column = self._local[at], k + self._column[at]
        H[:k, :k] = np.tensordot(over, local[:, :m, :m] @ over, ([0, 1], [0, 1]))
        mixed = np.swapaxes(speeds, 1, 2) @ local[:, m:, :m] @ over
        own = np.swapaxes(speeds, 1, 2) @ local[:, m:, m:] @ speeds
        for side in (0, 1):
            np.add.at(H[:, :k], column + side, mixed[:, side])
            for other in (0, 1):
                np.add.at(H, (column + side, column + other), own[:, side, other])
        H[:k, k:] = H[k:, :k].T
        weight = unscaled[count : count + len(self.geometric_rows)]
        if weight.any():
            whole = len(self._spread)
            second = self._geometry_rows.curvature(weight)[:whole, :whole]
            H[:k, :k] -= self._spread.T @ second @ self._spread
        return H

    def residuals(self, bounds: Array, linear: LinearisedRows, multipliers: Array) -> Residuals:
        """Compute the optimality residuals of the iterate with the multipliers of a step.

        Args:
            bounds: (n,) multipliers of the variables' own bounds, positive for upper ones.
            linear: linearised rows at the iterate.
            multipliers: (rows,) multipliers of these rows.
        """
        lagrangian = self.gradient() + multipliers @ linear.A + bounds
        products = multipliers * linear.b
        worst = float(max(self.rows.max(), self.geometry.max(initial=-1.0), 0.0))
        product = float(np.abs(products).max(initial=0.0))
        return Residuals(float(np.abs(lagrangian).max()), worst, product)
