"""Orientation of the box from the last three numbers of its pose, and the rates of the orientation.

The convention of these numbers is `symbolic.records.poses.Orientation`: roll, pitch, yaw with R =
Rz(yaw) Ry(pitch) Rx(roll) (paper Eqs. 27-28), or a rotation vector v with R = exp(v) R_reference.
For the vector, angular velocity and acceleration are the vector parts of 2 q' q* and 2 q'' q* with
its unit quaternion q (Kuipers, Quaternions and Rotation Sequences, 1999). Both are in the world
frame. q is an entire function of v, written as a power series of |v|^2: there is no case
distinction at zero, and derivatives of any order are exact up to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial

import casadi as ca

from symbolic.expression import Expression
from symbolic.records.poses import Orientation

TERMS = 16
"""Number of terms of the power series. The rest is below 1e-17 up to one turn, and below 1e-13 up
to 1.5 turns."""

_COSINE = [(-0.25) ** n / factorial(2 * n) for n in range(TERMS)]
_SINE = [0.5 * (-0.25) ** n / factorial(2 * n + 1) for n in range(TERMS)]


def rotation_matrix(orientation: Orientation, numbers: Expression) -> Expression:
    """Compute the rotation R_world_box (3, 3) of a box pose.

    Args:
        orientation: convention of the three numbers.
        numbers: (3,) last three entries of the pose [rad].
    """
    if orientation.is_vector:
        turn = _matrix_of(*_quaternion(numbers))
        return ca.mtimes(turn, ca.DM(orientation.reference))
    return _rpy_matrix(numbers)


def angular_velocity(orientation: Orientation, numbers: Expression, rate: Expression) -> Expression:
    """Compute the angular velocity (3,) of the box in the world frame [rad/s].

    Args:
        orientation: convention of the three numbers.
        numbers: (3,) last three entries of the box pose [rad].
        rate: (3,) first time derivative of `numbers` [rad/s].
    """
    if orientation.is_vector:
        zero = type(rate).zeros(3)
        return _turned(*_quaternion(numbers), *_quaternion_rates(numbers, rate, zero)[0])
    return ca.mtimes(rate_matrix(numbers), rate)


def angular_acceleration(
    orientation: Orientation, numbers: Expression, rate: Expression, second: Expression
) -> Expression:
    """Compute the angular acceleration (3,) of the box in the world frame [rad/s^2].

    Args:
        orientation: convention of the three numbers.
        numbers: (3,) last three entries of the box pose [rad].
        rate, second: (3,) first and second time derivative of `numbers` [rad/s, rad/s^2].
    """
    if orientation.is_vector:
        return _turned(*_quaternion(numbers), *_quaternion_rates(numbers, rate, second)[1])
    return _rpy_acceleration(numbers, rate, second)


Quaternion = tuple[Expression, Expression]
"""A quaternion: real part, and vector part (3,)."""


def _quaternion(v: Expression) -> Quaternion:
    """Compute the unit quaternion of a rotation vector `v` (3,) [rad].

    Returns:
        Real part (scalar) and vector part (3,).
    """
    square = ca.sumsqr(v)
    return _series(_COSINE, square), _series(_SINE, square) * v


def _quaternion_rates(
    v: Expression, rate: Expression, second: Expression
) -> tuple[Quaternion, Quaternion]:
    """Compute the first and second time derivative of the unit quaternion of a rotation vector.

    Args:
        v: (3,) rotation vector [rad].
        rate, second: (3,) its first and second time derivative [rad/s, rad/s^2].

    Returns:
        The first, then the second derivative, each as real part (scalar) and vector part (3,).
    """
    square = ca.sumsqr(v)
    moved, pushed = 2.0 * ca.dot(v, rate), 2.0 * (ca.sumsqr(rate) + ca.dot(v, second))
    real, share = (_derivatives(each, square, moved, pushed) for each in (_COSINE, _SINE))
    scale = _series(_SINE, square)
    return (
        (real[0], share[0] * v + scale * rate),
        (real[1], share[1] * v + 2.0 * share[0] * rate + scale * second),
    )


def _derivatives(
    series: Sequence[float], square: Expression, moved: Expression, pushed: Expression
) -> Quaternion:
    """Compute the first and second time derivative of f(s) = sum_n c_n s^n, for a variable s that
    depends on time.

    Args:
        series: coefficients c_n, from n = 0.
        square: the variable s.
        moved, pushed: first and second time derivative of s.
    """
    first = [n * c for n, c in enumerate(series)][1:]
    slope = _series(first, square)
    bend = _series([n * c for n, c in enumerate(first)][1:], square)
    return slope * moved, bend * moved**2 + slope * pushed


def _series(coefficients: Sequence[float], x: Expression) -> Expression:
    total = type(x)(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _turned(w: Expression, u: Expression, w_rate: Expression, u_rate: Expression) -> Expression:
    """Compute the vector part (3,) of 2 q' q* for a quaternion q, with q' its time derivative and
    q* its conjugate. For a unit quaternion this is the angular velocity.

    Args:
        w, u: real part and vector part (3,) of q.
        w_rate, u_rate: real part and vector part (3,) of q'.
    """
    return 2.0 * (w * u_rate - w_rate * u + ca.cross(u, u_rate))


def _matrix_of(w: Expression, u: Expression) -> Expression:
    """Compute the rotation matrix (3, 3) of a unit quaternion with real part `w` and vector part
    `u` (3,)."""
    across = ca.skew(u)
    return type(w).eye(3) + 2.0 * (w * across + ca.mtimes(across, across))


def _rpy_matrix(rpy: Expression) -> Expression:
    cr, sr = ca.cos(rpy[0]), ca.sin(rpy[0])
    cp, sp = ca.cos(rpy[1]), ca.sin(rpy[1])
    cy, sy = ca.cos(rpy[2]), ca.sin(rpy[2])
    return ca.vertcat(
        ca.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        ca.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        ca.horzcat(-sp, cp * sr, cp * cr),
    )


def rate_matrix(rpy: Expression) -> Expression:
    """Compute the matrix E (3, 3) with which the time derivatives of roll, pitch, yaw give the
    angular velocity in the world frame: omega = E(rpy) @ rpy_rate [rad/s].

    Args:
        rpy: (3,) roll, pitch, yaw [rad].
    """
    cp, sp = ca.cos(rpy[1]), ca.sin(rpy[1])
    cy, sy = ca.cos(rpy[2]), ca.sin(rpy[2])
    return ca.vertcat(
        ca.horzcat(cy * cp, -sy, 0.0),
        ca.horzcat(sy * cp, cy, 0.0),
        ca.horzcat(-sp, 0.0, 1.0),
    )


def _rpy_acceleration(rpy: Expression, rate: Expression, second: Expression) -> Expression:
    cp, sp = ca.cos(rpy[1]), ca.sin(rpy[1])
    cy, sy = ca.cos(rpy[2]), ca.sin(rpy[2])
    d_pitch, d_yaw = rate[1], rate[2]
    # Columns of dE/dt; the yaw column of E is constant.
    roll_column = ca.vertcat(
        -sy * d_yaw * cp - cy * sp * d_pitch,
        cy * d_yaw * cp - sy * sp * d_pitch,
        -cp * d_pitch,
    )
    pitch_column = ca.vertcat(-cy * d_yaw, -sy * d_yaw, 0.0)
    return ca.mtimes(rate_matrix(rpy), second) + roll_column * rate[0] + pitch_column * rate[1]
