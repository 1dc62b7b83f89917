"""The problem file: a workcell file in which a person has left out what is to be proposed; and the
text of the workcell file that completes it, comments and order as they were."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hybrid_opt.proposing.bounds import Bounds
from hybrid_opt.proposing.holding import shoulders
from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError, SettingsError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.descriptions import PACKAGE_SCHEME
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
        return self._faces(bases)

    def _robots(self) -> tuple[Robot, Robot]:
        """The robots alone, wherever the box is."""
        problems = Problems()
        entries = Table(self.data, "", problems).tables("robots", exactly=2)
        found = [read_robot(entry, self.source.parent)[0] for entry in entries]
        if problems.found:
            raise WorkcellError(str(self.source), problems.messages())
        return found[0], found[1]

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
            changes: as for `hybrid_opt.proposing.problem.completed`.

        Raises:
            WorkcellError: with all problems of the file.
        """
        return self._draft(merged({"contacts": self.contacts}, changes or {}))

    def _draft(self, changes: dict[str, Any]) -> Workcell:
        here = self.source.parent
        data = merged(self.data, _with_paths(self.data, lambda name: str(here / name)))
        task = data["task"] = dict(data["task"])
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
            changes: as for `hybrid_opt.proposing.problem.completed`.

        Raises:
            SettingsError: the file is written in a way that cannot be completed.
        """
        here, there = self.source.parent, folder.resolve()

        def moved(name: str) -> str:
            return name if os.path.isabs(name) else os.path.relpath(here / name, there)

        paths = {} if there == here else _with_paths(self.data, moved)
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


def _with_paths(data: dict[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """Changes by which every path in the tables but those of packages is another."""

    def changed(table: Any, *keys: str) -> dict[str, Any]:
        names = {key: table.get(key) for key in keys} if isinstance(table, dict) else {}
        return {
            key: change(name)
            for key, name in names.items()
            if isinstance(name, str) and not name.startswith(PACKAGE_SCHEME)
        }

    found: dict[str, Any] = {"robots": [], "payload": changed(data["payload"], "path")}
    for robot in data["robots"]:
        entry: dict[str, Any] = changed(robot, "urdf", "srdf")
        if isinstance(robot.get("package_dirs"), list):
            entry["package_dirs"] = [change(str(name)) for name in robot["package_dirs"]]
        if isinstance(robot.get("tool"), list):
            entry["tool"] = [changed(body, "path") for body in robot["tool"]]
        found["robots"].append(entry)
    if isinstance(data.get("environment"), list):
        found["environment"] = [changed(body, "path") for body in data["environment"]]
    return found


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


Changes = Mapping[str, Any]
"""Tables and keys to be set: {'task': {'initial': ...}, 'robots': [{...}, {...}]}; a list of tables
that is there already is changed entry by entry, a key with the value None is removed."""

INLINE = ("base", "pad")
"""Tables that are written in one line."""


def completed(text: str, data: Mapping[str, Any], changes: Changes) -> str:
    """A workcell file's text with values set.

    Args:
        text: the file; '' to write `data` without comments.
        data: what the file holds, without what is replaced.
        changes: what is set.

    Raises:
        SettingsError: the file is written in a way that cannot be completed, or TOML Kit is not
            installed.
    """
    tomlkit = library()
    wanted = merged(data, changes)
    document = tomlkit.parse(text) if text else tomlkit.document()
    if not text:
        for key, value in wanted.items():
            document[key] = _item(value)
    else:
        _apply(document, changes)
    return _checked(tomlkit.dumps(document), wanted)


def extended(text: str, data: Mapping[str, Any], key: str, tables: list[dict[str, Any]]) -> str:
    """A workcell file's text with tables added behind those of an array, as `[[environment]]`.

    Args:
        text, data: the file, and what it holds.
        key: of the array, at the top level; it may be missing.
        tables: what is added.

    Raises:
        SettingsError: see `completed`.
    """
    tomlkit = library()
    document = tomlkit.parse(f"{text.rstrip()}\n\n")
    if key not in document:
        document[key] = _item(tables)
    elif isinstance(document[key], tomlkit.items.AoT):
        for table in map(_item, tables):
            table.add(tomlkit.nl())
            document[key].append(table)
    before = data.get(key, [])
    wanted = {**data, key: [*(before if isinstance(before, list) else ()), *tables]}
    return _checked(f"{document.as_string().rstrip()}\n", wanted)


def _checked(found: str, wanted: Mapping[str, Any]) -> str:
    """A text that says what it should."""
    try:
        same = _alike(outside.toml_tables(found.encode()), wanted)
    except OutsideError:
        same = False
    if not same:
        raise SettingsError(
            "the file cannot be completed as it is written; begin each section with a heading of "
            "its own ([task], [[contacts]]) and keep what belongs to one together"
        )
    return found


def _alike(found: Any, wanted: Any) -> bool:
    """Whether values are equal; what is no number is like itself, and told by the reader."""
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        return found.keys() == wanted.keys() and all(_alike(found[k], wanted[k]) for k in found)
    if isinstance(found, list) and isinstance(wanted, list):
        return len(found) == len(wanted) and all(map(_alike, found, wanted))
    return bool(found == wanted) or (found != found and wanted != wanted)


def merged(data: Any, changes: Any) -> Any:
    """Content of a file after the changes, as plain values; also changes after further ones."""
    if isinstance(changes, Mapping) and isinstance(data, Mapping):
        found = dict(data)
        for key, value in changes.items():
            if value is None:
                found.pop(key, None)
            else:
                found[key] = merged(found[key], value) if key in found else value
        return found
    if _tables(changes) and _tables(data) and len(changes) == len(data):
        return [merged(old, new) for old, new in zip(data, changes, strict=True)]
    return changes


def _tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(entry, Mapping) for entry in value)


def _apply(place: Any, changes: Any) -> None:
    heading = _cut_heading(place)
    for key, value in changes.items():
        if value is None:
            place.pop(key, None)
        elif isinstance(value, Mapping) and key in place:
            _apply(place[key], value)
        elif _tables(value) and key in place and len(value) == len(place[key]):
            for old, new in zip(place[key], value, strict=True):
                _apply(old, new)
        else:
            place[key] = _item(value)
    items, body = library().items, _last_body(place)
    while heading and body and isinstance(body[-1][1], items.Whitespace | items.Null):
        body.pop()  # before a table that is gone, and its place
    body.extend(heading)


def _cut_heading(place: Any) -> list[Any]:
    """Take away the blank line at a table's end and what follows it: comments there are about the
    next table, before which new ones go."""
    body = _last_body(place)
    blank = end = len(body)
    while end and body[end - 1][0] is None:
        end -= 1
        if isinstance(body[end][1], library().items.Whitespace):
            blank = end
    heading = body[blank:]
    del body[blank:]
    return heading


def _last_body(place: Any) -> list[Any]:
    """Pairs of keys, None for comments and blank lines, and items of the table that ends a table;
    none where one is written in one line, or in several places."""
    items = library().items
    if isinstance(place, items.AoT):
        return _last_body(place[-1]) if len(place) else []
    if not isinstance(place, items.Table | library().TOMLDocument):
        return []
    body: list[Any] = (place.value if isinstance(place, items.Table) else place).body
    return (body and _last_body(body[-1][1])) or body


def _item(value: Any) -> Any:
    """A value as TOML: tables with headings, rows of numbers one below the other."""
    tomlkit = library()
    if isinstance(value, Mapping):
        table = tomlkit.table()
        for key, entry in value.items():
            if key in INLINE and isinstance(entry, Mapping):
                table[key] = tomlkit.inline_table()
                table[key].update(entry)
            else:
                table[key] = _item(entry)
        return table
    if value and _tables(value):
        tables = tomlkit.aot()
        for entry in value:
            tables.append(_item(entry))
        return tables
    if isinstance(value, list) and value and isinstance(value[0], list):
        rows = tomlkit.array()
        for row in value:
            rows.append(row)
        return rows.multiline(True)
    return value


def library() -> Any:
    """TOML Kit.

    Raises:
        SettingsError: it is not installed.
    """
    try:
        import tomlkit
    except ImportError as error:
        raise SettingsError(
            "a proposed file is completed by TOML Kit, which is not installed: "
            'pip install "dual-arm-carry[propose]"'
        ) from error
    return tomlkit
