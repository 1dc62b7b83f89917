"""Read a workcell from a TOML file, unchanged or with changed values.

docs/reference/workcell.md describes every key. Conditions that involve several sections (names,
references, reach and others) are checked last.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from symbolic import safe_io
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.errors import OutsideError, RobotModelError, WorkcellError
from symbolic.read.arms import (
    arm_model,
    body_names,
    link_lengths,
    machine_problem,
    robot_urdf,
    turning_joints,
)
from symbolic.read.descriptions import description_content, resolve_mesh
from symbolic.read.payload import SHAPE_KEYS, check_count, read_contact, read_payload
from symbolic.read.robots import read_robot
from symbolic.read.tables import TableReader, read_body
from symbolic.read.task import read_task, with_force_limit, with_redundancy
from symbolic.records import (
    PAYLOAD_NAME,
    SEARCHED_BRANCH,
    USUAL_UNCERTAINTY,
    CollisionSettings,
    Handling,
    Mesh,
    Robot,
    Uncertainty,
    Workcell,
)
from symbolic.records.content import reading_of
from symbolic.records.poses import box_placement, inverse
from symbolic.records.problems import Problems, matching, suggestion

Check = Callable[[Workcell], Iterable[str]]


def load(
    path: str | Path,
    checks: Sequence[Check] = (),
    stored: bool = False,
    decided: tuple[int, int] = (SEARCHED_BRANCH, SEARCHED_BRANCH),
    text: bytes | None = None,
    reach: bool = True,
) -> Workcell:
    """Read the workcell that a TOML file describes.

    Args:
        path: the file; every path inside it is relative to its folder.
        checks: further checks of an otherwise valid workcell, e.g. inverse kinematics at the start.
            Each returns its problems as texts `key.path: what was found; what is allowed`.
        stored: True if the workcell was unpacked from an archive. Missing packages are then not
            looked for on this machine, and xacro files are already expanded.
        decided: for each robot the index of the start branch (a posture with which the arm can hold
            the box at the start) that replaces "search" in the file; `SEARCHED_BRANCH` leaves
            "search" in place.
        text: content to read in place of the file's content; None to read the file.
        reach: True if fixed poses have to be within the arms' reach; False if bases or rotations of
            pads are still to be chosen.

    Raises:
        WorkcellError: with all problems of the file, each with its key path.
    """
    path = Path(path)
    try:
        source = safe_io.resolved(path)
        content = safe_io.read_bytes(source, safe_io.WORKCELL_BYTES) if text is None else text
        data = safe_io.toml_tables(content)
        settled = with_branches(content, data, decided)
        if settled != content:
            content, data = settled, safe_io.toml_tables(settled)
    except OutsideError as error:
        raise WorkcellError(str(path), (f"file: {error}",)) from error
    problems = Problems()
    workcell = _build(TableReader(data, "", problems), source, content, stored, reach)
    if workcell is None or problems.found:
        raise WorkcellError(str(path), problems.messages())
    further = tuple(problem for check in checks for problem in check(workcell))
    if further:
        raise WorkcellError(str(path), further)
    return workcell if text is None else replace(workcell, text=content)


def changed(workcell: Workcell, changes: Mapping[str, Any]) -> Workcell:
    """Return the workcell with changed values in its file. The result is checked like a file.

    Args:
        workcell: a workcell that was read from a file.
        changes: values by key path, such as 'payload.mass' (`changed_text` describes paths).

    Raises:
        WorkcellError: a path does not exist, or the changed cell is invalid. The message lists
            every problem.
    """
    source, text = workcell.source, workcell.text
    try:
        known = safe_io.read_bytes(source, safe_io.WORKCELL_BYTES) if text is None else text
        if b"search" in known:
            known = with_branches(known, safe_io.toml_tables(known), workcell.start_branch)
        content = changed_text(known, changes, str(source))
    except OutsideError as error:
        raise WorkcellError(str(source), (f"file: {error}",)) from error
    return load(source, text=content)


def _build(
    table: TableReader, source: Path, content: bytes, stored: bool, reach: bool
) -> Workcell | None:
    """Build the workcell from its tables as far as possible; record the problems.

    Args:
        table: reader of the file's top level; it collects the problems.
        source: path of the file.
        content: content of the file.
        stored: whether the cell was unpacked from an archive.
        reach: True to check that fixed poses are within the arms' reach.

    Returns:
        The workcell; None if the number of robots or contacts is not two.
    """
    problems, folder = table.problems, source.parent
    name = table.text("name")
    robots = [read_robot(entry, folder, stored) for entry in table.tables("robots", exactly=2)]
    payload = read_payload(table.table("payload"), folder)
    contacts = [read_contact(entry, payload) for entry in table.tables("contacts", exactly=2)]
    check_count(contacts, problems)
    holding = np.array([contact.holding_force for contact in contacts])
    task, redundant = read_task(table.table("task"), holding)
    environment = tuple(read_body(entry, folder) for entry in table.tables("environment"))
    collision = table.table("collision", {}).record(CollisionSettings)
    for index, pair in enumerate(collision.ignored):
        # A pattern may stand against itself: all bodies that it matches against one another.
        if pair.first and pair.first == pair.second and not set(pair.first) & {"*", "?"}:
            problems.add(f"collision.ignored[{index}]", f"pairs {pair.first!r} with itself")
    uncertainty = USUAL_UNCERTAINTY
    if table.has("uncertainty"):
        uncertainty = table.table("uncertainty").record(Uncertainty, stated=True)
    handling = table.table("handling", {}).record(Handling)
    table.close()
    if len(robots) != 2 or len(contacts) != 2:
        return None
    workcell = Workcell(
        name=name,
        robots=(robots[0][0], robots[1][0]),
        payload=payload,
        contacts=(contacts[0], contacts[1]),
        task=task,
        environment=environment,
        collision=collision,
        start_branch=(robots[0][1], robots[1][1]),
        source=source,
        uncertainty=uncertainty,
        handling=handling,
    )
    if not problems.found:
        workcell = with_force_limit(workcell)
    try:
        identity = "" if problems.found else _digest(content, workcell)
    except OutsideError as error:
        problems.add("file", str(error))
        identity = ""
    check_all(workcell, problems, reach)
    workcell = with_redundancy(workcell, redundant, problems)
    # The distance that one arm's stop may cost limits the speed as the payload's own limit does.
    slowed = min(payload.velocity_max, handling.speed_max)
    workcell = replace(workcell, payload=replace(workcell.payload, velocity_max=slowed))
    if workcell.task.pieces > 1 and not problems.found:
        # Not imported at the top: it needs CasADi.
        from symbolic.path.spline import refined_task

        workcell = replace(workcell, task=refined_task(workcell.task))
    return replace(workcell, reading=reading_of(workcell, identity)) if identity else workcell


def _digest(content: bytes, workcell: Workcell) -> str:
    """Compute the SHA-256 of a workcell file and of the content of every file that it names.

    The paths of the files do not count. The order is: the bytes of the workcell file; for each
    robot its URDF (a xacro file in expanded form), the meshes that the URDF names, and its SRDF;
    the meshes of tools, environment and payload.

    Raises:
        OutsideError: a file cannot be read, or all together are too large.
    """
    outer = hashlib.sha256(hashlib.sha256(content).digest())
    room = safe_io.CELL_BYTES
    # Fixed-length inner digests keep the parts apart.
    for part in _named(workcell):
        room -= len(part)
        if room < 0:
            raise OutsideError(
                "the files that it names are together larger than "
                f"{safe_io.megabytes(safe_io.CELL_BYTES)}; simplify the meshes"
            )
        outer.update(hashlib.sha256(part).digest())
    return outer.hexdigest()


def _named(workcell: Workcell) -> Iterator[bytes]:
    """Yield the content of every file that a workcell names, empty for a mesh that is not found.
    The order is the one that `_digest` states."""
    for robot in workcell.robots:
        yield description_content(robot.urdf, robot.xacro_arguments, robot.package_dirs)
        urdf = robot_urdf(robot)
        for address in (*urdf.collision_meshes, *urdf.visual_meshes):
            mesh = resolve_mesh(address, robot.urdf, robot.package_dirs)
            yield b"" if mesh is None else _content(mesh, safe_io.MESH_BYTES)
        if robot.srdf is not None:
            yield _content(robot.srdf, safe_io.URDF_BYTES)
    tools = [body.shape for robot in workcell.robots for body in robot.tool]
    around = [body.shape for body in workcell.environment]
    for shape in (*tools, *around, workcell.payload.shape):
        if isinstance(shape, Mesh):
            yield _content(shape.path, safe_io.MESH_BYTES)


def _content(path: Path, most: int) -> bytes:
    try:
        return safe_io.read_bytes(path, most)
    except OutsideError as error:
        raise OutsideError(f"names {path.name}, which {error}") from error


# --- start branches ---


def with_branches(content: bytes, data: Mapping[str, Any], decided: tuple[int, int]) -> bytes:
    """Return the text of a workcell file in which chosen start branches replace "search".

    A start branch is a posture with which an arm can hold the box at the start, given by its index.

    Args:
        content: content of the file.
        data: parsed content of the file.
        decided: for each robot the index of the chosen branch; `SEARCHED_BRANCH` for no choice.

    Raises:
        SettingsError: the file is written in a way that cannot be edited.
    """
    robots = data.get("robots")
    if not isinstance(robots, list) or len(robots) != len(decided):
        return content
    found = [
        {"start_branch": branch} if asks and branch != SEARCHED_BRANCH else {}
        for asks, branch in zip(map(_asks_for_search, robots), decided, strict=True)
    ]
    if not any(found):
        return content
    # Not imported at the top: see the module.
    from symbolic.read.editing import completed

    return completed(safe_io.text(content), data, {"robots": found}).encode()


def _asks_for_search(robot: Any) -> bool:
    return isinstance(robot, Mapping) and robot.get("start_branch") == "search"


# --- other values ---


_INDEX = re.compile(r"\[(\d+)\]\.?(.*)", re.DOTALL)


def changed_text(content: bytes, changes: Mapping[str, Any], file: str) -> bytes:
    """Return the text of a workcell file with changed values of some keys; comments are lost.

    Args:
        content: content of the workcell file.
        changes: values by key path as in the file: 'payload.mass', 'task.goal'. In an array of
            tables an index or a name selects one table; without either, every table is meant:
            'contacts[0].friction', 'environment.top board.xyz', 'contacts.friction'.
        file: name of the file, for messages.

    Raises:
        WorkcellError: a path does not exist; the message lists every such path.
        OutsideError: the content is not TOML.
    """
    data, problems = deepcopy(_tables_of(content)), []
    for path, value in changes.items():
        owners = list(_owners(data, path))
        if not owners:
            problems.append(
                f"{path}: leads nowhere in the file; allowed are its keys, see the docs"
            )
        for table, key in owners:
            table[key] = _plain(value)
    if problems:
        raise WorkcellError(file, tuple(problems))
    # Not imported at the top: see the module.
    from symbolic.read.editing import completed

    return completed("", data, {}).encode()


@lru_cache(maxsize=4)
def _tables_of(content: bytes) -> dict[str, Any]:
    """Parse a workcell file into nested dictionaries.

    The result is cached; callers must not modify it.
    """
    return safe_io.toml_tables(content)


def _owners(table: Any, path: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield every table that contains the last key of a key path, together with this key.

    Args:
        table: the table at which the path begins.
        path: the key path (`changed_text`).
    """
    key, _, rest = path.partition(".")
    name, bracket, index = key.partition("[")
    if bracket:
        rest = f"[{index}" + (f".{rest}" if rest else "")
    if not name or not isinstance(table, dict):
        return
    if not rest:
        yield table, name
        return
    inner = table.get(name)
    if isinstance(inner, list) and inner and all(isinstance(entry, dict) for entry in inner):
        yield from _among(inner, rest)
    elif not bracket:
        yield from _owners(table.setdefault(name, {}) if inner is None else inner, rest)


