"""Limits of a carry as linear rows on the path's timing.

At a point of the path every limit reads alpha u'' + beta u'^2 <= bound, either exactly (joint
speeds and accelerations) or as a supporting line of a convex limit (payload acceleration, normal
force), or as the linearisation of a limit that is not convex (joint torque, pressure shift).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.timing.adapter import SPEED_CEILING, IntervalRows
from hybrid_opt.timing.path_motion import PathMotion
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.records import Workcell

INTERVAL_ENDS = (0.0, 1.0)
"""Places within an interval at which limits are imposed, as a share of its length."""


@dataclass(frozen=True)
class PointRows:
    """Limits at points of the path: alpha u'' + beta u'^2 <= bound, each (points, k)."""

    alpha: Array
    beta: Array
    bound: Array


def join(rows: list[PointRows]) -> PointRows:
    """All rows side by side."""
    return PointRows(
        *[
            np.concatenate([getattr(row, name) for row in rows], axis=1)
            for name in ("alpha", "beta", "bound")
        ]
    )


def interval_rows(rows: PointRows, intervals: int, scale: float) -> IntervalRows:
    """The rows of each interval's points in terms of its u'' and its initial u'^2.

    Args:
        rows: at the points of all intervals, `INTERVAL_ENDS` per interval in order.
        scale: the path coordinate is scale times u.
    """
    k = rows.alpha.shape[1]
    # Within an interval u'^2 = u'^2_0 + 2 share length u''.
    progress = np.tile(np.array(INTERVAL_ENDS) * 2.0 * scale / intervals, intervals)[:, None]
    alpha, beta = rows.alpha / scale, rows.beta / scale**2
    shape = (intervals, len(INTERVAL_ENDS) * k)
    return IntervalRows(
        (alpha + progress * beta).reshape(shape), beta.reshape(shape), rows.bound.reshape(shape)
    )


def squared_speed_limit(motion: PathMotion, workcell: Workcell, limits: TimingLimits) -> Array:
    """(n,) largest u'^2 by all limits on speeds; infinite where nothing moves."""
    robots, payload, task = workcell.robots, workcell.payload, workcell.task
    velocity = np.concatenate([robot.velocity_max for robot in robots])
    linear = np.linalg.norm(motion.pose_first[:, :3], axis=1)
    angular = np.linalg.norm(motion.angular_first, axis=1)
    demands = [
        (np.abs(motion.q_first) / velocity).max(axis=1),
        linear / payload.velocity_max,
        angular / payload.angular_velocity_max,
    ]
    if limits.reference_speed:
        demands += [linear / task.reference_speed, angular / task.reference_angular_speed]
    demand = np.max(demands, axis=0)
    with np.errstate(divide="ignore"):
        limit: Array = 1.0 / demand**2
    return limit


def speed_rows(
    motion: PathMotion, workcell: Workcell, limits: TimingLimits, scale: float
) -> PointRows:
    """Limits on speeds, which bound u'^2 alone."""
    limit = squared_speed_limit(motion, workcell, limits)
    limit = np.minimum(limit, SPEED_CEILING / scale**2)[:, None]
    return PointRows(np.zeros_like(limit), 1.0 / limit, np.ones_like(limit))


def joint_acceleration_rows(motion: PathMotion, workcell: Workcell) -> PointRows:
    """Limits on joint accelerations q' u'' + q'' u'^2, both signs."""
    limit = np.concatenate([robot.acceleration_max for robot in workcell.robots])
    alpha, beta = motion.q_first / limit, motion.q_second / limit
    return PointRows(
        np.concatenate([alpha, -alpha], axis=1),
        np.concatenate([beta, -beta], axis=1),
        np.ones((len(alpha), 2 * alpha.shape[1])),
    )


def norm_rows(first: Array, second: Array, limit: float, directions: Array) -> PointRows:
    """Supporting lines of |first u'' + second u'^2| <= limit.

    Args:
        first, second: (n, 3).
        directions: (n, k, 3) unit vectors e; each gives e.(first u'' + second u'^2) <= limit.
    """
    alpha = np.einsum("nkd,nd->nk", directions, first) / limit
    beta = np.einsum("nkd,nd->nk", directions, second) / limit
    return PointRows(alpha, beta, np.ones_like(alpha))


def spanning_directions(first: Array, second: Array) -> Array:
    """(n, 4, 3): both signs of two orthogonal unit vectors that span first and second (n, 3)."""
    one = _unit(first)
    two = _unit(second - np.sum(second * one, axis=1, keepdims=True) * one)
    return np.stack([one, -one, two, -two], axis=1)


def tangent_rows(value: Array, gradient: Array, z: Array) -> PointRows:
    """Supporting lines of convex values <= 1, touching them at z.

    Args:
        value: (n, k) at z.
        gradient: (n, k, 2) by (u'', u'^2).
        z: (n, 2).
    """
    bound = 1.0 - value + np.einsum("nkd,nd->nk", gradient, z)
    return PointRows(gradient[..., 0], gradient[..., 1], bound)


def linearised_rows(value: Array, gradient: Array, at_rest: Array, z: Array) -> PointRows:
    """Linearisation of value <= 1 about z, kept satisfiable at rest.

    Where it would forbid rest, which is truly allowed, it follows the value by u'' and the chord to
    rest by u'^2: a row whose bound is raised instead cuts off nothing, not even z.

    Args:
        value: (n, k) at z.
        gradient: (n, k, 2) by (u'', u'^2).
        at_rest: (n, k) at u'' = u'^2 = 0, below one.
        z: (n, 2) the point of linearisation.
    """
    lines = tangent_rows(value, gradient, z)
    least = (1.0 - at_rest) / 2.0
    a, w = z[:, :1], z[:, 1:]
    chord = (value - at_rest - lines.alpha * a) / np.maximum(w, 1e-300)
    forbids = (lines.bound < least) & (w > 0.0)
    return PointRows(
        lines.alpha,
        np.where(forbids, chord, lines.beta),
        np.where(forbids, 1.0 - at_rest, np.maximum(lines.bound, least)),
    )


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: Array = np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), 0.0)
    return unit
