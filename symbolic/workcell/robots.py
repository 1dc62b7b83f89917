"""The robots section of a workcell file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pinocchio as pin

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError, RobotModelError, UrdfError
from symbolic.robot.packages import further_package_dirs
from symbolic.robot.srdf_file import read_srdf
from symbolic.robot.urdf import (
    N_JOINTS,
    flange_problem,
    reduced_model,
    resolve_mesh,
    structure_problem,
)
from symbolic.robot.urdf_file import Urdf, read_urdf
from symbolic.robot.xacro_file import Arguments, is_xacro
from symbolic.workcell import quantities as quantity
from symbolic.workcell.reader import Quantity, Table, read_only, shown
from symbolic.workcell.records import Robot
from symbolic.workcell.sections import read_body, read_file, read_pose

# Joint accelerations are rarely published; this is slow for an arm of this class.
DEFAULT_ACCELERATION = 5.0  # [rad/s^2]
DEFAULT_MIN_MANIPULABILITY = 0.005  # [m^3], exceeded by 9 of 10 random poses of a 1.3 m arm
MAX_START_BRANCH = 1000

_ONES = read_only(np.ones(N_JOINTS))


def read_robot(table: Table, folder: Path, stored: bool = False) -> tuple[Robot, int]:
    """One arm and the index of its start branch (-1: the criterion's choice).

    Args:
        table: its section.
        folder: what paths are relative to.
        stored: whether the cell was unpacked from an archive, see `symbolic.workcell.file.load`.
    """
    problems = table.problems
    name = table.text("name")
    if "/" in name:
        problems.add(table.at("name"), f"found {name!r}; allowed is a name without '/'")
    path = read_file(table, "urdf", folder, outside.URDF_BYTES)
    arguments = _read_xacro_arguments(table)
    package_dirs = _read_folders(table, folder)
    locked = _read_locked(table)
    flange = table.text("flange")
    urdf = _read_urdf(table, path, arguments, package_dirs)
    if arguments and urdf is not None and not stored and not is_xacro(path.read_bytes()):
        problems.add(table.at("xacro_arguments"), f"given for {path.name}, which is no xacro file")
    if urdf is not None and not stored:
        named = (*urdf.collision_meshes, *urdf.visual_meshes)
        package_dirs += further_package_dirs(named, package_dirs, path)
    model = _read_model(table, urdf, locked, flange)
    if urdf is not None:
        _check_meshes(table, urdf, path, package_dirs)
    limits = _read_limits(table, model)
    robot = Robot(
        name=name,
        urdf=path,
        package_dirs=package_dirs,
        flange=flange,
        locked_joints=locked,
        T_world_base=read_pose(table, "base"),
        T_flange_pad=read_pose(table, "pad"),
        tool=tuple(read_body(entry, folder) for entry in table.tables("tool")),
        position_lower=limits["position_lower"],
        position_upper=limits["position_upper"],
        velocity_max=limits["velocity_max"],
        acceleration_max=limits["acceleration_max"],
        torque_max=limits["torque_max"],
        min_manipulability=table.number(
            "min_manipulability", quantity.MANIPULABILITY, DEFAULT_MIN_MANIPULABILITY
        ),
        xacro_arguments=arguments,
        srdf=_read_srdf(table, folder),
    )
    branch = table.integer("start_branch", -1, MAX_START_BRANCH, -1)
    table.close()
    return robot, branch


def _read_folders(table: Table, folder: Path) -> tuple[Path, ...]:
    value = table.raw("package_dirs", [])
    path = table.at("package_dirs")
    if not isinstance(value, list):
        table.problems.add(path, f"found {shown(value)}; allowed is an array of folders")
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


def _read_locked(table: Table) -> tuple[tuple[str, float], ...]:
    inner = table.table("locked_joints", {})
    return tuple((name, inner.number(name, quantity.LOCKED_POSITION)) for name in inner)


def _read_xacro_arguments(table: Table) -> tuple[tuple[str, str], ...]:
    inner = table.table("xacro_arguments", {})
    return tuple((name, inner.text(name)) for name in inner)


def _read_srdf(table: Table, folder: Path) -> Path | None:
    if "srdf" not in table:
        table.raw("srdf", None)
        return None
    path = read_file(table, "srdf", folder, outside.URDF_BYTES)
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


def _read_model(
    table: Table, urdf: Urdf | None, locked: tuple[tuple[str, float], ...], flange: str
) -> pin.Model | None:
    """The arm's model, or recorded problems and None."""
    problems = table.problems
    if urdf is None or not problems.clean(table.at("locked_joints")):
        return None
    try:
        reduced_model(urdf)
    except RobotModelError as error:
        problems.add(table.at("urdf"), str(error))
        return None
    try:
        model = reduced_model(urdf, locked)
    except RobotModelError as error:
        problems.add(table.at("locked_joints"), str(error))
        return None
    problem = structure_problem(model)
    if problem:
        problems.add(table.at("urdf"), problem)
        return None
    if problems.clean(table.at("flange")):
        problem = flange_problem(model, flange)
        if problem:
            problems.add(table.at("flange"), problem)
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


def _read_limits(table: Table, model: pin.Model | None) -> dict[str, Array]:
    """The limits, from the file or else from the URDF; (6,) each."""
    from_urdf: dict[str, Array | None] = {
        "position_lower": None if model is None else model.lowerPositionLimit,
        "position_upper": None if model is None else model.upperPositionLimit,
        "velocity_max": None if model is None else model.velocityLimit,
        "torque_max": None if model is None else model.effortLimit,
        "acceleration_max": np.full(N_JOINTS, DEFAULT_ACCELERATION),
    }
    allowed = {
        "position_lower": quantity.JOINT_POSITION,
        "position_upper": quantity.JOINT_POSITION,
        "velocity_max": quantity.ANGULAR_SPEED,
        "torque_max": quantity.TORQUE,
        "acceleration_max": quantity.ANGULAR_ACCELERATION,
    }
    limits = {key: _limit(table, key, allowed[key], from_urdf[key]) for key in allowed}
    problems = table.problems
    if model is not None and problems.clean(table.at("position_lower"), table.at("position_upper")):
        for joint in range(N_JOINTS):
            low, high = limits["position_lower"][joint], limits["position_upper"][joint]
            if low >= high:
                problems.add(
                    f"{table.at('position_lower')}[{joint}]",
                    f"found {low:g} rad for joint {model.names[joint + 1]!r}, not below its upper "
                    f"limit {high:g} rad; allowed is lower < upper",
                )
    return limits


def _limit(table: Table, key: str, allowed: Quantity, urdf_value: Array | None) -> Array:
    if key in table:
        # One number for all joints is right for a bound on magnitude, not for a range's end.
        return table.vector(key, (allowed,) * N_JOINTS, scalar_fills=not key.startswith("position"))
    table.raw(key, None)
    if urdf_value is None:
        return _ONES
    for joint, value in enumerate(urdf_value):
        if not allowed.contains(float(value)):
            table.problems.add(
                table.at(key),
                f"the URDF gives {value:g} for joint {joint + 1}; allowed is {allowed.allowed()}"
                f"{allowed.suspicion(float(value))}; correct the URDF or give {key} here",
            )
            return _ONES
    return read_only(urdf_value)
