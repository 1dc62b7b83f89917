"""What the optimisation programs of timings are made of: limits along a path as functions of path
acceleration and squared speed, and the convex program of a timing within jerk limits."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, robust_path
from hybrid_opt.timing.model import PathMotion, TimingModel, row_lengths
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.limits import Limit, limits_of_block

if TYPE_CHECKING:
    from scipy import sparse

Mask = NDArray[np.bool_]

SPEEDS, PAYLOAD_ACCELERATIONS = limits_of_block("speed"), limits_of_block("cone")
(JOINT_ACCELERATION,) = limits_of_block("acceleration")

LINEARISED_ABOVE = 0.6
"""Joint torques and pressure shifts below this share of their limits are left out of programs."""

SOLVER_MARGIN = 1e-4
"""Share of every limit that the program leaves unused for the solver's rounding."""

NEAR_ACTIVE_SHARE = 0.95
"""Rows that the last coefficients use beyond this share enter a program at once. With 0.4 in its
place a timing under a force limit, to which most cones are near, took three times as long."""


class PathLimits:
    """Limits at n samples of a path as functions of u'' and u'^2, each divided by its bound.

    Limits on speeds are not among them; `squared_speed_limit` computes these. Robust forces are
    part of `forces` if the normal force of one pad determines that of the other pad
    (`ContactModel.has_scalar_squeeze`), else of `ratios`.

    Attributes:
        motion: geometry of the path at the samples.
    """

    def __init__(self, model: TimingModel, motion: PathMotion, limits: TimingLimits) -> None:
        self.motion, self._model, self._limits = motion, model, limits
        self._bounds = model.carry_limits.bounds
        workcell = model.workcell
        self._squeezed = limits.robust and command_model(workcell).has_scalar_squeeze
        self._grasped = limits.robust and not self._squeezed

    def joint_accelerations(self) -> tuple[Array, Array]:
        """Return the coefficients of the joint accelerations, relative to their limits.

        A joint's acceleration is q' u'' + q'' u'^2 with derivatives q' and q'' by u. It stays
        within its limit if first u'' + second u'^2 lies between -1 and 1.

        Returns:
            The arrays first and second [s^2], (n, all joints) each.
        """
        first, second = self._derivatives(JOINT_ACCELERATION)
        bound = self._bounds[JOINT_ACCELERATION.name]
        return first / bound, second / bound

    def accelerations(self) -> list[tuple[Array, Array, float]]:
        """Return the limits on the payload's linear and angular acceleration.

        Returns:
            For each limit two vectors (n, 3), first and second, and the largest allowed length
            [m/s^2 or rad/s^2] of the acceleration first u'' + second u'^2.
        """
        return [
            (first[:, :3], second[:, :3], float(self._bounds[limit.name]))
            for limit in PAYLOAD_ACCELERATIONS
            for first, second in [self._derivatives(limit)]
        ]

    def _derivatives(self, limit: Limit) -> tuple[Array, Array]:
        m, name = self.motion, limit.path
        return getattr(m, f"{name}_first"), getattr(m, f"{name}_second")

    def forces(self, a: Array, w: Array) -> list[tuple[Array, Array]]:
        """Compute the ratios of normal forces to the force limit, for those forces that are convex
        functions of (u'', u'^2).

        Args:
            a: (n,) path accelerations u'' [1/s^2].
            w: (n,) squared path speeds u'^2 [1/s^2].

        Returns:
            A list of pairs: ratios (n, 2) of both robots, and their derivatives (n, 2, 2) by (u'',
            u'^2). The first pair is for planned forces. A second one, for robust forces, is added
            if these are limited and convex. The list is empty without force limit.
        """
        model, limit = self._model, self._limits.force
        if limit is None:
            return []
        found = [model.path_force(self.motion, a, w)]
        if self._squeezed:
            force, slope = robust_path(model.workcell).at(self._points(a, w))
            found.append((force, slope[:, :, BY_TIMING]))
        return [(force / limit, slope / limit) for force, slope in found]

    def ratios(self, a: Array, w: Array) -> Array:
        """Compute the ratios to their limits of those quantities that are not convex in (u'',
        u'^2).

        The columns are, in this order and as far as limited:

        - joint torques, with sign;
        - pressure shifts of both pads;
        - robust forces of both robots, unless `forces` returns them as convex functions.

        Args:
            a: (n,) path accelerations u'' [1/s^2].
            w: (n,) squared path speeds u'^2 [1/s^2].

        Returns:
            (n, k) ratios, k columns.
        """
        m, workcell, limits = self.motion, self._model.workcell, self._limits
        pressure = limits.pressure and self._model.carry_limits.has_pressure_limit
        force = limits.force if self._grasped else None
        columns = [np.zeros((len(a), 0))]
        if not (limits.torque or pressure or force):
            return columns[0]
        load = self._model.drive(m, np.sqrt(w), a)
        if limits.torque:
            own = m.torque_by_acceleration * a[:, None] + m.torque_by_speed * w[:, None]
            torque = self._model.contact_torque(m.wrench_torque, load) + own + m.torque_at_rest
            columns.append(torque / self._bounds["joint torque"])
        if pressure:
            columns.append(load["pressure_shift"] / self._bounds["pressure shift"])
        if force:
            moved = self._points(a, w).motion
            commanded, leading = robust_model(workcell).hold(moved, workcell.uncertainty)
            columns.append(np.stack([leading, commanded], axis=1) / force)
        return np.concatenate(columns, axis=1)

    def ratio_slopes(self, ratios: Array, a: Array, w: Array) -> Array:
        """Compute the derivatives (n, k, 2) of `PathLimits.ratios` by u'' and by u'^2, by forward
        differences.

        Args:
            ratios: (n, k) result of `PathLimits.ratios` at a and w.
            a, w: (n,) values of u'' [1/s^2] and u'^2 [1/s^2].
        """
        step_a = 1e-5 * max(float(np.abs(a).max()), 1e-6)
        step_w = 1e-5 * max(float(w.max()), 1e-6)
        by_a = (self.ratios(a + step_a, w) - ratios) / step_a
        return np.stack([by_a, (self.ratios(a, w + step_w) - ratios) / step_w], axis=-1)

    def _points(self, a: Array, w: Array) -> PathPoints:
        m = self.motion
        return PathPoints(m.pose[:, :6], m.pose_first[:, :6], m.pose_second[:, :6], a, w)


