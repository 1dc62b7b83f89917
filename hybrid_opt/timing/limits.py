"""Limits along a path as functions of path acceleration and squared speed, for optimisation
programs."""

from __future__ import annotations

import numpy as np

from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, robust_path
from hybrid_opt.timing.model import PathMotion, TimingModel, row_lengths
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.limits import Limit, limits_of_block

SPEEDS, PAYLOAD_ACCELERATIONS = limits_of_block("speed"), limits_of_block("cone")
(JOINT_ACCELERATION,) = limits_of_block("acceleration")

LINEARISED_ABOVE = 0.6
"""Joint torques and pressure shifts below this share of their limits are left out of programs."""


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
        """Compute the normal forces over the force limit, as far as they are convex functions of
        (u'', u'^2).

        Args:
            a: (n,) path accelerations u'' [1/s^2].
            w: (n,) squared path speeds u'^2 [1/s^2].

        Returns:
            One pair for planned forces, and one for robust forces if these are limited: values (n,
            2) of both robots, and their derivatives (n, 2, 2) by (u'', u'^2). An empty list without
            force limit.
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
        """Compute, over their limits, the limited quantities that are not convex in (u'', u'^2).

        The columns are, in this order and as far as limited:

        - joint torques, with sign;
        - pressure shifts of both pads;
        - robust forces of both robots. They are left out if the normal force of one pad determines
          that of the other pad, because `forces` has them then.

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
