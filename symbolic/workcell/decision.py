"""The decision vector: the free waypoints of a task's path, one after the other.

Under the time law 'optimal' the force limit [N] follows them.

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
    points[list(task.free_indices)] = np.reshape(x[: task.n_path], (-1, POSE_SIZE))
    points[:, 3:] = np.unwrap(points[:, 3:], axis=0)
    return points


def decision_of(task: Task, waypoints: Array) -> Array:
    """The decision vector (n_var,) of all waypoints (n_waypoints, 6); a force limit at its upper
    bound."""
    return _with_force(task, waypoints[list(task.free_indices)])


def initial_decision(task: Task) -> Array:
    """The decision vector (n_var,) of the hand-made trajectory, a force limit at its upper
    bound."""
    return _with_force(task, task.initial)


def _with_force(task: Task, free: Array) -> Array:
    path = np.array(free, dtype=float).reshape(-1)
    return np.append(path, task.force_limit[1]) if task.time_law == "optimal" else path


def straight_line(task: Task) -> Array:
    """(n_var,) free waypoints evenly spaced on the straight lines between the fixed ones."""
    fixed = [i for i, waypoint in enumerate(task.waypoints) if waypoint.is_fixed]
    poses = np.array([waypoint.lower for waypoint in task.waypoints])
    numbers = np.arange(len(task.waypoints))
    line = [np.interp(numbers, fixed, poses[fixed, k]) for k in range(POSE_SIZE)]
    return decision_of(task, np.column_stack(line))
