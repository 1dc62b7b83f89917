"""The decision vector: the free waypoints of a task's path, one after the other.

The only place that puts them into the path, and takes them out, as numbers; as expressions it is
`symbolic.physics.path.waypoint_matrix`.
"""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.workcell.records import Task

POSE_SIZE = 6
"""x, y, z [m], roll, pitch, yaw [rad]."""


def waypoints_of(task: Task, x: Array) -> Array:
    """All waypoints (n_waypoints, 6) of a decision vector (n_var,), angles unwrapped."""
    points = np.array([waypoint.lower for waypoint in task.waypoints])
    points[list(task.free_indices)] = np.reshape(x, (-1, POSE_SIZE))
    points[:, 3:] = np.unwrap(points[:, 3:], axis=0)
    return points


def decision_of(task: Task, waypoints: Array) -> Array:
    """The decision vector (n_var,) of all waypoints (n_waypoints, 6)."""
    return np.asarray(waypoints[list(task.free_indices)], dtype=float).reshape(-1)


def initial_decision(task: Task) -> Array:
    """The decision vector (n_var,) of the hand-made trajectory."""
    return np.array(task.initial, dtype=float).reshape(-1)


def straight_line(task: Task) -> Array:
    """(n_var,) free waypoints evenly spaced on the straight lines between the fixed ones."""
    fixed = [i for i, waypoint in enumerate(task.waypoints) if waypoint.is_fixed]
    poses = np.array([waypoint.lower for waypoint in task.waypoints])
    numbers = np.arange(len(task.waypoints))
    line = [np.interp(numbers, fixed, poses[fixed, k]) for k in range(POSE_SIZE)]
    return decision_of(task, np.column_stack(line))
