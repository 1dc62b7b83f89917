"""The problem file: a workcell file in which a person has left out what is to be proposed; and what
completes it."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.proposing.bounds import Bounds
from hybrid_opt.proposing.holding import shoulders
from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.descriptions import PACKAGE_SCHEME
from symbolic.read.editing import completed, merged, with_paths
from symbolic.read.robots import read_robot
from symbolic.read.tables import Table
from symbolic.records import POSE_SIZE, Robot, Workcell
from symbolic.records import quantities as quantity
from symbolic.records.poses import Orientation, box_placement, rotation_from_rpy
from symbolic.records.problems import Problems

UPRIGHT = 0.7
"""Share of the vertical from which on an edge of the box counts as upright."""

LEAST_LEVEL = 0.1
"""How far a carry goes level, at least, for its direction to count [m]."""

PROPOSED = ("waypoints", "initial", "redundant")
"""Keys of the task that are proposed anew, whatever the file has."""

REACH_OF_DRAFT = 0.01
"""How far beside start and goal the one free waypoint of a draft may be [m, rad]; of no meaning."""


@dataclass(frozen=True)
class Problem:
    """A problem file.

    Attributes:
        source: the file.
        text: its content, without what is proposed anew.
        data: its tables, without what is proposed anew.
    """

    source: Path
    text: str
    data: dict[str, Any]

    @property
    def poses(self) -> tuple[Array, Array]:
        """(6,) start and goal of the box, the goal's angles on the turns nearest the start's;
        rotation vectors as they are."""
        start, goal = (np.array(self.data["task"][key], dtype=float) for key in ("start", "goal"))
        goal[3:] = self.orientation.unwrapped(np.array([start[3:], goal[3:]]))[1]
        return start, goal

    @property
    def orientation(self) -> Orientation:
        """Meaning of the last three numbers of a pose."""
        task = self.data["task"]
        if task.get("rotation") != "quaternion":
            return Orientation()
        reference = rotation_from_rpy(task.get("rotation_reference", [0.0, 0.0, 0.0]))
        return Orientation("quaternion", reference)

    @property
    def is_machine(self) -> bool:
        """Whether both robots are arms of one machine: other chains of one file at one base, which
        may be missing."""
        first, second = self.data["robots"]
        keys = ("robot", "urdf", "xacro_arguments", "base")
        same = all(first.get(key) == second.get(key) for key in keys)
        chains = first.get("chain"), second.get("chain")
        return same and all(chains) and chains[0] != chains[1]

    @cached_property
    def contacts(self) -> list[dict[str, Any]]:
        """Both contacts' points, the middles of opposite faces where the file has none: those that
        face the robots (the shoulders of a machine with both arms), or those that the carry passes
        sideways where the robots have no bases.

        Raises:
            WorkcellError: shoulders are asked for, and the robots are wrong.
        """
        entries = self.data["contacts"]
        if all("xyz" in entry for entry in entries):
            return [{"xyz": entry["xyz"]} for entry in entries]
        found = [robot.get("base", {}).get("xyz") for robot in self.data["robots"]]
        known = all(isinstance(xyz, list) and len(xyz) == 3 for xyz in found)
        bases = np.array(found, dtype=float) if known else None
        if known and self.is_machine:
            bases = shoulders(self._robots())
        start, goal = self.poses
        size = np.array(self.data["payload"]["size"], dtype=float)
        R_world_box = box_placement(self.orientation, start)[:3, :3]
        points = contact_points(size, np.array([start, goal]), R_world_box, bases)
        return [{"xyz": point} for point in points]

    def _robots(self) -> tuple[Robot, Robot]:
        """The robots alone, wherever the box is."""
        problems = Problems()
        entries = Table(self.data, "", problems).tables("robots", exactly=2)
        found = [read_robot(entry, self.source.parent)[0] for entry in entries]
        if problems.found:
            raise WorkcellError(str(self.source), problems.messages())
        return found[0], found[1]

    def sides(self) -> list[Problem]:
        """The same problem with each pair of upright faces that the pads may press where its
        robots have no bases yet, a machine's arms either way round; itself alone where the file
        names the points, or a carry that goes level past two robots leaves no choice."""
        entries = self.data["contacts"]
        start, goal = self.poses
        level = float(np.linalg.norm((goal - start)[:2]))
        if all("xyz" in entry for entry in entries) or not (self.is_machine or level < LEAST_LEVEL):
            return [self]
        R = box_placement(self.orientation, start)[:3, :3]
        found = []
        for axis in np.flatnonzero(np.abs(R[2]) <= UPRIGHT):
            point = np.zeros(3)
            point[axis] = float(self.data["payload"]["size"][axis]) / 2.0
            for side in (1.0, -1.0) if self.is_machine else (1.0,):
                data = copy.deepcopy(self.data)
                for entry, xyz in zip(data["contacts"], (point, -point), strict=True):
                    entry["xyz"] = (side * xyz).tolist()
                found.append(replace(self, data=data))
        return found

    def workcell(self, changes: dict[str, Any] | None = None) -> Workcell:
        """The workcell with one free waypoint halfway where nothing else is said.

        Args:
            changes: as for `symbolic.read.editing.completed`.

        Raises:
            WorkcellError: with all problems of the file.
        """
        changes = merged({"contacts": self.contacts}, changes or {})
        task = dict(self.data["task"])
        if "waypoints" not in changes.get("task", {}):
            poses = np.array([task["start"], task["goal"]], dtype=float)
            task["waypoints"] = [
                {
                    "lower": (poses.min(axis=0) - REACH_OF_DRAFT).tolist(),
                    "upper": (poses.max(axis=0) + REACH_OF_DRAFT).tolist(),
                }
            ]
        text = completed("", self.data | {"task": task}, changes)
        return load(self.source, text=text.encode())

    def completed(self, changes: dict[str, Any], folder: Path) -> str:
        """The file's text, completed, for a folder that paths are then relative to.

        Args:
            changes: as for `symbolic.read.editing.completed`.

        Raises:
            SettingsError: the file is written in a way that cannot be completed.
        """
        here, there = self.source.parent, folder.resolve()

        def moved(name: str) -> str:
            is_relative = not os.path.isabs(name) and not name.startswith(PACKAGE_SCHEME)
            return os.path.relpath(here / name, there) if is_relative else name

        paths = {} if there == here else with_paths(self.data, moved)
        return completed(self.text, self.data, merged(paths, changes))


def read_problem(path: str | Path) -> Problem:
    """The problem of a file.

    Raises:
        WorkcellError: it is no TOML, or what has to be known is not there.
    """
    path = Path(path)
    try:
        source = outside.resolved(path)
        text = outside.text(outside.read_bytes(source, outside.WORKCELL_BYTES))
        data = outside.toml_tables(text.encode())
    except OutsideError as error:
        raise WorkcellError(str(path), (f"file: {error}",)) from error
    problems = Problems()
    _require_known(Table(data, "", problems))
    if problems.found:
        raise WorkcellError(str(path), problems.messages())
    text = completed(text, data, {"task": dict.fromkeys(PROPOSED)})
    for key in PROPOSED:
        data["task"].pop(key, None)
    return Problem(source, text, data)


def _require_known(table: Table) -> None:
    """Record what this module needs and lacks; the reader of workcell files checks the rest."""
    task, payload = table.table("task"), table.table("payload")
    _, contacts = (table.tables(key, exactly=2) for key in ("robots", "contacts"))
    if table.problems.found:
        return
    start, goal = (task.vector(key, quantity.POSE) for key in ("start", "goal"))
    if task.clean("start", "goal") and np.array_equal(start, goal):
        task.add("goal", "found the start again; allowed is another pose")
    task.vector("rotation_reference", (quantity.ANGLE,) * 3, (0.0, 0.0, 0.0))
    waypoints = task.raw("waypoints", [])
    if isinstance(waypoints, list) and any("fixed" in w for w in waypoints if isinstance(w, dict)):
        task.add(
            "waypoints",
            "found a fixed one; allowed is a carry from start to goal, put fixed poses into the "
            "proposed file",
        )
    if task.raw("time_law", None) == "optimal":
        task.add(
            "time_law",
            "found 'optimal'; allowed are 'constant' and 'ramped', change it in the proposed file",
        )
    if all("xyz" in entry for entry in contacts):
        return
    if payload.raw("kind", "box") != "box":
        table.add("contacts", "xyz is needed for a payload that is no box")
    else:
        payload.vector("size", (quantity.PAYLOAD_SIZE,) * 3)


def contact_points(
    size: Array, way: Array, R_world_box: Array, bases: Array | None
) -> list[list[float]]:
    """Middles of opposite faces of the box that face the robots, one per robot [m].

    Args:
        size: (3,) edges of the box [m].
        way: (2, 6) start and goal.
        R_world_box: (3, 3) at the start.
        bases: (2, 3) positions of the robots [m]; None: the faces that the carry passes sideways.
    """
    along = way[1, :3] - way[0, :3] if bases is None else bases[0] - bases[1]
    share = np.abs(R_world_box.T @ (along * [1.0, 1.0, 0.0]))
    upright = np.abs(R_world_box[2]) > UPRIGHT
    share[upright] = np.inf if bases is None else -1.0
    axis = int(np.argmin(share) if bases is None else np.argmax(share))
    side = 1.0 if bases is None else float(np.sign(along @ R_world_box[:, axis]) or 1.0)
    point = np.zeros(3)
    point[axis] = side * size[axis] / 2.0
    return [point.tolist(), (0.0 - point).tolist()]


UNIT = np.array([0.10, 0.10, 0.10, 0.08, 0.08, 0.08])
"""Half-widths of a pose that are scaled together [m, rad]."""

REDUNDANT_UNIT = 0.15
"""Half-width of a redundant joint's value [rad or m]."""

