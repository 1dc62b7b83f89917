"""Numeric homogeneous transforms, with the project's angle convention."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from symbolic.array import Array


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Rotation Rz(yaw) Ry(pitch) Rx(roll), the convention of URDF.

    Args:
        rpy: (3,) roll, pitch, yaw [rad].

    Returns:
        (3, 3).
    """
    roll, pitch, yaw = np.asarray(rpy, dtype=float)
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [0.0 - sp, cp * sr, cp * cr],
        ]
    )


def pose_matrix(xyz: ArrayLike, rpy: ArrayLike) -> Array:
    """Homogeneous transform from a position [m] and roll, pitch, yaw [rad]. Returns (4, 4)."""
    return transform(rotation_from_rpy(rpy), xyz)


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Homogeneous transform from a rotation (3, 3) and a translation (3,) [m]. Returns (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def inverse(T_a_b: Array) -> Array:
    """The transform T_b_a of a rigid T_a_b, without a general matrix inversion."""
    rotation = T_a_b[:3, :3].T
    return transform(rotation, -rotation @ T_a_b[:3, 3])