def _among(tables: list[dict[str, Any]], rest: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the results of `_owners` for one or all tables of an array.

    Args:
        tables: the tables of the array.
        rest: rest of the key path. If it begins with an index or a table's name, this table is
            selected; otherwise all tables are.
    """
    if found := _INDEX.match(rest):
        k = int(found[1])
        if k < len(tables):
            yield from _owners(tables[k], found[2])
        return
    named = [t for t in tables if rest.startswith(f"{t.get('name')}.")]
    for table in named or tables:
        yield from _owners(table, rest.removeprefix(f"{table['name']}.") if named else rest)


def _plain(value: Any) -> Any:
    """Convert a value that may contain NumPy arrays and numbers to lists and numbers for TOML."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, tuple | list) else value


# --- checks across sections ---

# Each records what it finds in `problems` and looks only at parts that are themselves in order.

PATCH_OVERLAP = 0.9  # [1], how far patches that carry moments together may stand beside one another
REACH_SLACK = 1e-6  # [m], rounding of a flange exactly at full stretch


def check_names(workcell: Workcell, problems: Problems) -> None:
    """Record a problem for each name that is ambiguous: the name of a robot or obstacle that
    another one or the payload has too, a tool body with the name of another body of its robot, and
    an obstacle with '/' in its name, which marks bodies of robots."""
    robots = [(f"robots[{i}].name", robot.name) for i, robot in enumerate(workcell.robots)]
    bodies = [(f"environment[{i}].name", b.name) for i, b in enumerate(workcell.environment)]
    _check_unique([("'payload' (reserved)", PAYLOAD_NAME), *robots, *bodies], problems)
    for index, robot in enumerate(workcell.robots):
        path = f"robots[{index}]"
        links: list[tuple[str, str]] = []
        if problems.clean(f"{path}.urdf"):
            content = robot_urdf(robot)
            links = [(f"a link of {robot.urdf.name}", link) for link in content.collisions]
        tools = [(f"{path}.tool[{i}].name", body.name) for i, body in enumerate(robot.tool)]
        _check_unique([*links, *tools], problems)
    for index, body in enumerate(workcell.environment):
        if "/" in body.name:
            problems.add(
                f"environment[{index}].name",
                f"found {body.name!r}; allowed is a name without '/', which marks a robot's bodies",
            )


def _check_unique(entries: list[tuple[str, str]], problems: Problems) -> None:
    first: dict[str, str] = {}
    for path, name in entries:
        if name and name in first:
            problems.add(path, f"found {name!r} again; it is already {first[name]}")
        first.setdefault(name, path)


def check_contacts(workcell: Workcell, problems: Problems) -> None:
    """Record a problem if the task's contact model cannot hold the payload with these contacts
    under every motion."""
    if not problems.clean("contacts", "task.allocation", *SHAPE_KEYS):
        return
    if problem := contact_model(workcell).problem:
        problems.add(*problem)


def check_uncertainty(workcell: Workcell, problems: Problems) -> None:
    """Record a problem if the stated uncertainty of the pads' positions
    (`uncertainty.pad_position`) is too large.

    It is too large if a pad may be displaced by more than its patch radius, or so far that the two
    patches no longer face each other. Only two round pads with opposite normals may have such an
    uncertainty.
    """
    displaced = workcell.uncertainty.pad_position
    if not (displaced and workcell.uncertainty.stated) or not problems.clean(
        "uncertainty", "contacts", *SHAPE_KEYS
    ):
        return
    if not workcell.has_facing_pads:
        problems.add(
            "uncertainty.pad_position",
            "needs two round pads that face one another; leave it out for others",
        )
        return
    radii = [contact.patch_radius for contact in workcell.contacts]
    room = min(min(radii), (sum(radii) - workcell.pad_offset / PATCH_OVERLAP) / 2.0)
    if displaced >= room:
        problems.add(
            "uncertainty.pad_position",
            f"found {displaced:g} m; allowed is less than {max(room, 0.0):g} m, beyond which "
            "displaced patches need not face one another",
        )


def check_shapes(workcell: Workcell, problems: Problems) -> None:
    """Record a problem if the cell has more collision shapes than `collision.most_pieces` allows
    convex pieces. Each shape has at least one piece, so no mesh has to be decomposed for this
    check."""
    most = workcell.collision.most_pieces
    if not problems.clean("collision.most_pieces", *_of_robots("urdf")):
        return
    counts = {"environment": len(workcell.environment)}
    for index, robot in enumerate(workcell.robots):
        counts[f"robots[{index}].tool"] = len(robot.tool)
        collisions = robot_urdf(robot).collisions.values()
        counts[f"robots[{index}].urdf"] = sum(map(len, collisions))
    total = sum(counts.values()) + 1
    if total > most:
        largest = max(counts, key=lambda path: counts[path])
        problems.add(
            largest,
            f"found {counts[largest]} collision shapes, {total} in the whole cell; allowed are "
            f"{most}: simplify or merge them, leave out what nothing can touch, or raise "
            "collision.most_pieces and wait",
        )


def check_references(workcell: Workcell, problems: Problems) -> None:
    """Record a problem for each name in `task.allowed_contacts` or `collision.ignored` that matches
    no body."""
    if not problems.clean("environment"):
        return

    def check(path: str, name: str, known: list[str], meaning: str) -> None:
        if problems.clean(path) and not matching(name, known):
            hint = suggestion(name, known) or f"; they are {', '.join(known)}"
            problems.add(path, f"found {name!r}; allowed is {meaning}{hint}")

    environment = [body.name for body in workcell.environment]
    for index, contact in enumerate(workcell.task.allowed_contacts):
        path = f"task.allowed_contacts[{index}].body"
        check(path, contact.body, environment, "an environment body")
    if not problems.clean(*_of_robots("name", *ARM_KEYS, "flange", "tool")):
        return
    known = [name for group in body_names(workcell).values() for name in group]
    for index, pair in enumerate(workcell.collision.ignored):
        for side in ("first", "second"):
            path = f"collision.ignored[{index}].{side}"
            check(path, getattr(pair, side), known, "a body of the cell")


ARM_KEYS = ("urdf", "chain", "locked_joints", "drop_links")


def _of_robots(*parts: str) -> list[str]:
    return [f"robots[{index}].{part}" for index in (0, 1) for part in parts]


def check_machine(workcell: Workcell, problems: Problems) -> None:
    """Check two arms that are in one description at one base. Record a problem if they do not move
    independently, or if both hold a common joint, but at different positions.
    """
    if problems.clean(*_of_robots(*ARM_KEYS)) and (problem := machine_problem(workcell.robots)):
        problems.add("robots[1].chain", problem)


def check_speeds(workcell: Workcell, problems: Problems) -> None:
    """Record a problem if a reference speed exceeds the payload's limit."""
    for key, limit_key in (
        ("reference_speed", "velocity_max"),
        ("reference_angular_speed", "angular_velocity_max"),
    ):
        value, limit = getattr(workcell.task, key), getattr(workcell.payload, limit_key)
        if problems.clean(f"task.{key}", f"payload.{limit_key}") and value > limit:
            problems.add(
                f"task.{key}",
                f"found {value:g}; allowed is at most payload.{limit_key} = {limit:g}",
            )


def check_reach(workcell: Workcell, problems: Problems) -> None:
    """Record a problem for each fixed pose that is farther away than the stretched length of an
    arm.

    Poses that pass may still be out of reach: no inverse kinematics is computed.
    """
    poses = [(path, pose) for path, pose in _fixed_poses(workcell) if problems.clean(path)]
    for index, (robot, contact) in enumerate(zip(workcell.robots, workcell.contacts, strict=True)):
        needed = [f"robots[{index}].{part}" for part in (*ARM_KEYS, "flange", "base", "pad")]
        if not problems.clean(*SHAPE_KEYS, f"contacts[{index}]", *needed):
            continue
        shoulder, length = stretched_length(robot)
        T_box_flange = contact.T_box_pad @ inverse(robot.T_flange_pad)
        for path, pose in poses:
            flange = (box_placement(workcell.task.orientation, pose) @ T_box_flange)[:3, 3]
            distance = float(np.linalg.norm(flange - shoulder))
            if distance > length + REACH_SLACK:
                where = ", ".join(f"{entry:.3f}" for entry in flange)
                box = ", ".join(f"{entry:g}" for entry in pose[:3])
                problems.add(
                    path,
                    f"the box at ({box}) m is out of reach: the flange of robot {robot.name!r} "
                    f"has to stand at ({where}) m, {distance:.3f} m from its first joint; allowed "
                    f"is {length:.3f} m, its links stretched out (look at robots[{index}].base, "
                    f"robots[{index}].pad and contacts[{index}] as well)",
                )


def stretched_length(robot: Robot) -> tuple[Array, float]:
    """Return the position (3,) of an arm's first joint in the world and an upper bound of its reach
    [m].

    The bound is the sum of the distances from joint to joint and to the flange, and of the
    travels of sliding joints.

    Raises:
        RobotModelError: the robot's model is not a serial arm.
    """
    model = arm_model(robot)
    shoulder = robot.T_world_base @ np.append(model.jointPlacements[1].translation, 1.0)
    slides = sum(
        max(abs(low), abs(high))
        for turns, low, high in zip(
            turning_joints(model), robot.position_lower, robot.position_upper, strict=True
        )
        if not turns
    )
    return shoulder[:3], float(link_lengths(model, robot.flange).sum() + slides)


def _fixed_poses(workcell: Workcell) -> Iterator[tuple[str, Array]]:
    waypoints = workcell.task.waypoints
    yield "task.start", waypoints[0].lower
    for waypoint in waypoints[1:-1]:
        if waypoint.is_fixed:
            yield "task.waypoints", waypoint.lower
    yield "task.goal", waypoints[-1].lower


def check_all(workcell: Workcell, problems: Problems, reach: bool) -> None:
    """Make all checks of a workcell that need values of several sections but no inverse kinematics.

    Args:
        workcell: the workcell.
        problems: collector of problems.
        reach: True to check that fixed poses are within the arms' reach.
    """
    checks: tuple[Callable[[Workcell, Problems], None], ...] = (
        check_machine,
        check_shapes,
        check_names,
        check_contacts,
        check_uncertainty,
        check_references,
        check_speeds,
    )
    for check in (*checks, check_reach) if reach else checks:
        try:
            check(workcell, problems)
        except RobotModelError as error:  # pragma: no cover - the robots section reports it first
            if problems.clean("robots"):
                problems.add("robots", str(error))
