"""The part of a robot's section that names its description and picks the arm from it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import pinocchio as pin

from symbolic import outside
from symbolic.errors import OutsideError, RobotModelError, UrdfError
from symbolic.robot.chain import Held, held_joints, without_links
from symbolic.robot.packages import PACKAGE_SCHEME, find_package, further_package_dirs
from symbolic.robot.srdf_file import read_srdf
from symbolic.robot.urdf import (
    flange_problem,
    moving_joints,
    reduced_model,
    resolve_mesh,
    structure_problem,
)
from symbolic.robot.urdf_file import Urdf, read_urdf
from symbolic.robot.xacro_file import Arguments, is_xacro
from symbolic.workcell import quantities as quantity
from symbolic.workcell.problems import shown
from symbolic.workcell.reader import Table
from symbolic.workcell.sections import read_file

MOST_FOLDERS = 100
"""Most package folders of a robot: every mesh is looked for in each."""


@dataclass(frozen=True)
class Description:
    """What a robot's section says of its description; see `symbolic.workcell.records.Robot`."""

    urdf: Path
    xacro_arguments: Arguments
    package_dirs: tuple[Path, ...]
    srdf: Path | None
    chain_root: str
    flange: str
    locked_joints: Held
    drop_links: tuple[str, ...]


def read_description(
    table: Table, folder: Path, stored: bool
) -> tuple[Description, pin.Model | None]:
    """A robot's description and the arm's model; None after problems.

    Args:
        table: the robot's section.
        folder: what paths are relative to.
        stored: whether the cell was unpacked from an archive, see `symbolic.workcell.file.load`.
    """
    package_dirs = _read_folders(table, folder)
    path = _read_described(table, "urdf", folder, package_dirs)
    arguments = _read_xacro_arguments(table)
    locked = _read_locked(table)
    root, flange = _read_chain(table)
    drop_links = read_texts(table, "drop_links", "names or patterns of links")
    urdf = _read_urdf(table, path, arguments, package_dirs)
    if arguments and urdf is not None and not stored and not is_xacro(path.read_bytes()):
        told = f"given for {path.name}, which is no xacro file"
        table.problems.add(table.at("xacro_arguments"), told)
    urdf = _without(table, urdf, drop_links)
    model = None
    if urdf is not None:
        if not stored:
            named = (*urdf.collision_meshes, *urdf.visual_meshes)
            package_dirs += further_package_dirs(named, package_dirs, path)
        model = _read_model(table, urdf, locked, (root, flange))
        _check_meshes(table, urdf, path, package_dirs)
    srdf = _read_srdf(table, folder, package_dirs)
    found = Description(path, arguments, package_dirs, srdf, root, flange, locked, drop_links)
    return found, model


def _read_folders(table: Table, folder: Path) -> tuple[Path, ...]:
    value = table.raw("package_dirs", [])
    path = table.at("package_dirs")
    if not isinstance(value, list):
        table.problems.add(path, f"found {shown(value)}; allowed is an array of folders")
        return ()
    if len(value) > MOST_FOLDERS:
        table.problems.add(path, f"found {len(value)} folders; allowed are {MOST_FOLDERS}")
        return ()
    folders = []
    for index, entry in enumerate(value):
        if not isinstance(entry, str) or not os.path.isdir(folder / entry):
            table.problems.add(
                f"{path}[{index}]",
                f"found {shown(entry)}; allowed is a folder, its path relative to the workcell "
                "file",
            )
            continue
        folders.append((folder / entry).resolve())
    return tuple(folders)


def _read_locked(table: Table) -> Held:
    inner = table.table("locked_joints", {})
    return tuple((name, inner.number(name, quantity.LOCKED_POSITION)) for name in inner)


def _read_xacro_arguments(table: Table) -> tuple[tuple[str, str], ...]:
    inner = table.table("xacro_arguments", {})
    return tuple((name, inner.text(name)) for name in inner)


def _read_described(table: Table, key: str, folder: Path, package_dirs: tuple[Path, ...]) -> Path:
    """A file named relative to the workcell's folder, or as package://NAME/..."""
    address = table.raw(key, None)
    if not isinstance(address, str) or not address.startswith(PACKAGE_SCHEME):
        return read_file(table, key, folder, outside.URDF_BYTES)
    name, _, rest = address.removeprefix(PACKAGE_SCHEME).partition("/")
    package = find_package(name, package_dirs, folder / "workcell")
    if package is None or ".." in rest.split("/"):
        table.problems.add(
            table.at(key),
            f"found {shown(address)}, in no package that is found; packages are looked up in "
            "package_dirs, ROS_PACKAGE_PATH, AMENT_PREFIX_PATH and the Python environment",
        )
        return folder
    try:
        path = outside.resolved(package / rest)
        outside.require(path, outside.URDF_BYTES)
    except OutsideError as error:
        table.problems.add(table.at(key), f"found {shown(address)}, which {error}")
        return folder
    return path


