"""Reading a workcell from a TOML file, as it is or with other values. docs/workcell.md describes
every key."""

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

from symbolic import outside
from symbolic.errors import OutsideError, WorkcellError
from symbolic.read.arms import robot_urdf
from symbolic.read.checks import check_all
from symbolic.read.descriptions import description_content, resolve_mesh
from symbolic.read.payload import check_count, read_contact, read_payload
from symbolic.read.robots import read_robot
from symbolic.read.tables import Table, read_body
from symbolic.read.task import read_task, with_force_limit, with_redundancy
from symbolic.records import (
    SEARCHED,
    USUAL,
    CollisionSettings,
    Handling,
    Mesh,
    Uncertainty,
    Workcell,
)
from symbolic.records.cell import reading_of
from symbolic.records.problems import Problems

Check = Callable[[Workcell], Iterable[str]]


def load(
    path: str | Path,
    checks: Sequence[Check] = (),
    stored: bool = False,
    decided: tuple[int, int] = (SEARCHED, SEARCHED),
    text: bytes | None = None,
) -> Workcell:
    """The workcell that a TOML file describes.

    Args:
        path: the file; every path inside it is relative to its folder.
        checks: further checks of an otherwise valid workcell, e.g. inverse kinematics at the
            start; each yields its problems as `key.path: what was found; what is allowed`.
        stored: whether it was unpacked from an archive: packages that `package_dirs` lacks are
            not looked for on this machine, and xacro files were expanded before.
        decided: per robot the start branch that takes the place of "search" in the file.
        text: what to read in the place of the file's content, as if it stood there.

    Raises:
        WorkcellError: with all problems of the file, each with its key path.
    """
    path = Path(path)
    try:
        source = outside.resolved(path)
        content = outside.read_bytes(source, outside.WORKCELL_BYTES) if text is None else text
        data = outside.toml_tables(content)
        settled = with_branches(content, data, decided)
        if settled != content:
            content, data = settled, outside.toml_tables(settled)
    except OutsideError as error:
        raise WorkcellError(str(path), (f"file: {error}",)) from error
    problems = Problems()
    workcell = _build(Table(data, "", problems), source, content, stored)
    if workcell is None or problems.found:
        raise WorkcellError(str(path), problems.messages())
    further = tuple(problem for check in checks for problem in check(workcell))
    if further:
        raise WorkcellError(str(path), further)
    return workcell if text is None else replace(workcell, text=content)


def changed(workcell: Workcell, changes: Mapping[str, Any]) -> Workcell:
    """The workcell with other values of some keys of its file, checked like a file.

    Args:
        workcell: read from a file.
        changes: values by key path, see `symbolic.read.cell.changed_text`.

    Raises:
        WorkcellError: a path leads nowhere, or the changed cell is wrong; the message lists every
            problem.
    """
    source, text = workcell.source, workcell.text
    try:
        known = outside.read_bytes(source, outside.WORKCELL_BYTES) if text is None else text
        if b"search" in known:
            known = with_branches(known, outside.toml_tables(known), workcell.start_branch)
        content = changed_text(known, changes, str(source))
    except OutsideError as error:
        raise WorkcellError(str(source), (f"file: {error}",)) from error
    return load(source, text=content)


def _build(table: Table, source: Path, content: bytes, stored: bool) -> Workcell | None:
    """The records, as far as they can be built; None where a section has the wrong count."""
    problems, folder = table.problems, source.parent
    name = table.text("name")
    robots = [read_robot(entry, folder, stored) for entry in table.tables("robots", exactly=2)]
    payload = read_payload(table.table("payload"), folder)
    contacts = [read_contact(entry, payload) for entry in table.tables("contacts", exactly=2)]
    check_count(contacts, problems)
    task, redundant = read_task(table.table("task"))
    environment = tuple(read_body(entry, folder) for entry in table.tables("environment"))
    collision = table.table("collision", {}).record(CollisionSettings)
    for index, pair in enumerate(collision.ignored):
        # A pattern may stand against itself: all bodies that it matches against one another.
        if pair.first and pair.first == pair.second and not set(pair.first) & {"*", "?"}:
            problems.add(f"collision.ignored[{index}]", f"pairs {pair.first!r} with itself")
    uncertainty = USUAL
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
        task=with_force_limit(task, payload, contacts),
        environment=environment,
        collision=collision,
        start_branch=(robots[0][1], robots[1][1]),
        source=source,
        uncertainty=uncertainty,
        handling=handling,
    )
    try:
        identity = "" if problems.found else _digest(content, workcell)
    except OutsideError as error:
        problems.add("file", str(error))
        identity = ""
    check_all(workcell, problems)
    workcell = with_redundancy(workcell, redundant, problems)
    if workcell.task.pieces > 1 and not problems.found:
        # Not imported at the top: it needs CasADi.
        from symbolic.path.pieces import in_pieces

        workcell = replace(workcell, task=in_pieces(workcell.task))
    return replace(workcell, reading=reading_of(workcell, identity)) if identity else workcell


