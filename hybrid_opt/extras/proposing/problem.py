"""The problem file: a workcell file without the quantities that are proposed."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.extras.proposing.decimals import pose_limits, readable_turns
from hybrid_opt.extras.proposing.hand_positions import hand_positions, pattern_entry
from hybrid_opt.extras.proposing.kinematics import shoulder_positions
from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import OutsideError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.descriptions import PACKAGE_SCHEME
from symbolic.read.editing import completed, merged, with_paths
from symbolic.read.payload import read_contact, read_payload
from symbolic.read.robots import read_robot
from symbolic.read.tables import TableReader
from symbolic.records import Robot, Workcell
from symbolic.records import quantities as quantity
from symbolic.records.poses import Orientation, box_placement, rotation_from_rpy
from symbolic.records.problems import Problems
from symbolic.records.time_law import OPTIMAL

UPRIGHT = 0.7
"""An edge of the box counts as upright if the cosine between it and the vertical exceeds this."""

LEAST_LEVEL = 0.1
"""The direction of a carry counts if its level distance exceeds this [m]."""

PROPOSED = ("waypoints", "initial", "redundant")
"""Keys of the task that are always proposed anew."""

MOST_SIDES = 3
"""Positions of hands with which bases are searched, the best."""

DRAFT_HEIGHT, DRAFT_SPEED = 0.5, 0.25
"""Provisional height of the box over the bases, and of its goal over its start [m]; provisional
speed [m/s]."""

DRAFT_ROOM = 0.01
"""Half-width of provisional bounds, without meaning [m, rad]."""


@dataclass(frozen=True)
class Problem:
    """Content of a problem file without the keys that a proposal will fill in.

    Attributes:
        source: path of the file.
        text: text of the file, without those keys.
        data: tables of the file, without those keys.
    """

    source: Path
    text: str
    data: dict[str, Any]

    @property
    def poses(self) -> tuple[Array, Array]:
        """Poses (6,) of the box at start and goal [m, rad]. Angles of the goal differ by at most
        half a turn from those of the start; rotation vectors are left unchanged."""
        start, goal = (np.array(self.data["task"][key], dtype=float) for key in ("start", "goal"))
        goal[3:] = self.orientation.unwrapped(np.array([start[3:], goal[3:]]))[1]
        return start, goal

    @property
    def orientation(self) -> Orientation:
        """Convention of the last three numbers of a pose."""
        task = self.data["task"]
        if task.get("rotation") != "quaternion":
            return Orientation()
        reference = rotation_from_rpy(task.get("rotation_reference", [0.0, 0.0, 0.0]))
        return Orientation("quaternion", reference)

    @property
    def is_machine(self) -> bool:
        """True if both robots are arms of one machine: different chains of one file at one base.
        The base may be missing."""
        first, second = self.data["robots"]
        keys = ("robot", "urdf", "xacro_arguments", "base")
        same = all(first.get(key) == second.get(key) for key in keys)
        chains = first.get("chain"), second.get("chain")
        return same and all(chains) and chains[0] != chains[1]

    @cached_property
    def contacts(self) -> list[dict[str, Any]]:
        """The two entries of `contacts` in the workcell file, with the positions of the pads or
        hands on the box.

        Positions that the file states are kept. Otherwise:

        - Hands that grip by themselves are at the first proposal of `hand_positions`.
        - Pads are at the centres of the two opposite faces that face the robots' bases, or the
          shoulders of a machine with two arms. Without bases in the file, they are on the faces
          beside the direction of the carry.

        Raises:
            WorkcellError: the file describes robots whose shoulders cannot be found, or no face has
                room for the hands.
        """
        entries = self.data["contacts"]
        if self.states_contacts:
            keys = ("xyz", "spin", "further") if self.has_hands else ("xyz",)
            return [{key: entry[key] for key in keys if key in entry} for entry in entries]
        if self.has_hands:
            return self._hand_positions[0]
        bases = self._bases
        start, goal = self.poses
        size = np.array(self.data["payload"]["size"], dtype=float)
        R_world_box = box_placement(self.orientation, start)[:3, :3]
        points = contact_points(size, np.array([start, goal]), R_world_box, bases)
        return [{"xyz": point} for point in points]

    @cached_property
    def _bases(self) -> Array | None:
        """(2, 3) positions of the robots' bases, or of the shoulders of a machine with two arms, in
        the world [m]; None if the file has no bases."""
        found = [robot.get("base", {}).get("xyz") for robot in self.data["robots"]]
        if not all(isinstance(xyz, list) and len(xyz) == 3 for xyz in found):
            return None
        return (
            shoulder_positions(self._robots()) if self.is_machine else np.array(found, dtype=float)
        )

    @property
    def states_contacts(self) -> bool:
        """True if the file states where both pads or hands are on the box."""
        return all("xyz" in entry for entry in self.data["contacts"])

    @property
    def has_hands(self) -> bool:
        """True if both contacts are hands that hold by themselves."""
        return all(entry.get("kind", "pad") != "pad" for entry in self.data["contacts"])

    @cached_property
    def _hand_positions(self) -> list[list[dict[str, Any]]]:
        """The two entries of `contacts` in the workcell file, for each proposed placement of the
        arms' hands; the best first.

        Raises:
            WorkcellError: the file is wrong, or no face has room for the hands.
        """
        size = np.array(self.data["payload"]["size"], dtype=float)
        thickness, problems = float(size.min()), Problems()
        entries = [pattern_entry(entry, thickness) for entry in self.data["contacts"]]
        table = TableReader({**self.data, "contacts": entries}, "", problems)
        payload = read_payload(table.table("payload"), self.source.parent)
        patterns = [read_contact(entry, payload) for entry in table.tables("contacts")]
        if problems.found:
            raise WorkcellError(str(self.source), problems.messages())
        R = box_placement(self.orientation, np.array(self.poses))[:, :3, :3]
        bases = np.zeros((2, 3)) if self._bases is None else self._bases
        anywhere = [
            {} if "base" in robot else {"base": {"xyz": [0.0, y, 0.0]}}
            for robot, y in zip(self.data["robots"], (1.0, -1.0), strict=True)
        ]
        found = hand_positions(
            patterns,
            size,
            R,
            (bases[0] - bases[1]) @ R[0],
            lambda contacts: self.workcell({"contacts": contacts, "robots": anywhere}),
        )
        if not found:
            text = (
                "contacts: no free face of the box has room for hands with their tools outside it"
            )
            raise WorkcellError(str(self.source), (text,))
        return found

    def other_contacts(self) -> list[list[dict[str, Any]]]:
        """Return further placements of the pads or hands on the box, the most promising first.

        Hands have the further proposals of `hand_positions`. Pads have all other pairs of opposite
        faces, each in both orders of the robots: upright faces first, then those that face the
        robots.

        Returns:
            For each placement the two tables of contacts as they stand in a file; an empty list if
            the file states the positions or has no bases.
        """
        if self._bases is None or self.states_contacts:
            return []
        if self.has_hands:
            return self._hand_positions[1:]
        R = box_placement(self.orientation, self.poses[0])[:3, :3]
        size = np.array(self.data["payload"]["size"], dtype=float)
        along = self._bases[0] - self._bases[1]
        faces = [(axis, side) for axis in range(3) for side in (1.0, -1.0)]
        faces.sort(
            key=lambda face: (abs(R[2, face[0]]) > UPRIGHT, -face[1] * (along @ R[:, face[0]]))
        )
        points = [side * size[axis] / 2.0 * np.eye(3)[axis] for axis, side in faces]
        pairs = [[{"xyz": (0.0 + s * p).tolist()} for s in (1.0, -1.0)] for p in points]
        return [pair for pair in pairs if pair != self.contacts]

    def _robots(self) -> tuple[Robot, Robot]:
        """Read both robots of the file; other tables are not read.

        Raises:
            WorkcellError: an entry of a robot is wrong.
        """
        problems = Problems()
        entries = TableReader(self.data, "", problems).tables("robots", exactly=2)
        found = [read_robot(entry, self.source.parent)[0] for entry in entries]
        if problems.found:
            raise WorkcellError(str(self.source), problems.messages())
        return found[0], found[1]

    def sides(self) -> list[Problem]:
        """Return copies of the problem that place its pads or hands on different sides of the box.

        - Hands: one copy for each of the `MOST_SIDES` best proposals of `hand_positions`.
        - Pads of a machine with two arms: two copies for each pair of opposite upright faces, the
          second one with exchanged arms.
        - Pads of two separate robots: one copy for each such pair. If the box moves horizontally by
          `LEAST_LEVEL` or more, the direction of the carry determines the faces, and only the
          problem itself is returned.

        Only the problem itself is returned, too, if the file states the positions.
        """
        entries = self.data["contacts"]
        start, goal = self.poses
        if self.has_hands and not self.states_contacts:
            tables = self._hand_positions[:MOST_SIDES]
            placed = [merged(entries, each) for each in tables]
            return [replace(self, data={**self.data, "contacts": each}) for each in placed]
        level = float(np.linalg.norm((goal - start)[:2]))
        if self.states_contacts or not (self.is_machine or level < LEAST_LEVEL):
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
        """Read the file as a workcell. A task without waypoints gets one free waypoint halfway.

        Whether the arms reach the box is not checked, because bases and rotations of the pads are
        chosen later.

        Args:
            changes: changes of the file's tables, as `symbolic.read.editing.completed` takes them.

        Raises:
            WorkcellError: the file is wrong; the message lists all problems.
        """
        changes = changes or {}
        if "contacts" not in changes:
            changes = merged({"contacts": self.contacts}, changes)
        task = dict(self.data["task"])
        if "waypoints" not in changes.get("task", {}):
            (middle,) = readable_turns(np.mean(self.poses, axis=0)[None], self.orientation)
            low, high = pose_limits(middle, self.orientation)
            task["waypoints"] = [
                {
                    "lower": np.maximum(middle - DRAFT_ROOM, low).tolist(),
                    "upper": np.minimum(middle + DRAFT_ROOM, high).tolist(),
                }
            ]
        text = completed("", self.data | {"task": task}, changes)
        return load(self.source, text=text.encode(), reach=False)

    def completed(self, changes: dict[str, Any], folder: Path) -> str:
        """Return the text of the file with changes, and with paths relative to a folder.

        Args:
            changes: changes of the file's tables, as `symbolic.read.editing.completed` takes them.
            folder: folder to which paths in the text are relative.

        Raises:
            SettingsError: the file is written in a way that cannot be edited.
        """
        here, there = self.source.parent, folder.resolve()

        def moved(name: str) -> str:
            is_relative = not os.path.isabs(name) and not name.startswith(PACKAGE_SCHEME)
            return os.path.relpath(here / name, there) if is_relative else name

        paths = {} if there == here else with_paths(self.data, moved)
        return completed(self.text, self.data, merged(paths, changes))


def read_problem(path: str | Path, with_poses: bool = True) -> Problem:
    """Read a problem file.

    Args:
        path: path of the file.
        with_poses: False if only bases and box count, as for a map of their reach: `start`, `goal`
            and `reference_speed` may then be missing, and get provisional values without meaning.

    Raises:
        WorkcellError: the file is not TOML, or required keys are missing.
    """
    path = Path(path)
    try:
        source = safe_io.resolved(path)
        text = safe_io.text(safe_io.read_bytes(source, safe_io.WORKCELL_BYTES))
        data = safe_io.toml_tables(text.encode())
    except OutsideError as error:
        raise WorkcellError(str(path), (f"file: {error}",)) from error
    problems = Problems()
    if not with_poses:
        _add_poses(TableReader(data, "", problems), data)
    if not problems.found:
        _require_known(TableReader(data, "", problems))
    if problems.found:
        raise WorkcellError(str(path), problems.messages())
    text = completed(text, data, {"task": dict.fromkeys(PROPOSED)})
    for key in PROPOSED:
        data["task"].pop(key, None)
    return Problem(source, text, data)


def _add_poses(table: TableReader, data: dict[str, Any]) -> None:
    """Add a start and a goal near the robots' bases to a task that lacks them, and remove keys that
    only a carry needs. Report missing bases.

    Args:
        table: reader of the whole problem file.
        data: tables of the file, which are changed.
    """
    bases = []
    for robot in table.tables("robots", exactly=2):
        if robot.raw("base", None) is None:
            robot.add("base", "is missing, but needed; propose --bases chooses bases for a carry")
        else:
            bases.append(robot.table("base").vector("xyz", (quantity.POSITION,) * 3))
    task = data.setdefault("task", {})
    if table.problems.found or not isinstance(task, dict):
        return
    for key in (*PROPOSED, "time_law"):
        task.pop(key, None)
    x, y, z = np.mean(bases, axis=0).tolist()
    task.setdefault("start", [x, y, z + DRAFT_HEIGHT, 0.0, 0.0, 0.0])
    x, y, z, *angles = task["start"]
    task.setdefault("goal", [x, y, z + DRAFT_HEIGHT, *angles])
    task.setdefault("reference_speed", DRAFT_SPEED)


def _require_known(table: TableReader) -> None:
    """Check the keys that a proposal needs: add each missing or wrong key to the table's list of
    problems.

    All other keys are checked when the workcell is read.

    Args:
        table: reader of the whole problem file.
    """
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
    if task.raw("time_law", None) == OPTIMAL:
        task.add(
            "time_law",
            f"found {OPTIMAL!r}; allowed are 'constant' and 'ramped', change it in the proposed "
            "file",
        )
    if all("xyz" in entry for entry in contacts):
        return
    for entry in contacts:
        for other in entry.tables("further"):
            other.vector("xyz", (quantity.POSITION,) * 3)
    if payload.raw("kind", "box") != "box":
        table.add("contacts", "xyz is needed for a payload that is no box")
    else:
        payload.vector("size", (quantity.PAYLOAD_SIZE,) * 3)


def contact_points(
    size: Array, way: Array, R_world_box: Array, bases: Array | None
) -> list[list[float]]:
    """Choose two opposite upright faces of the box for the pads, and return their centres.

    With bases, the faces are those that face the robots. Without bases, they are those whose
    normals are most nearly perpendicular to the direction of the carry.

    Args:
        size: (3,) edges of the box [m].
        way: (2, 6) start and goal of the box [m, rad].
        R_world_box: (3, 3) rotation of the box at the start.
        bases: (2, 3) positions of the robots in the world [m]; None if they are not known.

    Returns:
        Centre (3,) of the face of robot 1, then of robot 2, box frame [m].
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
