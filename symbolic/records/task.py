"""The task of a carry, and its decision vector.

The decision vector holds the free waypoints of a task's path in order, then the free values of the
redundant joints, joint by joint; in drivable cells the force limit [N] is the last entry.
`symbolic.path.spline` computes the waypoints of a decision vector.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array, BroadcastScalar, Pair, Range
from symbolic.records import quantities as quantity
from symbolic.records.poses import Orientation
from symbolic.records.problems import Label
from symbolic.records.time_law import CONSTANT, TIME_LAWS, TimeLaw

POSE_SIZE = 6
"""Number of entries of a pose: x, y, z [m] and three numbers of the orientation [rad]
(`symbolic.records.poses`)."""


@dataclass(frozen=True)
class Waypoint:
    """A pose of the box path: fixed if lower equals upper, otherwise free between them.

    Attributes:
        lower, upper: (6,) bounds of the pose [m, rad].
    """

    lower: Array
    upper: Array

    @property
    def is_fixed(self) -> bool:
        """True if the task fixes this pose."""
        return bool(np.all(self.lower == self.upper))


@dataclass(frozen=True)
class RedundantJoint:
    """A joint beyond the six joints of an arm that follow the box. Its path is part of the decision
    vector: a spline, like the box path, through values at the waypoints.

    A joint of a machine that moves both arms is one redundant joint, not two.

    Attributes:
        name: robot and joint, such as 'north/panda_joint3'.
        drives: for each robot the index of the joint among the arm's joints; -1 if the arm does not
            have it.
        lower, upper: (n_waypoints,) bounds at the waypoints [rad or m]; equal at waypoints where
            the joint is fixed.
        initial: (n_waypoints,) values in the hand-made trajectory [rad or m].
    """

    name: str
    drives: tuple[int, int]
    lower: Array
    upper: Array
    initial: Array

    @property
    def is_common(self) -> bool:
        """True if the joint moves both arms."""
        return min(self.drives) >= 0

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(n_waypoints,) True where the joint position is a decision variable, False where it is
        fixed."""
        return np.asarray(self.lower < self.upper)


