"""A found path, and the changes to a problem file that describe it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hybrid_opt.extras.proposing.bounds import Bounds
from hybrid_opt.extras.proposing.decimals import (
    joint_limits,
    limits_around,
    pose_limits,
    readable_turns,
    rounded_outwards,
)
from hybrid_opt.extras.proposing.hand_positions import contact_entry
from hybrid_opt.extras.proposing.kinematics import rotate_about_normal
from hybrid_opt.extras.proposing.problem import DRAFT_ROOM, Problem
from symbolic.array import Array
from symbolic.read.editing import merged
from symbolic.records import POSE_SIZE, Workcell

UNIT = np.array([0.10, 0.10, 0.10, 0.08, 0.08, 0.08])
"""Half-widths of a pose's bounds, which share one factor [m, rad]."""

REDUNDANT_UNIT = 0.15
"""Half-width of the bounds of a redundant joint, for the same factor [rad or m]."""

CARRY_DECIMALS = 5
"""Decimals of a carry in a file [m, rad]: a hundredth of a millimetre."""


@dataclass(frozen=True, eq=False)
class Draft:
    """A path found for the box, with the cell in which it was found.

    Attributes:
        workcell: the cell, with its redundant joints chosen.
        spins: rotation of each robot's pad about its normal, in addition to the one in the file
            [rad].
        branches: start branch of each robot, -1 if not known yet.
        waypoints: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m],
            start and goal included.
        given: additions to the problem's tables that were chosen before, such as bases.
        bounds: bounds of the decision vector; None if not known yet.
        stand_off: proposed stand-off of the pads [m]; None if the usual one is free, or if no tried
            one is.
    """

    workcell: Workcell
    spins: tuple[float, float]
    branches: tuple[int, int]
    waypoints: Array
    given: dict[str, Any] = field(default_factory=dict)
    bounds: Bounds | None = None
    stand_off: float | None = None

    @property
    def via(self) -> Array:
        """(n - 2, 6) box poses of the waypoints between start and goal [m, rad]."""
        return self.waypoints[1:-1, :POSE_SIZE]

    def around(self, centre: Array) -> Draft:
        """Return this draft with its inner box poses and all redundant joints replaced by those of
        a decision vector.

        Args:
            centre: (n_var,) decision vector [m, rad].
        """
        m = len(self.workcell.task.redundant)
        return replace(self, waypoints=_as_waypoints(centre, self.waypoints, m))


def changes(problem: Problem, found: Draft) -> dict[str, Any]:
    """Return the changes of a problem file that make it a workcell file with a found path.

    Args:
        problem: the problem.
        found: the path, with its cell.

    Returns:
        New keys and values by name of the table: of `task`, `robots` and `contacts`, of `handling`
        if a stand-off is proposed, and those that the search chose earlier, such as bases.
    """
    poses = readable_turns(found.waypoints[:, :POSE_SIZE], found.workcell.task.orientation)
    waypoints = np.hstack([poses, found.waypoints[:, POSE_SIZE:]])
    lower, upper = _boxes(found, waypoints)
    task: dict[str, Any] = {
        "initial": _plain(np.round(poses[1:-1], CARRY_DECIMALS)),
        "waypoints": [
            {"lower": _plain(low), "upper": _plain(high)}
            for low, high in zip(lower[1:-1, :6], upper[1:-1, :6], strict=True)
        ],
    }
    if found.workcell.task.redundant:
        task["redundant"] = [
            {
                "joint": joint.name,
                "initial": _plain(np.round(waypoints[:, POSE_SIZE + k], CARRY_DECIMALS)),
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
        entry = found.given.get("contacts", problem.contacts)[i]
        contact = found.workcell.contacts[i]
        if contact.further and found.spins[i]:
            with_normals = "normal" in problem.data["contacts"][i]
            entry = contact_entry(rotate_about_normal(contact, found.spins[i]), with_normals)
        else:
            spin = entry.get("spin", problem.data["contacts"][i].get("spin", 0.0)) + found.spins[i]
            turn = float(np.remainder(spin + np.pi, 2 * np.pi) - np.pi)
            entry = {**entry, "spin": round(turn, 9)}
        contacts.append(entry)
    chosen: dict[str, Any] = {"robots": robots, "contacts": contacts, "task": task}
    if found.stand_off is not None:
        chosen["handling"] = {"stand_off": found.stand_off}
    whole: dict[str, Any] = merged(found.given, chosen)
    return whole


def decision_bounds(workcell: Workcell) -> tuple[Array, Array]:
    """Return typical widths, and limits, of the bounds of the decision vector.

    Args:
        workcell: the cell, with the hand-made trajectory.

    Returns:
        - Half-widths (n_var,) of bounds [m, rad], which a search multiplies by one common factor.
        - Limits (2, n_var) of bounds [m, rad]: the smallest lower and the largest upper bounds.
    """
    task, n = workcell.task, len(workcell.task.waypoints)
    poses = [pose_limits(pose, task.orientation) for pose in task.initial]
    joints = np.repeat(joint_limits(workcell), n, axis=1)
    unit = [np.tile(UNIT, len(poses)), np.full(joints.shape[1], REDUNDANT_UNIT)]
    return np.concatenate(unit), np.hstack([*poses, joints])


def _boxes(found: Draft, waypoints: Array) -> Array:
    """Compute the bounds of waypoints, rounded outwards to the decimals of a file.

    Args:
        found: the draft. If it has no bounds, the bounds of each waypoint are at the fixed distance
            `DRAFT_ROOM` from it.
        waypoints: (n, 6 + m) box poses [m, rad] and m redundant joints [rad or m].

    Returns:
        (2, n, 6 + m) lower and upper bounds.
    """
    bounds = np.array([waypoints - DRAFT_ROOM, waypoints + DRAFT_ROOM])
    if found.bounds is not None:
        both, m = (found.bounds.lower, found.bounds.upper), len(found.workcell.task.redundant)
        bounds = np.array([_as_waypoints(side, waypoints, m) for side in both])
    return rounded_outwards(bounds, limits_around(found.workcell, waypoints))


def _as_waypoints(x: Array, waypoints: Array, m: int) -> Array:
    """Put a decision vector into given waypoints.

    Its values replace the inner box poses and all redundant joints.

    Args:
        x: (n_var,) decision vector [m, rad].
        waypoints: (n, 6 + m) given waypoints, whose first and last box poses are kept [m, rad].
        m: number of redundant joints.

    Returns:
        (n, 6 + m) waypoints.
    """
    n = len(waypoints)
    placed = waypoints.copy()
    placed[1:-1, :POSE_SIZE] = x[: POSE_SIZE * (n - 2)].reshape(n - 2, POSE_SIZE)
    placed[:, POSE_SIZE:] = x[POSE_SIZE * (n - 2) :].reshape(m, n).T
    return placed


def _plain(values: Array) -> Any:
    """Convert an array to nested lists of numbers, with 0.0 in place of -0.0."""
    return (values + 0.0).tolist()
