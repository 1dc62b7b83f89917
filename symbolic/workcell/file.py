"""Reading a workcell from a TOML file. docs/workcell.md describes every key."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from symbolic.errors import WorkcellError
from symbolic.robot.urdf import read_urdf_content, resolve_mesh
from symbolic.workcell.checks import check_all
from symbolic.workcell.reader import Problems, Table
from symbolic.workcell.records import Body, Mesh, Robot, Workcell
from symbolic.workcell.robots import read_robot
from symbolic.workcell.sections import read_body, read_collision, read_contact, read_payload
from symbolic.workcell.task import read_task

Check = Callable[[Workcell], Iterable[str]]


def load(path: str | Path, checks: Sequence[Check] = ()) -> Workcell:
    """The workcell that a TOML file describes.

    Args:
        path: the file; every path inside it is relative to its folder.
        checks: further checks of an otherwise valid workcell, e.g. inverse kinematics at the
            start; each yields its problems as `key.path: what was found; what is allowed`.

    Raises:
        WorkcellError: with all problems of the file, each with its key path.
    """
    path = Path(path)
    content = _read_bytes(path)
    data = _parse(path, content)
    problems = Problems()
    workcell = _build(Table(data, "", problems), path.resolve(), content)
    if workcell is None or problems.found:
        raise WorkcellError(str(path), problems.messages())
    further = tuple(problem for check in checks for problem in check(workcell))
    if further:
        raise WorkcellError(str(path), further)
    return workcell


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        reason = error.strerror or "it is not a file"
        raise WorkcellError(
            str(path), (f"file: cannot be read ({reason}); allowed is a TOML file",)
        ) from error


def _parse(path: Path, content: bytes) -> dict[str, Any]:
    try:
        return tomllib.loads(content.decode("utf-8"))
    except UnicodeDecodeError as error:
        problem = f"file: byte {error.start} is not UTF-8; allowed is TOML in UTF-8"
    except tomllib.TOMLDecodeError as error:
        problem = f"file: not valid TOML: {error}"
    except RecursionError:
        problem = "file: nested too deeply; allowed is the layout of docs/workcell.md"
    raise WorkcellError(str(path), (problem,))


def _build(table: Table, source: Path, content: bytes) -> Workcell | None:
    """The records, as far as they can be built; None where a section has the wrong count."""
    problems, folder = table.problems, source.parent
    name = table.text("name")
    robots = [read_robot(entry, folder) for entry in table.tables("robots", exactly=2)]
    payload = read_payload(table.table("payload"))
    contacts = [read_contact(entry, payload.size) for entry in table.tables("contacts", exactly=2)]
    task = read_task(table.table("task"))
    environment = tuple(read_body(entry, folder) for entry in table.tables("environment"))
    collision = read_collision(table.table("collision", {}))
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
        digest="" if problems.found else digest(content, [r for r, _ in robots], environment),
    )
    check_all(workcell, problems)
    return workcell


def digest(content: bytes, robots: Sequence[Robot], environment: Sequence[Body]) -> str:
    """SHA-256 over a workcell file and the content of every file it names.

    Where the files stand does not matter, only what is in them: the file's own bytes, per robot
    its URDF and the meshes the URDF names, and the meshes of tools and environment, in order.
    """
    parts = [content]
    for robot in robots:
        parts.append(robot.urdf.read_bytes())
        urdf = read_urdf_content(robot.urdf)
        for address in (*urdf.collision_meshes, *urdf.visual_meshes):
            mesh = resolve_mesh(address, robot.urdf, robot.package_dirs)
            parts.append(b"" if mesh is None else mesh.read_bytes())
    bodies = (*(body for robot in robots for body in robot.tool), *environment)
    shapes = (body.shape for body in bodies)
    parts.extend(shape.path.read_bytes() for shape in shapes if isinstance(shape, Mesh))
    outer = hashlib.sha256()
    for part in parts:  # fixed-length inner digests keep the parts apart
        outer.update(hashlib.sha256(part).digest())
    return outer.hexdigest()
