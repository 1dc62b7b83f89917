"""The problem file: a workcell file in which a person has left out what is to be proposed."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hybrid_opt.proposing.document import completed, merged
from hybrid_opt.proposing.kinematics import shoulders
from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.descriptions import PACKAGE_SCHEME
from symbolic.records import Workcell
from symbolic.records.poses import Orientation, box_placement, rotation_from_rpy

UPRIGHT = 0.7
"""Share of the vertical from which on an edge of the box counts as upright."""

LEAST_LEVEL = 0.1
"""How far a carry goes level, at least, for its direction to count [m]."""

PROPOSED = ("waypoints", "initial", "redundant")
"""Keys of the task that are proposed anew, whatever the file has."""

_TINY = {"patch_size": None, "patch_radius": 0.001, "further": None, "normal": None}
"""A contact that fits onto any face; of no meaning."""

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
        """What the last three numbers of a pose mean."""
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
        same = all(first.get(key) == second.get(key) for key in ("urdf", "xacro_arguments", "base"))
        chains = first.get("chain"), second.get("chain")
        return same and all(chains) and chains[0] != chains[1]

    @cached_property
    def contacts(self) -> list[dict[str, Any]]:
        """Both contacts' points, the middles of opposite faces where the file has none: those that
        face the robots (the shoulders of a machine with both arms), or those that the carry passes
        sideways where the robots have no bases.

        Raises:
            WorkcellError: shoulders are asked for, and the file is wrong.
        """
        entries = self.data["contacts"]
        if all("xyz" in entry for entry in entries):
            return [{"xyz": entry["xyz"]} for entry in entries]
        found = [robot.get("base", {}).get("xyz") for robot in self.data["robots"]]
        known = all(isinstance(xyz, list) and len(xyz) == 3 for xyz in found)
        bases = np.array(found, dtype=float) if known else None
        if known and self.is_machine:
            draft = [{**face, **_TINY} for face in self._faces(None)]
            bases = shoulders(self._draft({"contacts": draft}))
        return self._faces(bases)

    def _faces(self, bases: Array | None) -> list[dict[str, Any]]:
        """Middles of faces, see `contact_points`."""
        start, goal = self.poses
        size = np.array(self.data["payload"]["size"], dtype=float)
        way = np.array([start, goal])
        points = contact_points(size, way, box_placement(self.orientation, start)[:3, :3], bases)
        return [{"xyz": point} for point in points]

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
            changes: as for `hybrid_opt.proposing.document.completed`.

        Raises:
            WorkcellError: with all problems of the file.
        """
        return self._draft(merged({"contacts": self.contacts}, changes or {}))

    def _draft(self, changes: dict[str, Any]) -> Workcell:
        data = with_places(self.data, self.source.parent)
        task = data["task"]
        if "waypoints" not in changes.get("task", {}):
            poses = np.array([task["start"], task["goal"]], dtype=float)
            task["waypoints"] = [
                {
                    "lower": (poses.min(axis=0) - REACH_OF_DRAFT).tolist(),
                    "upper": (poses.max(axis=0) + REACH_OF_DRAFT).tolist(),
                }
            ]
        with TemporaryDirectory() as folder:
            draft = Path(folder) / self.source.name
            draft.write_text(completed("", data, changes), encoding="utf-8")
            try:
                return load(draft)
            except WorkcellError as error:
                raise WorkcellError(str(self.source), error.problems) from error

    def completed(self, changes: dict[str, Any], folder: Path) -> str:
        """The file's text, completed, for a folder that paths are then relative to.

        Args:
            changes: as for `hybrid_opt.proposing.document.completed`.

        Raises:
            SettingsError: the file is written in a way that cannot be completed.
        """
        return completed(self.text, self.data, merged(self._moved(folder), changes))

    def _moved(self, folder: Path) -> dict[str, Any]:
        """What keeps paths right in another folder."""
        here = self.source.parent
        return {} if folder.resolve() == here else _relative(self.data, here, folder.resolve())


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
    problems = tuple(_problems(data))
    if problems:
        raise WorkcellError(str(path), problems)
    text = completed(text, data, {"task": dict.fromkeys(PROPOSED)})
    for key in PROPOSED:
        data["task"].pop(key, None)
    return Problem(source, text, data)


