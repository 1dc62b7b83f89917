"""Decimal numbers for proposed files: rounded outwards, within the limits of the reader."""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.read.task import MOST_TURN
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.poses import Orientation

RECIPROCAL_UNIT = 1e4
"""Reciprocal of the unit to which bounds are rounded [1/m, 1/rad]."""

COUNTED_DECIMALS = 6
"""Decimals of a number in these units that count; further decimals are rounding."""

USUAL_POSE = np.array([10.0, 10.0, 10.0, 3.14, 1.57, 3.14])
"""Limits of a pose that never need to be exceeded: the file's limits for positions, one turn for
angles [m, rad]."""

ANGLE_ROOM = 0.5
"""Range of angles about a carry that exceeds `USUAL_POSE` [rad]."""

ANGLE_LIMIT = 6.28
"""Largest angle of a bound [rad]; a file allows a full turn."""

VECTOR_LIMIT = MOST_TURN - 0.01
"""Largest rotation vector of a bound [rad], unless the carry has a larger one."""

LEAST_ROOM = 1e-3
"""Range about a rotation vector at its limit, towards zero [rad]."""


def pose_limits(pose: Array, orientation: Orientation) -> Array:
    """Compute limits (2, 6) [m, rad] that bounds around a box pose must not exceed. The pose itself
    is within them.

    Args:
        pose: (6,) box pose [m, rad].
        orientation: convention of the last three numbers of the pose.
    """
    high = USUAL_POSE.copy()
    low = -high
    if orientation.is_vector:  # the farthest corner of such a cube is no longer than allowed
        vector = pose[3:]
        room = max((VECTOR_LIMIT - float(np.linalg.norm(vector))) / np.sqrt(3.0), 0.0)
        inwards = np.maximum(room, np.minimum(LEAST_ROOM, np.abs(vector)))
        low[3:] = vector - np.where(vector > 0.0, inwards, room)
        high[3:] = vector + np.where(vector < 0.0, inwards, room)
        return np.array([low, high])
    low[3:] = np.maximum(np.minimum(low[3:], pose[3:] - ANGLE_ROOM), -ANGLE_LIMIT)
    high[3:] = np.minimum(np.maximum(high[3:], pose[3:] + ANGLE_ROOM), ANGLE_LIMIT)
    return np.array([np.minimum(low, pose), np.maximum(high, pose)])


def joint_limits(workcell: Workcell) -> Array:
    """Return the lower and upper limits (2, m) of a cell's m redundant joints [rad or m]. A joint
    that moves both arms has the narrower limits of both robots.

    Args:
        workcell: the cell, whose task names the redundant joints.
    """
    found = []
    for joint in workcell.task.redundant:
        driven = [
            (robot.position_lower[index], robot.position_upper[index])
            for robot, index in zip(workcell.robots, joint.drives, strict=True)
            if index >= 0
        ]
        found.append((max(low for low, _ in driven), min(high for _, high in driven)))
    return np.reshape(found, (-1, 2)).T


def limits_around(workcell: Workcell, waypoints: Array) -> Array:
    """Compute limits that bounds around waypoints must not exceed.

    Args:
        workcell: the cell.
        waypoints: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].

    Returns:
        (2, n, 6 + m) lower and upper limits.
    """
    orientation, joints = workcell.task.orientation, joint_limits(workcell)
    return np.array(
        [np.hstack([pose_limits(row[:POSE_SIZE], orientation), joints]) for row in waypoints]
    ).swapaxes(0, 1)


def rounded_outwards(bounds: Array, limits: Array) -> Array:
    """Round bounds to the decimals of a file: lower bounds down and upper bounds up, but not beyond
    limits.

    A bound that already has these decimals stays unchanged. Errors of floating-point products, such
    as 1e4 times 2.8065 = 28065.000000000004, are removed before the bound is rounded.

    Args:
        bounds: (2, ...) lower and upper bounds [m, rad].
        limits: (2, ...) smallest lower and largest upper bounds, of the same shape.

    Returns:
        (2, ...) rounded bounds.
    """
    low, high = np.round(RECIPROCAL_UNIT * bounds, COUNTED_DECIMALS)
    return np.array(
        [
            np.maximum(np.floor(low) / RECIPROCAL_UNIT, limits[0]),
            np.minimum(np.ceil(high) / RECIPROCAL_UNIT, limits[1]),
        ]
    )


def readable_turns(poses: Array, orientation: Orientation) -> Array:
    """Subtract full turns from the angles of box poses that exceed `ANGLE_LIMIT`, the largest angle
    that a workcell file may state.

    Rotation vectors stay unchanged. Whoever reads the workcell file unwraps angles along the path,
    so the path stays the same.

    Args:
        poses: (n, 6) box poses [m, rad].
        orientation: convention of the last three numbers of a pose.

    Returns:
        (n, 6) box poses [m, rad].
    """
    if orientation.is_vector:
        return poses
    found = poses.copy()
    beyond = np.abs(poses[:, 3:]) > ANGLE_LIMIT
    turns = np.round(poses[:, 3:] / (2.0 * np.pi))
    found[:, 3:] -= np.where(beyond, 2.0 * np.pi * turns, 0.0)
    return found
