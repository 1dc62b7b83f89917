"""Poses as numbers: homogeneous transforms, and the coordinates of rotations in a cell's poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from symbolic.array import Array


def read_only(values: Any) -> Array:
    """Return a read-only float64 copy of an array or of nested sequences of numbers."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


# --- a chart of the rotations ---


Rotation = Literal["roll-pitch-yaw", "quaternion"]


@dataclass(frozen=True)
class Orientation:
    """Convention by which three numbers [rad] describe R_world_box.

    'roll-pitch-yaw' is the paper's convention: Rz(yaw) Ry(pitch) Rx(roll). 'quaternion' is a
    rotation vector v along the world's axes: R_world_box = exp(v) R_reference, where exp(v) rotates
    about v by the angle norm(v).

    Attributes:
        rotation: 'roll-pitch-yaw' or 'quaternion'.
        reference: (3, 3) R_world_box at v = 0; only for 'quaternion'.
    """

    rotation: Rotation = "roll-pitch-yaw"
    reference: Array = field(default_factory=lambda: read_only(np.eye(3)))

    @property
    def is_vector(self) -> bool:
        """True if the three numbers are a rotation vector; False if they are roll, pitch and yaw,
        each periodic in full turns."""
        return self.rotation == "quaternion"

    @property
    def components(self) -> tuple[str, str, str]:
        """Names of the three numbers, for messages and tables."""
        if self.is_vector:
            return ("rotation x", "rotation y", "rotation z")
        return ("roll", "pitch", "yaw")

    @cached_property
    def unwrapped(self) -> Callable[[Array], Array]:
        """Function that removes jumps by full turns from orientations (..., n, 3) [rad] of n poses
        along a path. Rotation vectors are returned unchanged."""
        return np.asarray if self.is_vector else partial(np.unwrap, axis=-2)


# --- homogeneous transforms ---


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Compute rotations Rz(yaw) Ry(pitch) Rx(roll), the convention of URDF.

    Args:
        rpy: (..., 3) roll, pitch, yaw [rad].

    Returns:
        (..., 3, 3) rotation matrices.
    """
    angles = np.moveaxis(np.asarray(rpy, dtype=float), -1, 0)
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [0.0 - sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rpy_from_rotation(rotation: Array) -> Array:
    """Compute roll, pitch, yaw (3,) [rad] of a rotation matrix (3, 3), the inverse of
    `rotation_from_rpy`. At a pitch of +-90 degrees roll is zero."""
    level = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], level)
    if level < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def rotation_from_vector(vector: ArrayLike) -> Array:
    """Compute rotation matrices exp(v) (..., 3, 3) of rotation vectors v (..., 3) [rad] by
    Rodrigues' formula."""
    v = np.asarray(vector, dtype=float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    across = np.cross(v[..., None, :], np.eye(3))
    # The rows of `across` are v x e_k: the transpose of the skew matrix of v.
    skew = np.swapaxes(across, -1, -2)
    bend = np.sinc(angle / (2.0 * np.pi)) ** 2 / 2.0
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * skew + bend * (skew @ skew))


def box_rotation(orientation: Orientation, pose: ArrayLike) -> Array:
    """Compute the rotations R_world_box (..., 3, 3) of box poses.

    Args:
        orientation: convention of the last three numbers of a pose.
        pose: (..., 6) poses [m, rad].
    """
    numbers = np.asarray(pose, dtype=float)[..., 3:6]
    if orientation.is_vector:
        return np.asarray(rotation_from_vector(numbers) @ orientation.reference)
    return rotation_from_rpy(numbers)


def box_placement(orientation: Orientation, pose: ArrayLike) -> Array:
    """Compute the transforms T_world_box (..., 4, 4) of box poses.

    Args:
        orientation: convention of the last three numbers of a pose.
        pose: (..., 6) poses [m, rad].
    """
    given = np.asarray(pose, dtype=float)
    T = np.zeros((*given.shape[:-1], 4, 4))
    T[..., :3, :3] = box_rotation(orientation, given)
    T[..., :3, 3] = given[..., :3]
    T[..., 3, 3] = 1.0
    return T


def pose_matrix(xyz: ArrayLike, rpy: ArrayLike) -> Array:
    """Compute the transform (4, 4) of a position and an orientation.

    Args:
        xyz: (3,) position [m].
        rpy: (3,) roll, pitch, yaw [rad].
    """
    return transform(rotation_from_rpy(rpy), xyz)


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Build the transform (4, 4) of a rotation (3, 3) and a translation (3,) [m]."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def axes_with_z(axis: Array) -> Array:
    """Compute a rotation (3, 3) whose third column is the unit vector `axis` (3,). The other two
    columns are an arbitrary choice."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])


def inverse(T_a_b: Array) -> Array:
    """Invert a rigid transform T_a_b (4, 4): return T_b_a, computed with the transposed
    rotation."""
    rotation = T_a_b[:3, :3].T
    return transform(rotation, -rotation @ T_a_b[:3, 3])


def skew(vector: ArrayLike) -> Array:
    """Return the matrix (3, 3) of the cross product with a vector (3,): skew(a) @ b = a x b."""
    x, y, z = np.asarray(vector, dtype=float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
