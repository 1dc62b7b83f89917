"""The decision vector: the free waypoints of a task's path, one after the other.

The free values of the redundant joints follow them, joint by joint; under the time law 'optimal'
the force limit [N] is the last.

The only place that puts them into the path, and takes them out, as numbers; as expressions it is
`symbolic.physics.path.waypoint_matrix` and `redundant_matrix`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from symbolic.array import Array
from symbolic.workcell.orientation import Orientation
from symbolic.workcell.records import POSE_SIZE as POSE_SIZE
from symbolic.workcell.records import Task


def components(orientation: Orientation) -> tuple[str, ...]:
    """What the numbers of a pose are called [m, rad]."""
    return ("x", "y", "z", *orientation.components)


def waypoints_of(task: Task, x: Array) -> Array:
    """All waypoints (n_waypoints, 6) of a decision vector (n_var,), angles unwrapped."""
    return extended_waypoints(task, x)[:, :POSE_SIZE]


def extended_waypoints(task: Task, x: Array) -> Array:
    """All waypoints (n_waypoints, 6 + m) of a decision vector (n_var,), the values of the redundant
    joints beside the poses."""
    points = np.array([waypoint.lower for waypoint in task.waypoints])
    points = np.column_stack([points, *[joint.lower for joint in task.redundant]])
    points[task.free_entries] = x[: task.n_path]
    points[:, 3:POSE_SIZE] = task.orientation.unwrapped(points[:, 3:POSE_SIZE])
    return points


def place_redundant(task: Task, extended: Array, joints: Sequence[Array]) -> None:
    """Put both arms' redundant joints, (n, joints) each and changed in place, where the extended
    poses (n, 6 + m) say."""
    for arm, q in enumerate(joints):
        for joint, place in task.redundant_of(arm):
            q[:, joint] = extended[:, place]


def decision_of(task: Task, waypoints: Array) -> Array:
    """The decision vector (n_var,) of all waypoints (n_waypoints, 6 + m); a force limit at its
    upper bound."""
    path = np.array(waypoints[task.free_entries], dtype=float)
    return np.append(path, task.force_limit[1]) if task.time_law == "optimal" else path


def initial_decision(task: Task) -> Array:
    """The decision vector (n_var,) of the hand-made trajectory, a force limit at its upper
    bound."""
    points = np.array([waypoint.lower for waypoint in task.waypoints])
    points[list(task.free_indices)] = task.initial
    return decision_of(task, _beside_initial(task, points))


def _beside_initial(task: Task, poses: Array) -> Array:
    return np.column_stack([poses, *[joint.initial for joint in task.redundant]])


def straight_line(task: Task) -> Array:
    """(n_var,) free waypoints evenly spaced on the straight lines between the fixed ones, the
    redundant joints as in the hand-made trajectory."""
    fixed = [i for i, waypoint in enumerate(task.waypoints) if waypoint.is_fixed]
    poses = np.array([waypoint.lower for waypoint in task.waypoints])
    numbers = np.arange(len(task.waypoints))
    line = [np.interp(numbers, fixed, poses[fixed, k]) for k in range(POSE_SIZE)]
    return decision_of(task, _beside_initial(task, np.column_stack(line)))


def variable_names(task: Task) -> tuple[str, ...]:
    """What the decision variables (n_var,) are; waypoints count from 1, the start is none."""
    names = [*components(task.orientation), *(joint.name for joint in task.redundant)]
    rows, columns = task.free_entries
    found = [f"waypoint {row}, {names[column]}" for row, column in zip(rows, columns, strict=True)]
    return tuple(found + ["force limit"] * (task.n_var - task.n_path))
