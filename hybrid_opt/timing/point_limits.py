"""Limits at the points of the path's intervals: rows for the linear problem, recomputed values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.robust.cases import is_squeezed
from hybrid_opt.robust.force import BoxMotion, robust_model
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, robust_path
from hybrid_opt.timing import rows as rows_of
from hybrid_opt.timing.model import REFINEMENT, TimingModel, contact_torque
from hybrid_opt.timing.path_motion import PathMotion
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.rows import INTERVAL_ENDS, PointRows
from hybrid_opt.timing.use import limits_pressure
from symbolic.array import Array

POINT_TOLERANCE = 1e-3
"""Largest excess at the points where limits are imposed, as a share of the limit."""

FORCE_SHARPNESS = 0.02
"""Tolerance of the normal force as a share of `POINT_TOLERANCE`."""


class PointLimits:
    """The limits of one path at `INTERVAL_ENDS` of every interval.

    Attributes:
        points: the path's geometry there.
        scale: the solver's path coordinate is scale times u, so that speeds are around one [s].
        grid: (intervals + 1,) the solver's path coordinate at the intervals' ends.
        rest: (points, k) `ratios` standing still.
    """

    def __init__(self, model: TimingModel, motion: PathMotion, limits: TimingLimits) -> None:
        self._model = model
        self._limits = limits
        intervals = model.intervals
        offsets = np.array([round(REFINEMENT * share) for share in INTERVAL_ENDS])
        self._index = (REFINEMENT * np.arange(intervals)[:, None] + offsets).reshape(-1)
        self.points = motion.at(self._index)
        self.scale = duration_at_speed_limits(model, motion, limits)
        self.grid = np.linspace(0.0, self.scale, intervals + 1)
        still = np.zeros(len(self._index))
        self.rest = self.ratios(still, still)

    def fixed(self) -> PointRows:
        """The limits that are linear by themselves: joint speeds and accelerations."""
        workcell = self._model.workcell
        return rows_of.join(
            [
                rows_of.speed_rows(self.points, workcell, self._limits, self.scale),
                rows_of.joint_acceleration_rows(self.points, workcell),
            ]
        )

    def at_points(self, squared: Array) -> tuple[Array, Array]:
        """u'^2 and u'' (points,) of a timing (intervals + 1,) in the scaled coordinate."""
        slope = np.diff(squared)
        w = squared[:-1, None] + np.outer(slope, INTERVAL_ENDS)
        a = np.repeat(slope / (2.0 * np.diff(self.grid)), len(INTERVAL_ENDS))
        return w.reshape(-1) / self.scale**2, a / self.scale

    def first_cuts(self) -> PointRows:
        """Supporting lines of the convex limits before any timing is known."""
        p, payload = self.points, self._model.workcell.payload
        linear = (p.pose_first[:, :3], p.pose_second[:, :3])
        angular = (p.angular_first, p.angular_second)
        cuts = [
            rows_of.norm_rows(*pair, limit, rows_of.spanning_directions(*pair))
            for pair, limit in (
                (linear, payload.acceleration_max),
                (angular, payload.angular_acceleration_max),
            )
        ]
        still = np.zeros(len(self._index))
        force = self._force_cuts(self._convex_forces(still, still), still, still)
        return rows_of.join([*cuts, *force])

    def _convex_forces(self, a: Array, w: Array) -> list[tuple[Array, Array]]:
        """Limited normal forces (n, 2) that are convex in (u'', u'^2) and their slopes (n, 2, 2):
        planned ones, and robust ones where their slopes are known."""
        if self._limits.force is None:
            return []
        slopes = self._model.workcell.has_force_slopes
        found = [self._model.path_force(self.points, a, w)] if slopes else []
        robust = self._robust(a, w)
        return found if robust is None else [*found, robust]

    def _force_cuts(self, forces: list[tuple[Array, Array]], a: Array, w: Array) -> list[PointRows]:
        """Their supporting lines at u'' = a and u'^2 = w."""
        z, limit = np.stack([a, w], axis=1), self._limits.force or np.inf
        return [rows_of.tangent_rows(force / limit, slope / limit, z) for force, slope in forces]

    def _robust(self, a: Array, w: Array) -> tuple[Array, Array] | None:
        """Robust forces (n, 2) and their slopes (n, 2, 2) by (u'', u'^2), where these are limited
        and convex."""
        if not (self._limits.robust and is_squeezed(self._model.workcell)):
            return None
        p = self.points
        path = (p.pose[:, :6], p.pose_first[:, :6], p.pose_second[:, :6])
        force, slope = robust_path(self._model.workcell).at(PathPoints(*path, a, w))
        return force, slope[:, :, BY_TIMING]

    def cut(self, a: Array, w: Array) -> tuple[list[PointRows], float]:
        """Supporting lines of the convex limits that a timing exceeds, and the largest excess."""
        cuts: list[PointRows] = []
        p, payload = self.points, self._model.workcell.payload
        worst_excess = -1.0
        for first, second, limit in (
            (p.pose_first[:, :3], p.pose_second[:, :3], payload.acceleration_max),
            (p.angular_first, p.angular_second, payload.angular_acceleration_max),
        ):
            vector = first * a[:, None] + second * w[:, None]
            length = np.linalg.norm(vector, axis=1, keepdims=True)
            excess = float(length.max()) / limit - 1.0
            worst_excess = max(worst_excess, excess)
            if excess > POINT_TOLERANCE:
                direction = vector / np.maximum(length, 1e-12)
                cuts.append(rows_of.norm_rows(first, second, limit, direction[:, None, :]))
        forces = self._convex_forces(a, w)
        if forces and self._limits.force is not None:
            largest = max(float(force.max()) for force, _ in forces)
            excess = largest / self._limits.force - 1.0
            worst_excess = max(worst_excess, excess)
            # What the force limit leaves for the motion is small, so the whole of it counts.
            if excess > POINT_TOLERANCE * FORCE_SHARPNESS:
                cuts += self._force_cuts(forces, a, w)
                worst_excess = max(worst_excess, 2.0 * POINT_TOLERANCE)
        return cuts, worst_excess

    def ratios(self, a: Array, w: Array) -> Array:
        """Limits that are not convex, over their limits at the points, signed (n, k)."""
        columns: list[Array] = []
        p, workcell = self.points, self._model.workcell
        pressure = limits_pressure(workcell, self._limits)
        robust = self._limits.robust and not is_squeezed(workcell)
        force = self._limits.force if robust or not workcell.has_force_slopes else None
        if not (self._limits.torque or pressure or force):
            return np.zeros((len(a), 0))
        load = self._model.drive(p, np.sqrt(w), a)
        if self._limits.torque:
            own = p.torque_by_acceleration * a[:, None] + p.torque_by_speed * w[:, None]
            torque = contact_torque(workcell, p.wrench_torque, load) + own + p.torque_at_rest
            columns.append(torque / np.concatenate([r.torque_max for r in workcell.robots]))
        if pressure:
            radius = np.array([contact.patch_radius for contact in workcell.contacts])
            columns.append(load["pressure_shift"] / radius)
        if force:
            needed = self._robust_anywhere(a, w) if robust else load["normal_force"]
            columns.append(needed / force)
        return np.concatenate(columns, axis=1)

    def _robust_anywhere(self, a: Array, w: Array) -> Array:
        """(n, 2) robust forces of pads that are not squeezed (`is_squeezed`)."""
        p, workcell = self.points, self._model.workcell
        path = (p.pose[:, :6], p.pose_first[:, :6], p.pose_second[:, :6])
        motion = BoxMotion(*PathPoints(*path, a, w).motion)
        commanded, leading = robust_model(workcell).hold(motion, workcell.uncertainty)
        return np.stack([leading, commanded], axis=1)

    def linearise(self, ratios: Array, near: NDArray[np.bool_], a: Array, w: Array) -> PointRows:
        """Rows of the ratios near their limits, by forward differences in (u'', u'^2)."""
        step_a = 1e-5 * max(float(np.abs(a).max()), 1e-6)
        step_w = 1e-5 * max(float(w.max()), 1e-6)
        gradient = np.stack(
            [
                (self.ratios(a + step_a, w) - ratios) / step_a,
                (self.ratios(a, w + step_w) - ratios) / step_w,
            ],
            axis=-1,
        )[:, near]
        z = np.stack([a, w], axis=1)
        value, rest = ratios[:, near], self.rest[:, near]
        return rows_of.join(
            [
                rows_of.linearised_rows(sign * value, sign * gradient, sign * rest, z)
                for sign in (1.0, -1.0)
            ]
        )


def duration_at_speed_limits(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> float:
    """Duration of a path driven at its speed limits alone, without ramps [s]."""
    squared = rows_of.squared_speed_limit(motion, model.workcell, limits)
    slowness = 1.0 / np.sqrt(np.minimum(squared, 1e8))
    return float(np.trapezoid(slowness, motion.parameter))