def squared_speed_limit(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> Array:
    """Compute the largest u'^2 (n,) [1/s^2] at each sample that all limits on speeds allow.

    It is infinite where nothing moves.

    Args:
        model: timing model of the workcell.
        motion: geometry of the path at n samples.
        limits: limits in addition to the workcell's, such as the reference speeds.
    """
    task, bounds = model.workcell.task, model.carry_limits.bounds
    demands = []
    for limit in SPEEDS:
        if limit.path:
            values = getattr(motion, f"{limit.path}_first")
            values = np.abs(values) if limit.scope == "joint" else row_lengths(values[:, :3])
            demands.append((values / bounds[limit.name]).max(axis=1))
    if limits.reference_speed:
        linear, angular = row_lengths(motion.pose_first[:, :3]), row_lengths(motion.angular_first)
        demands += [
            linear[:, 0] / task.reference_speed,
            angular[:, 0] / task.reference_angular_speed,
        ]
    demand = np.max(demands, axis=0)
    with np.errstate(divide="ignore"):
        squared: Array = 1.0 / demand**2
    return squared


def duration_at_speed_limits(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> float:
    """Compute the duration [s] of a path that is driven at its speed limits throughout, without
    limits on accelerations.

    Args:
        model: timing model of the workcell.
        motion: geometry of the path.
        limits: limits in addition to the workcell's, such as the reference speeds.
    """
    squared = squared_speed_limit(model, motion, limits)
    slowness = 1.0 / np.sqrt(np.minimum(squared, 1e8))
    return float(np.trapezoid(slowness, motion.parameter))


class JerkProgram:
    """Quadratic program of k coefficients c, with linear rows A c <= b and second-order cones.

    A cone bounds the length of a vector (3,) that is affine in c. Few rows are active at a
    solution. Each row depends on few neighbouring coefficients, so only these entries of A are
    stored, from the column `first` on.
    """

    def __init__(self, k: int) -> None:
        """Start a program with k coefficients and no rows."""
        from scipy import sparse

        self._k = k
        self._linear = [(sparse.csr_array((0, k)), np.zeros(0))]
        self._cones = [(sparse.csr_array((0, k)), np.zeros((0, 4)))]

    def add_upper_bounds(self, A: Array, b: Array, first: NDArray[np.intp]) -> None:
        """Add n linear rows A c <= b for spline coefficients c.

        Args:
            A: (n, width) successive nonzero entries of each row.
            b: (n,) bounds.
            first: (n,) index of the coefficient of each row's first entry.
        """
        self._linear.append((self._sparse_rows(A, first), b))

    def add_two_sided_bounds(
        self, A: Array, head: Array | float, bound: Array, first: NDArray[np.intp]
    ) -> None:
        """Add the linear rows |A c| <= bound - head . c, m rows with a common right side at each of
        n points.

        Args:
            A: (n, m, width) successive nonzero entries of each row.
            head: (n, 1, width) entries of the vector `head` at each point, for the same
                coefficients; 0 for a constant right side.
            bound: (n,) bounds.
            first: (n,) index of the coefficient of the first entry at each point.
        """
        _, m, width = A.shape
        for sign in (1.0, -1.0):
            each = (sign * A + head).reshape(-1, width)
            self.add_upper_bounds(each, np.repeat(bound, m), np.repeat(first, m))

    def add_norm_bounds(
        self, A: Array, b: Array, head: Array, bound: Array, first: NDArray[np.intp]
    ) -> None:
        """Add n second-order cones |A c + b| <= bound - head . c.

        Args:
            A: (n, 3, width) successive nonzero entries of each cone's three rows.
            b: (n, 3) constant parts.
            head: (n, width) entries of the vector `head` of each cone, for the same coefficients.
            bound: (n,) bounds.
            first: (n,) index of the coefficient of each cone's first entry.
        """
        rows = np.concatenate([head[:, None], -A], axis=1).reshape(-1, A.shape[2])
        placed = self._sparse_rows(rows, np.repeat(first, 4))
        self._cones.append((placed, np.column_stack([bound, b])))

    def _sparse_rows(self, A: Array, first: NDArray[np.intp]) -> sparse.csr_array:
        from scipy import sparse

        n, width = A.shape
        columns = first[:, None] + np.arange(width)
        starts = width * np.arange(n + 1)
        return sparse.csr_array((A.reshape(-1), columns.reshape(-1), starts), shape=(n, self._k))

    @cached_property
    def rows(self) -> tuple[sparse.csr_array, Array, sparse.csr_array, Array]:
        """Matrix A and right side b of all linear rows A c <= b; then matrix and constant part of
        all cones, four rows each: the bound, and the three components of the vector.
        """
        from scipy import sparse

        A, b = zip(*self._linear, strict=True)
        cone_A, cone_b = zip(*self._cones, strict=True)
        stacked, cones = (sparse.vstack(each, format="csr") for each in (A, cone_A))
        return stacked, np.concatenate(b), cones, np.concatenate(cone_b)

    def used(self, c: Array, share: float) -> tuple[Mask, Mask]:
        """Find the linear rows and the cones whose left side exceeds a share of the right side.

        Args:
            c: (k,) coefficients.
            share: the share; 1 finds the violated rows and cones.

        Returns:
            Masks of the linear rows (n_linear,) and of the cones (n_cones,), True for those found.
        """
        A, b, cone_A, cone_b = self.rows
        inside = cone_b - (cone_A @ c).reshape(-1, 4)
        lengths = np.linalg.norm(inside[:, 1:], axis=1)
        return np.asarray(A @ c > share * b), np.asarray(lengths > share * inside[:, 0])

    def minimise(self, H: Array, g: Array, about: Array) -> Array | None:
        """Minimise c^T H c / 2 + g . c over spline coefficients c (k,), subject to all rows and
        cones.

        The first program has only the constraints that are nearly active at `about`. Violated
        constraints are added and the program is solved again, until none is violated.

        Args:
            H: (k, k) matrix of the objective.
            g: (k,) vector of the objective.
            about: (k,) coefficients near the solution.

        Returns:
            Coefficients (k,); None if the solver fails.
        """
        rows, cones = self.used(about, NEAR_ACTIVE_SHARE)
        while True:
            c = self._solve_subset(H, g, about, rows, cones)
            if c is None:
                return None
            more_rows, more_cones = self.used(c, 1.0 + SOLVER_MARGIN / 2.0)
            fresh = (more_rows & ~rows).any() or (more_cones & ~cones).any()
            if not fresh:
                return c
            rows, cones = rows | more_rows, cones | more_cones

    def _solve_subset(
        self, H: Array, g: Array, scale: Array, rows: Mask, cones: Mask
    ) -> Array | None:
        """Minimise c^T H c / 2 + g . c over coefficients c (k,), subject only to the rows and cones
        that are marked True; None if the solver fails. `scale` (k,) holds typical sizes of the
        coefficients; the solver's variables are c / scale."""
        # Not imported at the top: only jerk limits need it.
        import clarabel
        from scipy import sparse

        linear, b, cone_A, cone_b = self.rows
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        kinds: list[Any] = [clarabel.NonnegativeConeT(int(rows.sum()))]
        kinds += [clarabel.SecondOrderConeT(4)] * int(cones.sum())
        A = sparse.vstack([linear[rows], cone_A[np.repeat(cones, 4)]], format="csc")
        A.data *= np.repeat(scale, np.diff(A.indptr))
        A.eliminate_zeros()
        found = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(H * np.outer(scale, scale))),
            g * scale,
            sparse.csc_matrix(A),
            np.concatenate([b[rows], cone_b[cones].reshape(-1)]),
            kinds,
            settings,
        ).solve()
        answer = np.array(found.x) * scale
        solved = str(found.status) in ("Solved", "AlmostSolved") and np.isfinite(answer).all()
        return answer if solved else None
