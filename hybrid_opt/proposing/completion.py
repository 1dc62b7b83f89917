"""What is found for a problem, and the tables of the workcell file that say so."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hybrid_opt.proposing.bounds import Bounds
from hybrid_opt.proposing.document import merged
from hybrid_opt.proposing.problem import Problem
from symbolic.array import Array
from symbolic.records import POSE_SIZE, Workcell

UNIT = np.array([0.10, 0.10, 0.10, 0.08, 0.08, 0.08])
"""Half-widths of a pose that are scaled together [m, rad]."""

REDUNDANT_UNIT = 0.15
"""Half-width of a redundant joint's value [rad or m]."""

LIMITS = np.array([10.0, 10.0, 10.0, 3.14, 1.57, 3.14])
"""Beyond which no pose of a workcell file may be, or should need to be (angles) [m, rad]."""

ROOM = 0.5
"""What angles may vary by where a carry itself is beyond these [rad]."""

ANGLE_LIMIT = 6.28
"""Beyond which no angle of a workcell file may be [rad]."""

VECTOR_LIMIT = 4.99
"""The same of a rotation vector's length [rad]."""

DRAFTED = 0.01
"""Half-width of bounds that nothing is known of yet [m, rad]."""


@dataclass(frozen=True, eq=False)
class Found:
    """What was found.

    Attributes:
        workcell: the cell that it was found in, with its redundant joints chosen.
        spins: of both pads, beside those of the file [rad].
        branches: of both robots, -1 where they are not known yet.
        waypoints: (n, 6 + m) extended poses, start and goal included.
        given: what was added to the problem's tables before, such as bases.
        bounds: of the decision vector, None where they are not known yet.
    """

    workcell: Workcell
    spins: tuple[float, float]
    branches: tuple[int, int]
    waypoints: Array
    given: dict[str, Any] = field(default_factory=dict)
    bounds: Bounds | None = None

    @property
    def via(self) -> Array:
        """(n - 2, 6) poses between start and goal."""
        return self.waypoints[1:-1, :POSE_SIZE]

    def around(self, centre: Array) -> Found:
        """The same with another decision vector as its carry."""
        m = len(self.workcell.task.redundant)
        return replace(self, waypoints=_as_waypoints(centre, self.waypoints, m))


def changes(problem: Problem, found: Found) -> dict[str, Any]:
    """What completes the problem's tables."""
    lower, upper = _boxes(found)
    task: dict[str, Any] = {
        "initial": _plain(found.via),
        "waypoints": [
            {"lower": _plain(low), "upper": _plain(high)}
            for low, high in zip(lower[1:-1, :6], upper[1:-1, :6], strict=True)
        ],
    }
    if found.workcell.task.redundant:
        task["redundant"] = [
            {
                "joint": joint.name,
                "initial": _plain(found.waypoints[:, POSE_SIZE + k]),
                "lower": _plain(lower[:, POSE_SIZE + k]),
                "upper": _plain(upper[:, POSE_SIZE + k]),
            }
            for k, joint in enumerate(found.workcell.task.redundant)
        ]
    robots: list[dict[str, Any]] = []
    contacts: list[dict[str, Any]] = []
    for i, robot in enumerate(found.workcell.robots):
        entry: dict[str, Any] = {"start_branch": found.branches[i]}
        if robot.redundant_joints:
            entry["redundant_joints"] = list(robot.redundant_joints)
        robots.append(entry)
        spin = float(problem.data["contacts"][i].get("spin", 0.0)) + found.spins[i]
        contacts.append(
            {
                **found.given.get("contacts", problem.contacts)[i],
                "spin": round(float(np.remainder(spin + np.pi, 2 * np.pi) - np.pi), 9),
            }
        )
    whole: dict[str, Any] = merged(
        found.given, {"robots": robots, "contacts": contacts, "task": task}
    )
    return whole


def decision_bounds(workcell: Workcell) -> tuple[Array, Array]:
    """Half-widths (n_var,) that are scaled together, and limits (2, n_var) of bounds around the
    workcell's hand-made trajectory."""
    task, n = workcell.task, len(workcell.task.waypoints)
    unit = [np.tile(UNIT, len(task.free_indices))]
    least, most = [], []
    for pose in task.initial:
        low, high = _pose_limits(pose, task.orientation.is_vector)
        least.append(low)
        most.append(high)
    for joint in task.redundant:
        arm = 0 if joint.drives[0] >= 0 else 1
        robot, index = workcell.robots[arm], joint.drives[arm]
        unit.append(np.full(n, REDUNDANT_UNIT))
        # Rounded inwards, because the file holds four decimals.
        least.append(np.full(n, np.ceil(1e4 * robot.position_lower[index]) / 1e4))
        most.append(np.full(n, np.floor(1e4 * robot.position_upper[index]) / 1e4))
    return np.concatenate(unit), np.array([np.concatenate(least), np.concatenate(most)])


def _pose_limits(pose: Array, is_vector: bool) -> tuple[Array, Array]:
    """Limits (6,) of bounds around a pose (6,), which lies between them."""
    low, high = -LIMITS, LIMITS.copy()
    if is_vector:  # the farthest corner of such a cube is no longer than allowed
        room = max((VECTOR_LIMIT - np.linalg.norm(pose[3:])) / np.sqrt(3.0), 1e-3)
        low[3:], high[3:] = pose[3:] - room, pose[3:] + room
        return low, high
    low[3:] = np.maximum(np.minimum(low[3:], pose[3:] - ROOM), -ANGLE_LIMIT)
    high[3:] = np.minimum(np.maximum(high[3:], pose[3:] + ROOM), ANGLE_LIMIT)
    return low, high


def _boxes(found: Found) -> tuple[Array, Array]:
    """Bounds (n, 6 + m) of the waypoints."""
    if found.bounds is None:
        return found.waypoints - DRAFTED, found.waypoints + DRAFTED
    m = len(found.workcell.task.redundant)
    # Bounds go outwards where they are rounded, so that the carry stays inside.
    lower = _as_waypoints(np.floor(1e4 * found.bounds.lower) / 1e4, found.waypoints, m)
    upper = _as_waypoints(np.ceil(1e4 * found.bounds.upper) / 1e4, found.waypoints, m)
    return lower, upper


def _as_waypoints(x: Array, waypoints: Array, m: int) -> Array:
    """Extended waypoints (n, 6 + m) of a decision vector in which all between the ends, and all
    values of redundant joints, are free."""
    n = len(waypoints)
    placed = waypoints.copy()
    placed[1:-1, :POSE_SIZE] = x[: POSE_SIZE * (n - 2)].reshape(n - 2, POSE_SIZE)
    placed[:, POSE_SIZE:] = x[POSE_SIZE * (n - 2) :].reshape(m, n).T
    return placed


def _plain(values: Array) -> Any:
    """As lists of numbers, to a hundredth of a millimetre."""
    return np.round(values, 5).tolist()