@dataclass(frozen=True)
class AllowedContact:
    """Permission for the payload to touch a named body of the environment near fixed waypoints.

    The permission holds near each fixed waypoint at which the payload touches the body, up to the
    collision tolerance.

    Attributes:
        body: name of the body.
        departure: largest distance of the box centre from the fixed waypoint at which contact is
            allowed [m].
    """

    body: Label
    departure: Annotated[float, quantity.DEPARTURE]


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """The box path to plan, its sampling, and the settings of forces and time. Two records are
    equal only if they are the same object, so that results can be cached by task.

    Attributes:
        waypoints: poses of the path in order; the first and the last are fixed.
        samples: number of samples along the path, ends included.
        time_law: name of the time law (`symbolic.records.time_law`).
        reference_speed: speed of the box centre, with ramps the speed between them [m/s].
        reference_angular_speed: angular speed of steps that mostly rotate the box [rad/s].
        ramp_time: duration of each ramp, if the time law has ramps [s].
        reference_force: (2,) force by which each robot's normal force is divided in objectives [N].
        initial: (n_free, 6) free waypoints of the hand-made trajectory [m, rad].
        allowed_contacts: contacts of the payload that do not count as collisions.
        allocation: name of the contact model (`symbolic.contact.registry`).
        force_limit: lower and upper bound of the force limit, the last decision variable of
            drivable carries [N].
        redundant: joints whose paths are part of the decision vector.
        orientation: convention of the last three numbers of every pose.
        pieces: number of pieces of the path between two waypoints of the file
            (`symbolic.path.spline.refined_task`).
    """

    waypoints: tuple[Waypoint, ...]
    samples: Annotated[int, Range(5, 2_000)] = 100
    time_law: str = CONSTANT
    reference_speed: Annotated[float, quantity.SPEED]
    reference_angular_speed: Annotated[float, quantity.ANGULAR_SPEED] = 0.5
    ramp_time: Annotated[float, quantity.DURATION] = 0.5
    reference_force: Annotated[Pair, quantity.FORCE, BroadcastScalar()]
    initial: Array
    allowed_contacts: tuple[AllowedContact, ...] = ()
    allocation: str = "paper"
    force_limit: tuple[float, float] = (0.0, np.inf)
    redundant: tuple[RedundantJoint, ...] = ()
    orientation: Orientation = field(default_factory=Orientation)
    pieces: int = 1

    @cached_property
    def pose_names(self) -> tuple[str, ...]:
        """Names of the six entries of a pose in the task's orientation convention."""
        return ("x", "y", "z", *self.orientation.components)

    @cached_property
    def extended_size(self) -> int:
        """Number of entries of an extended pose: the box pose, then the redundant joints."""
        return POSE_SIZE + len(self.redundant)

    @cached_property
    def redundant_entries(self) -> tuple[tuple[tuple[int, int], ...], ...]:
        """For each robot its redundant joints, each as a pair: index among the arm's joints, and
        index in the extended pose (6 + m,)."""
        return tuple(
            tuple(
                (joint.drives[arm], POSE_SIZE + k)
                for k, joint in enumerate(self.redundant)
                if joint.drives[arm] >= 0
            )
            for arm in (0, 1)
        )

    @cached_property
    def free_indices(self) -> tuple[int, ...]:
        """Indices of the free waypoints in `waypoints`."""
        return tuple(i for i, w in enumerate(self.waypoints) if not w.is_fixed)

    @cached_property
    def n_path(self) -> int:
        """Number of variables of the path: six per free waypoint (paper Eq. 14), then the free
        positions of the redundant joints, joint by joint."""
        return len(self.free_entries[0])

    @cached_property
    def n_box(self) -> int:
        """Number of variables of the box path: six per free waypoint. They come first in the
        decision vector."""
        return POSE_SIZE * len(self.free_indices)

    @cached_property
    def free_entries(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row and column (n_path,) of each path variable in the matrix of the extended waypoints
        (n_waypoints, 6 + m): one row per waypoint, with pose and redundant joints as columns."""
        free = np.array(self.free_indices, dtype=np.intp)
        rows, columns = [np.repeat(free, POSE_SIZE)], [np.tile(np.arange(POSE_SIZE), len(free))]
        for k, joint in enumerate(self.redundant):
            moving = np.flatnonzero(joint.moving)
            rows.append(moving)
            columns.append(np.full(len(moving), POSE_SIZE + k))
        found = np.concatenate(rows), np.concatenate(columns)
        for part in found:  # every caller gets the same
            part.flags.writeable = False
        return found

    @cached_property
    def initial_time(self) -> float:
        """Duration of the hand-made trajectory on straight lines between its waypoints, at the
        reference speeds [s]."""
        points = self.fixed_waypoints[:, :POSE_SIZE].copy()
        points[list(self.free_indices)] = self.initial
        points[:, 3:] = self.orientation.unwrapped(points[:, 3:])
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps[:, :3], axis=1) / self.reference_speed
        turns = np.linalg.norm(steps[:, 3:], axis=1) / self.reference_angular_speed
        return float(np.maximum(lengths, turns).sum())

    @cached_property
    def fixed_waypoints(self) -> Array:
        """(n_waypoints, 6 + m) poses and redundant joints at all waypoints [m, rad]. Entries that
        are decision variables have their lower bounds here. The array is read-only."""
        poses = np.array([waypoint.lower for waypoint in self.waypoints])
        points = np.column_stack([poses, *[joint.lower for joint in self.redundant]])
        points.flags.writeable = False
        return points

    @cached_property
    def law(self) -> TimeLaw:
        """Record of the time law that `time_law` names."""
        return TIME_LAWS[self.time_law]

    @cached_property
    def n_var(self) -> int:
        """Number of decision variables: those of the path and, in drivable cells, the force
        limit."""
        return self.n_path + self.law.is_drivable

    @cached_property
    def lower(self) -> Array:
        """(n_var,) lower bounds of the decision vector; read-only."""
        return self._bounds("lower", self.force_limit[0])

    @cached_property
    def upper(self) -> Array:
        """(n_var,) upper bounds of the decision vector; read-only."""
        return self._bounds("upper", self.force_limit[1])

    def _bounds(self, name: str, force: float) -> Array:
        parts = [getattr(self.waypoints[i], name) for i in self.free_indices]
        parts += [getattr(joint, name)[joint.moving] for joint in self.redundant]
        bounds = np.concatenate(parts + ([np.array([force])] if self.law.is_drivable else []))
        bounds.flags.writeable = False
        return bounds


# --- the decision vector ---


def decision_of(task: Task, waypoints: Array) -> Array:
    """Return the decision vector (n_var,) of a path through given waypoints. In drivable cells its
    force limit is the upper bound.

    Args:
        task: the task.
        waypoints: (n_waypoints, 6 + m) box poses and redundant joints at all waypoints.
    """
    path = np.array(waypoints[task.free_entries], dtype=float)
    return np.append(path, task.force_limit[1]) if task.law.is_drivable else path


def initial_decision(task: Task) -> Array:
    """Return the decision vector (n_var,) of the hand-made trajectory. In drivable cells its force
    limit is the upper bound."""
    points = np.array([waypoint.lower for waypoint in task.waypoints])
    points[list(task.free_indices)] = task.initial
    return decision_of(task, _beside_initial(task, points))


def _beside_initial(task: Task, poses: Array) -> Array:
    return np.column_stack([poses, *[joint.initial for joint in task.redundant]])


def straight_line(task: Task) -> Array:
    """Return the decision vector (n_var,) of a path with free waypoints evenly spaced on straight
    lines between the fixed waypoints.

    Redundant joints have the values of the hand-made trajectory. In drivable cells the force limit
    is the upper bound.
    """
    fixed = [i for i, waypoint in enumerate(task.waypoints) if waypoint.is_fixed]
    poses = np.array([waypoint.lower for waypoint in task.waypoints])
    numbers = np.arange(len(task.waypoints))
    line = [np.interp(numbers, fixed, poses[fixed, k]) for k in range(POSE_SIZE)]
    return decision_of(task, _beside_initial(task, np.column_stack(line)))


def variable_names(task: Task) -> tuple[str, ...]:
    """Return a name for each of the n_var decision variables, such as 'waypoint 1, x'. The start is
    waypoint 0."""
    names = [*task.pose_names, *(joint.name for joint in task.redundant)]
    rows, columns = task.free_entries
    found = [f"waypoint {row}, {names[column]}" for row, column in zip(rows, columns, strict=True)]
    return tuple(found + ["force limit"] * (task.n_var - task.n_path))