def _digest(content: bytes, workcell: Workcell) -> str:
    """SHA-256 over a workcell file and the content of every file it names.

    Where the files stand does not matter, only what is in them: the file's own bytes, per robot
    its URDF (a xacro file as it expands), the meshes the URDF names and its SRDF, and the meshes
    of tools, environment and payload, in order.

    Raises:
        OutsideError: one of them cannot be read, or together they are too large.
    """
    outer = hashlib.sha256(hashlib.sha256(content).digest())
    room = outside.CELL_BYTES
    # Fixed-length inner digests keep the parts apart.
    for part in _named(workcell):
        room -= len(part)
        if room < 0:
            raise OutsideError(
                "the files that it names are together larger than "
                f"{outside.megabytes(outside.CELL_BYTES)}; simplify the meshes"
            )
        outer.update(hashlib.sha256(part).digest())
    return outer.hexdigest()


def _named(workcell: Workcell) -> Iterator[bytes]:
    """The content of every file that a workcell names, nothing for a missing one."""
    for robot in workcell.robots:
        yield description_content(robot.urdf, robot.xacro_arguments, robot.package_dirs)
        urdf = robot_urdf(robot)
        for address in (*urdf.collision_meshes, *urdf.visual_meshes):
            mesh = resolve_mesh(address, robot.urdf, robot.package_dirs)
            yield b"" if mesh is None else _content(mesh, outside.MESH_BYTES)
        if robot.srdf is not None:
            yield _content(robot.srdf, outside.URDF_BYTES)
    tools = [body.shape for robot in workcell.robots for body in robot.tool]
    around = [body.shape for body in workcell.environment]
    for shape in (*tools, *around, workcell.payload.shape):
        if isinstance(shape, Mesh):
            yield _content(shape.path, outside.MESH_BYTES)


def _content(path: Path, most: int) -> bytes:
    try:
        return outside.read_bytes(path, most)
    except OutsideError as error:
        raise OutsideError(f"names {path.name}, which {error}") from error


# --- start branches ---


def with_branches(content: bytes, data: Mapping[str, Any], decided: tuple[int, int]) -> bytes:
    """A workcell file's text with start branches in the place of "search", where decided.

    Raises:
        SettingsError: see `symbolic.read.editing.completed`.
    """
    robots = data.get("robots")
    if not isinstance(robots, list) or len(robots) != len(decided):
        return content
    found = [
        {"start_branch": branch} if asks and branch != SEARCHED else {}
        for asks, branch in zip(map(_asks_for_search, robots), decided, strict=True)
    ]
    if not any(found):
        return content
    # Not imported at the top: see the module.
    from symbolic.read.editing import completed

    return completed(outside.text(content), data, {"robots": found}).encode()


def _asks_for_search(robot: Any) -> bool:
    return isinstance(robot, Mapping) and robot.get("start_branch") == "search"


# --- other values ---


_INDEX = re.compile(r"\[(\d+)\]\.?(.*)", re.DOTALL)


def changed_text(content: bytes, changes: Mapping[str, Any], file: str) -> bytes:
    """The text of a workcell file in which some keys have other values; comments are lost.

    Args:
        content: of the file.
        changes: values by key path as in the file: 'payload.mass', 'task.goal'. An array of tables
            is followed by an index or by a table's name, or else every table is meant:
            'contacts[0].friction', 'contacts.friction', 'environment.top board.xyz'.
        file: for messages.

    Raises:
        WorkcellError: with every path that leads nowhere.
        OutsideError: the content is no TOML.
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
    """Its tables, not to be modified: many cells are tried out that differ from one."""
    return outside.toml_tables(content)


def _owners(table: Any, path: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Every table that a key path ends in, and its last key."""
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
    """The same of an array of tables, by an index, a name, or all of them."""
    if found := _INDEX.match(rest):
        k = int(found[1])
        if k < len(tables):
            yield from _owners(tables[k], found[2])
        return
    named = [t for t in tables if rest.startswith(f"{t.get('name')}.")]
    for table in named or tables:
        yield from _owners(table, rest.removeprefix(f"{table['name']}.") if named else rest)


def _plain(value: Any) -> Any:
    """A value as TOML knows it."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, tuple | list) else value
