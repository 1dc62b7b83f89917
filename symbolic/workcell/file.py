"""Reading a workcell from a TOML file. docs/workcell.md describes every key."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from symbolic import outside
from symbolic.errors import OutsideError, WorkcellError
from symbolic.robot.urdf import resolve_mesh, robot_urdf
from symbolic.robot.xacro_file import description_content
from symbolic.workcell.branches import with_branches
from symbolic.workcell.checks import check_all
from symbolic.workcell.contacts import check_count, read_contact
from symbolic.workcell.handling import read_handling
from symbolic.workcell.identity import reading_of
from symbolic.workcell.payload import read_payload
from symbolic.workcell.problems import Problems
from symbolic.workcell.reader import Table
from symbolic.workcell.records import SEARCHED, Body, Mesh, Payload, Robot, Workcell
from symbolic.workcell.redundancy import read_redundant, with_redundancy
from symbolic.workcell.robots import read_robot
from symbolic.workcell.sections import read_body, read_collision
from symbolic.workcell.task import read_task, with_force_limit
from symbolic.workcell.uncertainty import read_uncertainty

Check = Callable[[Workcell], Iterable[str]]


def load(
    path: str | Path,
    checks: Sequence[Check] = (),
    stored: bool = False,
    decided: tuple[int, int] = (SEARCHED, SEARCHED),
) -> Workcell:
    """The workcell that a TOML file describes.

    Args:
        path: the file; every path inside it is relative to its folder.
        checks: further checks of an otherwise valid workcell, e.g. inverse kinematics at the
            start; each yields its problems as `key.path: what was found; what is allowed`.
        stored: whether it was unpacked from an archive: packages that `package_dirs` lacks are
            not looked for on this machine, and xacro files were expanded before.
        decided: per robot the start branch that takes the place of "search" in the file.

    Raises:
        WorkcellError: with all problems of the file, each with its key path.
    """
    path = Path(path)
    try:
        source = outside.resolved(path)
        content = outside.read_bytes(source, outside.WORKCELL_BYTES)
        content = with_branches(content, outside.toml_tables(content), decided)
        data = outside.toml_tables(content)
    except OutsideError as error:
        raise WorkcellError(str(path), (f"file: {error}",)) from error
    problems = Problems()
    workcell = _build(Table(data, "", problems), source, content, stored)
    if workcell is None or problems.found:
        raise WorkcellError(str(path), problems.messages())
    further = tuple(problem for check in checks for problem in check(workcell))
    if further:
        raise WorkcellError(str(path), further)
    return workcell


def _build(table: Table, source: Path, content: bytes, stored: bool) -> Workcell | None:
    """The records, as far as they can be built; None where a section has the wrong count."""
    problems, folder = table.problems, source.parent
    name = table.text("name")
    robots = [read_robot(entry, folder, stored) for entry in table.tables("robots", exactly=2)]
    payload = read_payload(table.table("payload"), folder)
    contacts = [read_contact(entry, payload) for entry in table.tables("contacts", exactly=2)]
    check_count(contacts, problems)
    task_table = table.table("task")
    task = read_task(task_table)
    redundant = read_redundant(task_table, len(task.waypoints))
    task_table.close()
    environment = tuple(read_body(entry, folder) for entry in table.tables("environment"))
    collision = read_collision(table.table("collision", {}))
    uncertainty = read_uncertainty(table.table("uncertainty", {}))
    handling = read_handling(table.table("handling", {}))
    table.close()
    if len(robots) != 2 or len(contacts) != 2:
        return None
    arms = [robot for robot, _ in robots]
    try:
        identity = "" if problems.found else digest(content, arms, environment, payload)
    except OutsideError as error:
        problems.add("file", str(error))
        identity = ""
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
    check_all(workcell, problems)
    workcell = with_redundancy(workcell, redundant, problems)
    return replace(workcell, reading=reading_of(workcell, identity)) if identity else workcell


def digest(
    content: bytes,
    robots: Sequence[Robot],
    environment: Sequence[Body],
    payload: Payload | None = None,
) -> str:
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
    for part in _named(robots, environment, payload):
        room -= len(part)
        if room < 0:
            raise OutsideError(
                "the files that it names are together larger than "
                f"{outside.megabytes(outside.CELL_BYTES)}; simplify the meshes"
            )
        outer.update(hashlib.sha256(part).digest())
    return outer.hexdigest()


def _content(path: Path | None, most: int) -> bytes:
    if path is None:
        return b""
    try:
        return outside.read_bytes(path, most)
    except OutsideError as error:
        raise OutsideError(f"names {path.name}, which {error}") from error


def _named(
    robots: Sequence[Robot], environment: Sequence[Body], payload: Payload | None
) -> Iterator[bytes]:
    """The content of every file that a workcell names, nothing for a missing one."""
    for robot in robots:
        yield description_content(robot.urdf, robot.xacro_arguments, robot.package_dirs)
        urdf = robot_urdf(robot)
        for address in (*urdf.collision_meshes, *urdf.visual_meshes):
            mesh = resolve_mesh(address, robot.urdf, robot.package_dirs)
            yield _content(mesh, outside.MESH_BYTES)
        if robot.srdf is not None:
            yield _content(robot.srdf, outside.URDF_BYTES)
    for body in (*(body for robot in robots for body in robot.tool), *environment):
        if isinstance(body.shape, Mesh):
            yield _content(body.shape.path, outside.MESH_BYTES)
    if payload is not None and isinstance(payload.shape, Mesh):
        yield _content(payload.shape.path, outside.MESH_BYTES)