LIMITS = np.array([10.0, 10.0, 10.0, 3.14, 1.57, 3.14])
"""Limits of a pose in a workcell file; for angles, what none should need to exceed [m, rad]."""

ROOM = 0.5
"""Range by which angles may vary where a carry itself is beyond `LIMITS` [rad]."""

ANGLE_LIMIT = 6.28
"""Limit of every angle in a workcell file [rad]."""

VECTOR_LIMIT = 4.99
"""The same of a rotation vector's length [rad]."""

DRAFTED = 0.01
"""Half-width of bounds that nothing is known of yet [m, rad]."""


@dataclass(frozen=True, eq=False)
class Draft:
    """A path as found, and the cell it was found in.

    Attributes:
        workcell: the cell that it was found in, with its redundant joints chosen.
        spins: of both pads, beside those of the file [rad].
        branches: of both robots, -1 where they are not known yet.
        waypoints: (n, 6 + m) extended poses, start and goal included.
        given: what was added to the problem's tables before, such as bases.
        bounds: of the decision vector, None where they are not known yet.
        stand_off: of the pads [m]; None where the usual one is free, or none that was tried.
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
        """(n - 2, 6) poses between start and goal."""
        return self.waypoints[1:-1, :POSE_SIZE]

    def around(self, centre: Array) -> Draft:
        """The same with another decision vector as its carry."""
        m = len(self.workcell.task.redundant)
        return replace(self, waypoints=_as_waypoints(centre, self.waypoints, m))


def changes(problem: Problem, found: Draft) -> dict[str, Any]:
    """Additions that complete the problem's tables."""
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
    chosen: dict[str, Any] = {"robots": robots, "contacts": contacts, "task": task}
    if found.stand_off is not None:
        chosen["handling"] = {"stand_off": found.stand_off}
    whole: dict[str, Any] = merged(found.given, chosen)
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


def _boxes(found: Draft) -> tuple[Array, Array]:
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
    """As lists of numbers, to a hundredth of a millimetre, none of them -0.0."""
    return (np.round(values, 5) + 0.0).tolist()