def _problems(data: dict[str, Any]) -> list[str]:
    """What this module needs; the rest is checked by the reader of workcell files."""
    found = []
    for name, kind in (("task", dict), ("payload", dict), ("robots", list), ("contacts", list)):
        if not isinstance(data.get(name), kind):
            found.append(f"{name}: missing; see docs/workcell.md")
    for name in ("robots", "contacts"):
        entries = data.get(name)
        if isinstance(entries, list) and (
            len(entries) != 2 or not all(isinstance(entry, dict) for entry in entries)
        ):
            found.append(f"{name}: allowed are exactly 2 tables")
    if found:
        return found
    task = data["task"]
    for key in ("start", "goal"):
        pose = task.get(key)
        if not isinstance(pose, list) or len(pose) != 6 or not all(map(_is_number, pose)):
            found.append(f"task.{key}: allowed are 6 numbers: x, y, z, roll, pitch, yaw")
    if task.get("start") == task.get("goal"):
        found.append("task.goal: found the start again; allowed is another pose")
    reference = task.get("rotation_reference", [0.0, 0.0, 0.0])
    if (
        not isinstance(reference, list)
        or len(reference) != 3
        or not all(map(_is_number, reference))
    ):
        found.append("task.rotation_reference: allowed are 3 numbers: roll, pitch, yaw")
    waypoints = task.get("waypoints", [])
    if isinstance(waypoints, list) and any("fixed" in w for w in waypoints if isinstance(w, dict)):
        found.append(
            "task.waypoints: found a fixed one; allowed is a carry from start to goal, put fixed "
            "poses into the proposed file"
        )
    if task.get("time_law") == "optimal":
        found.append(
            "task.time_law: found 'optimal'; allowed are 'constant' and 'ramped', change it in the "
            "proposed file"
        )
    size = data["payload"].get("size")
    if all("xyz" in entry for entry in data["contacts"]):
        return found
    if data["payload"].get("kind", "box") != "box":
        found.append("contacts: xyz is needed for a payload that is no box")
    elif not isinstance(size, list) or len(size) != 3 or not all(map(_is_number, size)):
        found.append("payload.size: allowed are 3 numbers")
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def with_places(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The tables with every path absolute that is relative to a folder."""
    data = copy.deepcopy(data)

    def placed(table: Any, key: str) -> None:
        value = table.get(key) if isinstance(table, dict) else None
        if isinstance(value, str) and not value.startswith(PACKAGE_SCHEME):
            table[key] = str(folder / value)

    for robot in data["robots"]:
        placed(robot, "urdf")
        placed(robot, "srdf")
        folders = robot.get("package_dirs")
        if isinstance(folders, list):
            robot["package_dirs"] = [str(folder / str(entry)) for entry in folders]
        for body in robot.get("tool", []):
            placed(body, "path")
    placed(data["payload"], "path")
    for body in data.get("environment", []):
        placed(body, "path")
    return data


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
    return [point.tolist(), (-point).tolist()]


def _relative(data: dict[str, Any], here: Path, there: Path) -> dict[str, Any]:
    """Changes by which relative paths lead from another folder to the same files."""

    def moved(table: dict[str, Any], *keys: str) -> dict[str, Any]:
        return {
            key: os.path.relpath(here / table[key], there)
            for key in keys
            if isinstance(table.get(key), str)
            and not table[key].startswith(PACKAGE_SCHEME)
            and not os.path.isabs(table[key])
        }

    robots = []
    for robot in data["robots"]:
        entry: dict[str, Any] = moved(robot, "urdf", "srdf")
        if "package_dirs" in robot:
            entry["package_dirs"] = [
                name if os.path.isabs(name) else os.path.relpath(here / name, there)
                for name in robot["package_dirs"]
            ]
        if "tool" in robot:
            entry["tool"] = [moved(body, "path") for body in robot["tool"]]
        robots.append(entry)
    found: dict[str, Any] = {"robots": robots, "payload": moved(data["payload"], "path")}
    if "environment" in data:
        found["environment"] = [moved(body, "path") for body in data["environment"]]
    return found
