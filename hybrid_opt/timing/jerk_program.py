"""The convex program of one round of a timing within jerk limits, see `hybrid_opt.timing.jerk`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.timing.model import PathMotion, TimingModel, contact_torque
from hybrid_opt.timing.records import JerkLimits, TimingLimits
from hybrid_opt.timing.rows import squared_speed_limit
from hybrid_opt.timing.use import limits_pressure
from symbolic.array import Array
from symbolic.physics.contact_forces import GRAVITY

Mask = NDArray[np.bool_]

NEAR = 0.6
"""Torques and shifts that stay below this share of their limit get no rows."""

KEPT = 1e-4
"""Share of every limit that the program leaves unused: what the solver rounds off."""

LEAST_SHARE = 0.05
"""Of its last value that a coefficient keeps at least."""

FIRST_ROWS = 0.4
"""Rows that the last coefficients use to more than this share enter a program at once."""


@dataclass(frozen=True)
class Point:
    """Places along the warped path; all arrays by place.

    Attributes:
        s: in [0, 1].
        value, first, second: (n, k) basis of v and its derivatives.
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


class _Rows:
    """Rows b - A c, at least zero or in second-order cones of four, collected."""

    def __init__(self, k: int) -> None:
        self._linear: list[tuple[Array, Array]] = [(np.zeros((0, k)), np.zeros(0))]
        self._cones: list[tuple[Array, Array]] = [(np.zeros((0, 4, k)), np.zeros((0, 4)))]

    def below(self, A: Array, b: Array) -> None:
        """A c <= b, (n, k) and (n,)."""
        self._linear.append((A, b))

    def within(self, A: Array, b: Array, head: Array, bound: Array) -> None:
        """|A c + b| <= bound - head c, by (n, 3, k), (n, 3), (n, k), (n,)."""
        self._cones.append(
            (np.concatenate([head[:, None], -A], axis=1), np.column_stack([bound, b]))
        )

    def assembled(self) -> _Program:
        """All of them."""
        linear, cones = (
            [np.concatenate(parts) for parts in zip(*pairs, strict=True)]
            for pairs in (self._linear, self._cones)
        )
        return _Program(linear[0], linear[1], cones[0], cones[1])


@dataclass(frozen=True)
class _Program:
    """Linear rows (n, k), (n,) and cones (m, 4, k), (m, 4), of which few matter at a time."""

    A: Array
    b: Array
    cone_A: Array
    cone_b: Array

    def used(self, c: Array, share: float) -> tuple[Mask, Mask]:
        """Which linear rows and which cones c uses to more than a share."""
        inside = self.cone_b - self.cone_A @ c
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
        A = np.concatenate([self.A[rows], self.cone_A[cones].reshape(-1, len(g))])
        found = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(H * np.outer(scale, scale))),
            g * scale,
            sparse.csc_matrix(A * scale),
            np.concatenate([self.b[rows], self.cone_b[cones].reshape(-1)]),
            kinds,
            settings,
        ).solve()
        answer = np.array(found.x) * scale
        solved = str(found.status) in ("Solved", "AlmostSolved") and np.isfinite(answer).all()
        return answer if solved else None


def convex_step(
    model: TimingModel, at: Point, c: Array, limits: TimingLimits, jerk: JerkLimits
) -> Array | None:
    """Better coefficients than c (k,), which satisfy all limits at the points; None without any."""
    rows = _Rows(len(c))
    _motion_rows(model, at, limits, rows)
    _force_rows(model, at, limits, rows)
    _ratio_rows(model, at, c, limits, rows)
    _jerk_rows(at, c, jerk, rows)
    rows.below(-np.eye(len(c)), -LEAST_SHARE * c)
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


