"""One convex step towards a timing within limits on jerk: the limits as rows of its program."""

from __future__ import annotations

import numpy as np

from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, robust_path
from hybrid_opt.timing.jerk_program import Point, Rows
from hybrid_opt.timing.model import TimingModel, contact_torque
from hybrid_opt.timing.path_motion import PathMotion
from hybrid_opt.timing.records import JerkLimits, TimingLimits
from hybrid_opt.timing.rows import squared_speed_limit
from hybrid_opt.timing.use import limits_pressure
from symbolic.array import Array

LEAST_SHARE = 0.05
"""Least share of its last value that a coefficient keeps."""

NEAR = 0.6
"""Torques and shifts that stay below this share of their limit get no rows."""


def convex_step(
    model: TimingModel, at: Point, c: Array, limits: TimingLimits, jerk: JerkLimits
) -> Array | None:
    """Better coefficients than c (k,), which satisfy all limits at the points; None without any."""
    rows = Rows(len(c))
    _motion_rows(model, at, limits, rows)
    _force_rows(model, at, c, limits, rows)
    _ratio_rows(model, at, c, limits, rows)
    _jerk_rows(at, c, jerk, rows)
    rows.below(-np.ones((len(c), 1)), -LEAST_SHARE * c, np.arange(len(c)))
    gradient, H = at.objective(c)
    answer = rows.assembled().minimised(H, gradient - H @ c, c)
    if answer is None:
        return None
    # The quadratic model promises too much far away: c and the answer are both allowed, and so is
    # everything between them.
    share = 1.0
    while at.duration(c + share * (answer - c)) > at.duration(c) and share > 1e-3:
        share *= 0.5
    return np.asarray(c + share * (answer - c))


def _motion_rows(model: TimingModel, at: Point, limits: TimingLimits, rows: Rows) -> None:
    """Speeds and accelerations of joints and box."""
    workcell, m, keep = model.workcell, at.motion, at.keep
    first_basis = at.first_basis
    squared_by, acceleration_by = at.local(at.squared_by), at.local(at.acceleration_by)
    ceiling = np.minimum(squared_speed_limit(m, workcell, limits), 1e6)
    rows.below(squared_by / ceiling[:, None], keep, first_basis)
    limit = np.concatenate([robot.acceleration_max for robot in workcell.robots])
    by = (m.q_first / limit)[:, :, None] * acceleration_by[:, None, :]
    by = by + (m.q_second / limit)[:, :, None] * squared_by[:, None, :]
    flat, bound = by.reshape(-1, by.shape[2]), np.repeat(keep, len(limit))
    for sign in (1.0, -1.0):
        rows.below(sign * flat, bound, np.repeat(first_basis, len(limit)))
    payload = workcell.payload
    for first, second, most in (
        (m.pose_first[:, :3], m.pose_second[:, :3], payload.acceleration_max),
        (m.angular_first, m.angular_second, payload.angular_acceleration_max),
    ):
        A = first[:, :, None] * acceleration_by[:, None] + second[:, :, None] * squared_by[:, None]
        none = np.zeros_like(squared_by)
        rows.within(A / most, np.zeros((len(at.s), 3)), none, keep, first_basis)


def _force_rows(model: TimingModel, at: Point, c: Array, limits: TimingLimits, rows: Rows) -> None:
    """Normal forces below the limit, planned and robust ones, linearised at c: they are convex in
    (u'', u'^2)."""
    if limits.force is None:
        return
    workcell, m = model.workcell, at.motion
    a, w = at.acceleration_by @ c, np.maximum(at.squared_by @ c, 0.0)
    forces = [model.path_force(m, a, w)] if workcell.has_force_slopes else []
    if limits.robust:
        path = (m.pose[:, :6], m.pose_first[:, :6], m.pose_second[:, :6])
        force, slope = robust_path(workcell).at(PathPoints(*path, a, w))
        forces.append((force, slope[:, :, BY_TIMING]))
    along = np.stack([at.acceleration_by, at.squared_by], axis=1)[:, None]
    for force, slope in forces:
        by = ((slope / limits.force)[..., None] * along).sum(axis=2)
        _linearised(at, c, force / limits.force, by, rows)


