"""Orientation of the box from roll, pitch, yaw, and its rates.

R = Rz(yaw) Ry(pitch) Rx(roll) (paper Eqs. 27-28); angular velocity and acceleration are in the
world frame.
"""

from __future__ import annotations

import casadi as ca

from symbolic.expression import Expression


def rotation_matrix(rpy: Expression) -> Expression:
    """R_world_box (3, 3) from roll, pitch, yaw (3,) [rad]."""
    cr, sr = ca.cos(rpy[0]), ca.sin(rpy[0])
    cp, sp = ca.cos(rpy[1]), ca.sin(rpy[1])
    cy, sy = ca.cos(rpy[2]), ca.sin(rpy[2])
    return ca.vertcat(
        ca.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        ca.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        ca.horzcat(-sp, cp * sr, cp * cr),
    )


def rate_matrix(rpy: Expression) -> Expression:
    """E (3, 3) with angular velocity = E(rpy) @ rpy_rate, world frame."""
    cp, sp = ca.cos(rpy[1]), ca.sin(rpy[1])
    cy, sy = ca.cos(rpy[2]), ca.sin(rpy[2])
    return ca.vertcat(
        ca.horzcat(cy * cp, -sy, 0.0),
        ca.horzcat(sy * cp, cy, 0.0),
        ca.horzcat(-sp, 0.0, 1.0),
    )


def angular_velocity(rpy: Expression, rate: Expression) -> Expression:
    """Angular velocity (3,) in the world frame from rpy and its rate [rad/s]."""
    return ca.mtimes(rate_matrix(rpy), rate)


def angular_acceleration(rpy: Expression, rate: Expression, second: Expression) -> Expression:
    """Angular acceleration (3,) in the world frame from rpy, its rate and second rate."""
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
