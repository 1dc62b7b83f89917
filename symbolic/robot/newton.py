"""Newton steps of an arm's inverse kinematics, and how near a posture is to singular.

Six joints follow the flange; an arm's redundant ones stay where they are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, reduce
from itertools import combinations
from operator import add

import casadi as ca
import numpy as np

from symbolic.robot.model import RobotModel

MAX_JOINT_STEP = 0.5
"""Largest change of a joint in one Newton step, and between samples of one motion [rad]."""

_POSTURES = 200
"""Random postures in which the axes of an arm are compared."""


def pose_error(R_target: ca.SX, p_target: ca.SX, R: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Newton's right-hand side (6,) and the pose residual (scalar) of a placement.

    The right-hand side holds the position error and the axis of the rotation error times the
    sine of its angle. The residual uses twice the sine of the half angle instead, which is zero
    for equal rotations only.
    """
    dR = ca.mtimes(R_target, R.T)
    axis = ca.vertcat(dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]) / 2.0
    dp = p_target - p
    turn_squared = ca.sumsqr(R_target - R) / 2.0
    return ca.vertcat(dp, axis), ca.sqrt(ca.sumsqr(dp) + turn_squared + 1e-40)


def newton_step(model: RobotModel, q: ca.SX, R_target: ca.SX, p_target: ca.SX) -> ca.SX:
    """One safeguarded Newton step of the inverse kinematics; q (n,) to q (n,)."""
    R, p = model.placement(q)
    error, _ = pose_error(R_target, p_target, R, p)
    Q, upper = ca.qr(following_columns(model, model.jacobian(q)))
    step = ca.solve(upper, ca.mtimes(Q.T, error))
    return _limited(model, q, step)


def block_step(
    model: RobotModel, q: ca.SX, R_target: ca.SX, p_target: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """A Newton step of the six joints with fewer operations, and the pose residual before it.

    The angular rows give three joints in terms of the others by Cramer's rule, and the rest is
    again a 3 by 3 system. Without pivoting: not to be trusted where the three axes nearly lie in a
    plane, of which the next residual tells.
    """
    R, p, whole = model.kinematics(q)
    jacobian = following_columns(model, whole)
    error, residual = pose_error(R_target, p_target, R, p)
    inner = _independent_axes(model)
    outer = list(_others(inner))
    linear, angular = jacobian[:3, :], jacobian[3:, :]
    solve = _cramer(angular[:, list(inner)])
    across = ca.horzcat(*[solve(angular[:, k]) for k in outer])
    turned = solve(error[3:])
    reduced = linear[:, outer] - ca.mtimes(linear[:, list(inner)], across)
    moved = _cramer(reduced)(error[:3] - ca.mtimes(linear[:, list(inner)], turned))
    rest = turned - ca.mtimes(across, moved)
    step = [ca.SX(0)] * 6
    for group, values in ((outer, moved), (inner, rest)):
        for k, joint in enumerate(group):
            step[joint] = values[k]
    return _limited(model, q, ca.vertcat(*step)), residual


def _cramer(A: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """Solves A x = b, A (3, 3), for right-hand sides b (3,)."""
    a, b, c = A[:, 0], A[:, 1], A[:, 2]
    rows = ca.cross(b, c), ca.cross(c, a), ca.cross(a, b)
    # The guard keeps CasADi from turning the products with a reciprocal into divisions.
    reciprocal = ca.fmin(1.0 / ca.dot(a, rows[0]), 1e300)
    return lambda right: ca.vertcat(*[ca.dot(row, right) * reciprocal for row in rows])


@lru_cache(maxsize=8)
def _independent_axes(model: RobotModel) -> tuple[int, ...]:
    """Of the six joints the three whose axes keep farthest from a common plane, in most
    postures."""
    lower, upper = model.model.lowerPositionLimit, model.model.upperPositionLimit
    postures = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, len(lower)))
    jacobians = np.array(model.jacobian.map(_POSTURES)(postures.T)).reshape(6, _POSTURES, -1)
    axes = jacobians[3:, :, list(model.following)].transpose(1, 0, 2)

    def volume(joints: tuple[int, ...]) -> float:
        return float(np.quantile(np.abs(np.linalg.det(axes[:, :, list(joints)])), 0.1))

    return max(combinations(range(6), 3), key=volume)


def following_columns(model: RobotModel, jacobian: ca.SX) -> ca.SX:
    """The columns (6, 6) of a Jacobian (6, n) that belong to the joints that follow the box."""
    return jacobian[:, list(model.following)] if model.redundant else jacobian


def _limited(model: RobotModel, q: ca.SX, step: ca.SX) -> ca.SX:
    """q after a step of the six joints that is shortened to `MAX_JOINT_STEP`."""
    largest = ca.norm_inf(step)
    # At a singular posture the step is not a number: stay, and let the residual tell.
    usable = ca.norm_1(step) < 1e9
    scale = MAX_JOINT_STEP / ca.fmax(largest, MAX_JOINT_STEP)
    moved = list(ca.vertsplit(q))
    for k, joint in enumerate(model.following):
        moved[joint] = q[joint] + ca.if_else(usable, scale * step[k], 0.0)
    return ca.vertcat(*moved)


def manipulability(jacobian: ca.SX) -> ca.SX:
    """|det J| [m^3] of a (6, 6) Jacobian (Yoshikawa's measure of six joints).

    By Laplace's expansion in minors of three rows: no division, so exact at singular postures.
    """
    upper, lower = _minors(jacobian[:3, :]), _minors(jacobian[3:, :])
    signed = [
        (-1.0) ** (sum(chosen) - 3) * minor * lower[_others(chosen)]
        for chosen, minor in upper.items()
    ]
    return ca.fabs(reduce(add, signed))


def _others(joints: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(k for k in range(6) if k not in joints)


def _minors(rows: ca.SX) -> dict[tuple[int, ...], ca.SX]:
    """Determinants of all 3 by 3 parts of (3, 6) rows, by their columns."""
    pairs = {
        (i, j): rows[1, i] * rows[2, j] - rows[1, j] * rows[2, i]
        for i, j in combinations(range(6), 2)
    }
    return {
        (i, j, k): rows[0, i] * pairs[j, k] - rows[0, j] * pairs[i, k] + rows[0, k] * pairs[i, j]
        for i, j, k in combinations(range(6), 3)
    }