def _linearised(at: Point, c: Array, value: Array, by: Array, rows: Rows) -> None:
    """Values (n, m) at c over their limits, with derivatives (n, m, k), below one.

    What is exceeded between rounds, by what the last one left out, may stay as it is for one.
    """
    bound = np.maximum(at.keep[:, None], value) - value + by @ c
    A = at.local(by)
    first = np.repeat(at.first_basis, by.shape[1])
    rows.below(A.reshape(-1, A.shape[2]), bound.reshape(-1), first)


def _ratio_rows(model: TimingModel, at: Point, c: Array, limits: TimingLimits, rows: Rows) -> None:
    """Joint torques and shifts of the pressure, linearised at c."""
    a, w = at.acceleration_by @ c, np.maximum(at.squared_by @ c, 0.0)
    value = _ratios(model, at.motion, a, w, limits)
    near = (np.abs(value) > NEAR).any(axis=0)
    if not near.any():
        return
    step_a, step_w = 1e-5 * max(float(np.abs(a).max()), 1e-6), 1e-5 * max(float(w.max()), 1e-6)
    by_a = (_ratios(model, at.motion, a + step_a, w, limits) - value)[:, near] / step_a
    by_w = (_ratios(model, at.motion, a, w + step_w, limits) - value)[:, near] / step_w
    by = by_a[:, :, None] * at.acceleration_by[:, None] + by_w[:, :, None] * at.squared_by[:, None]
    chosen = value[:, near]
    for sign in (1.0, -1.0):
        _linearised(at, c, sign * chosen, sign * by, rows)


def _ratios(
    model: TimingModel, motion: PathMotion, a: Array, w: Array, limits: TimingLimits
) -> Array:
    """(n, ...) joint torques and shifts over their limits, as far as they are limited."""
    workcell = model.workcell
    load = model.drive(motion, np.sqrt(w), a)
    own = motion.torque_by_acceleration * a[:, None] + motion.torque_by_speed * w[:, None]
    torque = contact_torque(workcell, motion.wrench_torque, load) + own + motion.torque_at_rest
    columns = [np.zeros((len(a), 0))]
    if limits.torque:
        columns.append(torque / np.concatenate([r.torque_max for r in workcell.robots]))
    if limits_pressure(workcell, limits):
        radius = np.array([contact.patch_radius for contact in workcell.contacts])
        columns.append(load["pressure_shift"] / radius)
    return np.concatenate(columns, axis=1)


def _jerk_rows(at: Point, c: Array, jerk: JerkLimits, rows: Rows) -> None:
    """Jerk over sqrt(v) below the tangent of the limit over sqrt(v) at c."""
    v = at.value @ c
    level, slope = 1.5 / np.sqrt(v), 0.5 * v**-1.5
    # Multiplied by sqrt(v) of the last round, so that rows are of order one.
    root = np.sqrt(v)
    head = (at.keep * slope * root)[:, None] * at.local(at.value)
    level = at.keep * level * root
    limited = np.isfinite(jerk.joints)
    joint_jerk_by = at.local(at.joint_jerk_by)[:, limited]
    by = joint_jerk_by / jerk.joints[limited, None] * root[:, None, None]
    joints = by.shape[1]
    bound = np.repeat(level, joints)
    below = np.repeat(head, joints, axis=0)
    first = np.repeat(at.first_basis, joints)
    for sign in (1.0, -1.0):
        rows.below(sign * by.reshape(-1, by.shape[2]) + below, bound, first)
    if np.isfinite(jerk.payload):
        box = at.local(at.box_jerk_by) / jerk.payload * root[:, None, None]
        rows.within(box, np.zeros((len(v), 3)), head, level, at.first_basis)