def _read_srdf(table: Table, folder: Path, package_dirs: tuple[Path, ...]) -> Path | None:
    if "srdf" not in table:
        table.raw("srdf", None)
        return None
    path = _read_described(table, "srdf", folder, package_dirs)
    if table.problems.clean(table.at("srdf")):
        try:
            read_srdf(path)
        except UrdfError as error:
            _tell(table, "srdf", error)
    return path


def _read_urdf(
    table: Table, path: Path, arguments: Arguments, package_dirs: tuple[Path, ...]
) -> Urdf | None:
    """The robot's description, or recorded problems and None."""
    parts = ("urdf", "xacro_arguments", "package_dirs")
    if not table.problems.clean(*(table.at(part) for part in parts)):
        return None
    try:
        return read_urdf(path, arguments, package_dirs)
    except UrdfError as error:
        _tell(table, "urdf", error)
        return None


def _tell(table: Table, key: str, error: UrdfError) -> None:
    for problem in error.problems:
        table.problems.add(table.at(key), f"{error.file}: {problem}")


def _read_chain(table: Table) -> tuple[str, str]:
    """The links that the arm begins and ends at; '' for the first where only a flange is given."""
    if "chain" not in table:
        table.raw("chain", None)
        return "", table.text("flange")
    if "flange" in table:
        table.raw("flange")
        table.problems.add(
            table.at("chain"), "found beside 'flange'; the chain's tip is the flange"
        )
    links = read_texts(table, "chain", "two links, root and tip")
    if len(links) != 2 or links[0] == links[-1]:
        if table.problems.clean(table.at("chain")):
            table.problems.add(
                table.at("chain"),
                f"found {shown(list(links))}; allowed are two links, root and tip",
            )
        return "", ""
    return links[0], links[1]


def read_texts(table: Table, key: str, meaning: str) -> tuple[str, ...]:
    """An array of texts; empty where the key is missing or holds something else."""
    value = table.raw(key, [])
    if not isinstance(value, list) or not all(isinstance(x, str) and x for x in value):
        table.problems.add(
            table.at(key), f"found {shown(value)}; allowed is an array of texts, {meaning}"
        )
        return ()
    return tuple(value)


def _without(table: Table, urdf: Urdf | None, patterns: tuple[str, ...]) -> Urdf | None:
    if urdf is None or not patterns:
        return urdf
    try:
        return without_links(urdf, patterns)
    except RobotModelError as error:
        table.problems.add(table.at("drop_links"), str(error))
        return None


def _read_model(table: Table, urdf: Urdf, locked: Held, chain: tuple[str, str]) -> pin.Model | None:
    """The arm's model, or recorded problems and None."""
    problems, (root, flange) = table.problems, chain
    if not problems.clean(table.at("locked_joints"), table.at("chain")):
        return None
    try:
        reduced_model(urdf)
    except RobotModelError as error:
        problems.add(table.at("urdf"), str(error))
        return None
    try:
        moving = moving_joints(urdf, root, flange, locked)
    except RobotModelError as error:
        problems.add(table.at("chain"), str(error))
        return None
    try:
        model = reduced_model(urdf, held_joints(urdf, moving, locked))
    except RobotModelError as error:
        problems.add(table.at("locked_joints"), str(error))
        return None
    problem = structure_problem(model)
    if problem:
        problems.add(table.at("chain" if root else "urdf"), problem)
        return None
    if problems.clean(table.at("flange")):
        problem = flange_problem(model, flange)
        if problem:
            problems.add(table.at("chain" if root else "flange"), problem)
    return model


def _check_meshes(table: Table, urdf: Urdf, file: Path, package_dirs: tuple[Path, ...]) -> None:
    for address in urdf.collision_meshes:
        path = resolve_mesh(address, file, package_dirs)
        named = f"the collision mesh {shown(address)} that it names"
        if path is None:
            table.problems.add(
                table.at("urdf"),
                f"{named} does not exist; package:// addresses are looked up in the folders of "
                "package_dirs, of ROS_PACKAGE_PATH and AMENT_PREFIX_PATH and of the Python "
                "environment, others beside the URDF",
            )
            continue
        try:
            outside.require(path, outside.MESH_BYTES)
        except OutsideError as error:
            table.problems.add(table.at("urdf"), f"{named} {error}")