def _motion_rows(model: TimingModel, at: Point, limits: TimingLimits, rows: _Rows) -> None:
    """Speeds and accelerations of joints and box."""
    workcell, m, keep = model.workcell, at.motion, at.keep
    ceiling = np.minimum(squared_speed_limit(m, workcell, limits), 1e6)
    rows.below(at.squared_by / ceiling[:, None], keep)
    limit = np.concatenate([robot.acceleration_max for robot in workcell.robots])
    by = (m.q_first / limit)[:, :, None] * at.acceleration_by[:, None, :]
    by = by + (m.q_second / limit)[:, :, None] * at.squared_by[:, None, :]
    flat = by.reshape(-1, by.shape[2])
    for sign in (1.0, -1.0):
        rows.below(sign * flat, np.repeat(keep, len(limit)))
    payload = workcell.payload
    for first, second, most in (
        (m.pose_first[:, :3], m.pose_second[:, :3], payload.acceleration_max),
        (m.angular_first, m.angular_second, payload.angular_acceleration_max),
    ):
        A = first[:, :, None] * at.acceleration_by[:, None] + (
            second[:, :, None] * at.squared_by[:, None]
        )
        n, k = len(at.s), at.value.shape[1]
        rows.within(A / most, np.zeros((n, 3)), np.zeros((n, k)), keep)


def _force_rows(model: TimingModel, at: Point, limits: TimingLimits, rows: _Rows) -> None:
    """Both normal forces, each branch a cone: share_n F_n + share_t |F_t| <= the limit."""
    if limits.force is None:
        return
    import casadi as ca

    from symbolic.physics.contact_forces import normal_force_branches

    workcell, m, force = model.workcell, at.motion, limits.force
    friction = (workcell.contacts[0].friction, workcell.contacts[1].friction)
    by_normal, by_tangent = (
        np.array(normal_force_branches(ca.DM(n), ca.DM(1 - n), friction)).reshape(-1)
        for n in (1, 0)
    )
    weight = workcell.payload.mass * np.array(GRAVITY)
    A = m.force_by_acceleration[:, :, None] * at.acceleration_by[:, None] + (
        m.force_by_speed[:, :, None] * at.squared_by[:, None]
    )
    along = np.einsum("nd,ndk->nk", m.normal, A)
    still = -(m.normal @ weight)
    across = A - m.normal[:, :, None] * along[:, None]
    rest = -weight - m.normal * still[:, None]
    for extra in (1.0, 0.0):  # N_1 = N_2 + F_n
        for share_n, share_t in zip(by_normal + extra, by_tangent, strict=True):
            room = at.keep * force - share_n * still
            if share_t > 0.0:
                rows.within(
                    share_t * across / force,
                    share_t * rest / force,
                    share_n * along / force,
                    room / force,
                )
            elif share_n:
                rows.below(share_n * along / force, room / force)


def _ratio_rows(model: TimingModel, at: Point, c: Array, limits: TimingLimits, rows: _Rows) -> None:
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
        # What is exceeded between rounds, because it is not convex, may stay as it is for one.
        bound = np.maximum(at.keep[:, None], sign * chosen) - sign * chosen + sign * (by @ c)
        rows.below(sign * by.reshape(-1, by.shape[2]), bound.reshape(-1))


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


def _jerk_rows(at: Point, c: Array, jerk: JerkLimits, rows: _Rows) -> None:
    """Jerk over sqrt(v) below the tangent of the limit over sqrt(v) at c."""
    v = at.value @ c
    level, slope = 1.5 / np.sqrt(v), 0.5 * v**-1.5
    # Multiplied by sqrt(v) of the last round, so that rows are of order one.
    root = np.sqrt(v)
    head = (at.keep * slope * root)[:, None] * at.value
    level = at.keep * level * root
    limited = np.isfinite(jerk.joints)
    by = at.joint_jerk_by[:, limited] / jerk.joints[limited, None] * root[:, None, None]
    joints = by.shape[1]
    bound = np.repeat(level, joints)
    below = np.repeat(head, joints, axis=0)
    for sign in (1.0, -1.0):
        rows.below(sign * by.reshape(-1, by.shape[2]) + below, bound)
    if np.isfinite(jerk.payload):
        box = at.box_jerk_by / jerk.payload * root[:, None, None]
        rows.within(box, np.zeros((len(v), 3)), head, level)
