"""Robots section of a workcell file: descriptions, arms, limits, tools.

A robot may be given by a name, if a Python package has or downloads its description. A name that
ends in `_description` is a module of the package `robot_descriptions`, which clones the repository
with the files on first use. Any other name is a file of `example-robot-data`, whose wheel contains
the files.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from symbolic import safe_io
from symbolic.array import Array, Range
from symbolic.errors import OutsideError, RobotModelError, UrdfError
from symbolic.read.arms import (
    FOLLOWING,
    Positions,
    RobotModelWarning,
    flange_problem,
    held_joints,
    moving_joints,
    reduced_model,
    structure_problem,
    usual_manipulability,
    without_links,
)
from symbolic.read.descriptions import (
    PACKAGE_SCHEME,
    RELATIVE,
    Arguments,
    find_package,
    further_package_dirs,
    is_xacro,
    nominal_kinematics,
    resolve_mesh,
    takes_arguments,
)
from symbolic.read.tables import TableReader, read_body, read_file, read_inertia, read_pose
from symbolic.read.urdf import LARGEST_GYRATION, Urdf, read_srdf, read_urdf
from symbolic.records import SEARCHED_BRANCH, Driver, Robot, ToolLoad
from symbolic.records import quantities as quantity
from symbolic.records.poses import read_only
from symbolic.records.problems import shown, suggestion

# Joint accelerations are rarely published; this is slow for an arm of this class.
DEFAULT_ACCELERATION = 5.0  # [rad/s^2]
MAX_START_BRANCH = 1000


def read_robot(table: TableReader, folder: Path, stored: bool = False) -> tuple[Robot, int]:
    """Read one arm, and the index of its start branch.

    Args:
        table: the arm's section of the workcell file.
        folder: folder to which paths in the section are relative.
        stored: True if the cell was unpacked from an archive.

    Returns:
        The arm, and the index of the start branch, the posture in which the arm holds the box at
        the start. The index is -1 if the project ranks the postures and takes the best, -2 if the
        file says "search".
    """
    name = table.text("name")
    if "/" in name:
        table.add("name", f"found {name!r}; allowed is a name without '/'")
    described, model = _read_description(table, folder, stored)
    branch = SEARCHED_BRANCH
    if table.raw("start_branch", -1) != "search":
        branch = table.integer("start_branch", -1, MAX_START_BRANCH, -1)
    tool_load = None
    if table.has("tool_load"):
        inner = table.table("tool_load")
        mass = inner.number("mass", quantity.MASS)
        inertia = {}
        if inner.has("inertia"):
            inertia["inertia"] = read_inertia(inner, mass * LARGEST_GYRATION**2)
        tool_load = inner.record(ToolLoad, mass=mass, **inertia)
    limits = _read_limits(table, model)
    driver = table.table("driver", {}).record(Driver)
    usual = {}
    if not table.has("min_manipulability"):
        is_arm = model is not None and table.clean("chain", "flange")
        flange = described["flange"]
        usual["min_manipulability"] = usual_manipulability(model, flange) if is_arm else 1.0
    robot = table.record(
        Robot,
        name=name,
        T_world_base=read_pose(table, "base"),
        T_flange_pad=read_pose(table, "pad"),
        tool=tuple(read_body(entry, folder) for entry in table.tables("tool")),
        tool_load=tool_load,
        redundant_joints=_read_redundant(table, model),
        driver=driver,
        **described,
        **limits,
        **usual,
    )
    return robot, branch


def _read_redundant(table: TableReader, model: pin.Model | None) -> tuple[str, ...]:
    """Read the names of an arm's redundant joints; () if the file names none.

    Args:
        table: the arm's section of the workcell file.
        model: model of the arm; None after problems.
    """
    names = table.texts("redundant_joints", "names of joints")
    if model is None or not names:
        return names
    beyond, joints = model.nq - FOLLOWING, list(model.names)[1:]
    unknown = [name for name in names if name not in joints]
    if unknown or len(set(names)) != beyond:
        told = f"{unknown[0]!r}, which is none of them" if unknown else f"{len(set(names))} names"
        table.add(
            "redundant_joints",
            f"found {told}; allowed are {beyond} of the {len(joints)} joints: {', '.join(joints)}",
        )
    return names


LIMIT_KEYS = {
    "position_lower": ("lowerPositionLimit", quantity.JOINT_POSITION),
    "position_upper": ("upperPositionLimit", quantity.JOINT_POSITION),
    "velocity_max": ("velocityLimit", quantity.JOINT_SPEED),
    "torque_max": ("effortLimit", quantity.TORQUE),
    "acceleration_max": ("", quantity.ANGULAR_ACCELERATION),
    "jerk_max": ("", quantity.ANGULAR_JERK),
}
"""Limits of joints by key: Pinocchio's name if descriptions have the limit, and the allowed
range."""


UNKNOWN_TORQUE = "unknown"
"""Value of `torque_max` for unpublished torques."""


@cache
def _warn_unjudged(robot: str) -> None:
    """Warn once that the file states no torque limits for the robot called `robot`, so that its
    joint torques are not checked."""
    warnings.warn(
        f'robot {robot!r} has torque_max = "{UNKNOWN_TORQUE}": no carry, timing or job is judged '
        "by the torques of its joints, and tables show no use of them",
        RobotModelWarning,
        stacklevel=2,
    )


def _read_limits(table: TableReader, model: pin.Model | None) -> dict[str, Array | None]:
    """Read the limits of an arm's n joints: from the file, else from the robot's description.

    Args:
        table: the arm's section of the workcell file.
        model: model of the arm; None after problems.

    Returns:
        Arrays (n,) by the names of the keys, which are attributes of `symbolic.records.Robot`; None
        for a limit on jerk that is not stated.
    """
    n, found = FOLLOWING if model is None else model.nq, dict[str, Array | None]()
    for key, (own, allowed) in LIMIT_KEYS.items():
        if key == "torque_max" and table.raw(key, None) == UNKNOWN_TORQUE:
            found[key] = read_only(np.full(n, np.inf))
            _warn_unjudged(table.text("name"))
        elif table.has(key):
            # One number for all joints is right for a bound on magnitude, not for a range's end.
            filling = not key.startswith("position")
            found[key] = table.vector(key, (allowed,) * n, filling=filling)
        elif own and model is not None:
            found[key] = _described_limit(table, key, allowed, getattr(model, own))
        else:
            usual = None if key == "jerk_max" else DEFAULT_ACCELERATION
            found[key] = None if usual is None else read_only(np.full(n, usual))
    lower, upper = found["position_lower"], found["position_upper"]
    if model is not None and table.clean("position_lower", "position_upper"):
        for joint, (low, high) in enumerate(zip(lower, upper, strict=True)):  # type: ignore[arg-type]
            if low >= high:
                table.add(
                    f"position_lower[{joint}]",
                    f"found {low:g} rad for joint {model.names[joint + 1]!r}, not below its upper "
                    f"limit {high:g} rad; allowed is lower < upper",
                )
    return found


def _described_limit(table: TableReader, key: str, allowed: Range, values: Array) -> Array:
    for joint, value in enumerate(values.tolist(), 1):
        if not allowed.contains(value):
            more = f', or {key} = "{UNKNOWN_TORQUE}" to judge without torques' * (
                key == "torque_max"
            )
            table.add(
                key,
                f"the description gives {value:g} for joint {joint}; allowed is "
                f"{allowed.allowed()}{allowed.suspicion(value)}; correct it, or give {key} here"
                f"{more}",
            )
            return read_only(np.ones(len(values)))
    return read_only(values)


# --- the description that a section names ---


MOST_FOLDERS = 100
"""Largest number of package folders of a robot, since every mesh is looked for in each."""


def _read_description(
    table: TableReader, folder: Path, stored: bool
) -> tuple[dict[str, Any], pin.Model | None]:
    """Read the keys that describe an arm.

    Args:
        table: the robot's section.
        folder: folder to which paths in the section are relative.
        stored: whether the cell was unpacked from an archive.

    Returns:
        The values as fields of `symbolic.records.Robot`, and the arm's model, None after problems.
    """
    package_dirs = _read_folders(table, folder)
    own = table.table("xacro_arguments", {})
    arguments = tuple((name, _argument(own.text(name), folder)) for name in own)
    if table.has("robot"):
        named = _read_named(table)
        path, package_dirs = named.path, package_dirs + named.package_dirs
        arguments = tuple((dict(named.arguments) | dict(arguments)).items())
    else:
        path = _read_described(table, "urdf", folder, package_dirs)
    locked = table.table("locked_joints", {})
    held = tuple((name, locked.number(name, quantity.LOCKED_POSITION)) for name in locked)
    root, flange = _read_chain(table)
    drop_links = table.texts("drop_links", "names or patterns of links")
    urdf: Urdf | None = None
    if table.clean("urdf", "xacro_arguments", "package_dirs"):
        with _recorded(table, "urdf"):
            urdf = read_urdf(path, arguments, package_dirs)
    if urdf is not None and not stored:
        _check_arguments(table, path, arguments)
    if urdf is not None and drop_links:
        kept, urdf = urdf, None
        with _recorded(table, "drop_links"):
            urdf = without_links(kept, drop_links)
    model = None
    if urdf is not None:
        if not stored:
            addresses = (*urdf.collision_meshes, *urdf.visual_meshes)
            package_dirs += further_package_dirs(addresses, package_dirs, path)
        if table.clean("locked_joints", "chain"):
            model = _read_model(table, urdf, held, root, flange)
        _check_meshes(table, urdf, path, package_dirs)
    srdf = None
    if table.has("srdf"):
        srdf = _read_described(table, "srdf", folder, package_dirs)
        if table.clean("srdf"):
            with _recorded(table, "srdf"):
                read_srdf(srdf)
    described = {
        "urdf": path,
        "package_dirs": package_dirs,
        "xacro_arguments": arguments,
        "srdf": srdf,
        "chain_root": root,
        "flange": flange,
        "locked_joints": held,
        "drop_links": drop_links,
    }
    return described, model


def _check_arguments(table: TableReader, path: Path, arguments: Arguments) -> None:
    """Record a problem if xacro arguments are given for a file that takes none.

    Warn if the argument with the arm's calibration is missing or nominal.

    Args:
        table: the arm's section of the workcell file.
        path: path of the robot's description.
        arguments: the xacro arguments, by name.
    """
    content = safe_io.read_bytes(path, safe_io.URDF_BYTES)
    if arguments and not takes_arguments(content):
        table.add("xacro_arguments", f"given for {path.name}, which is no xacro file")
    name = nominal_kinematics(content, arguments) if is_xacro(content) else ""
    if name:
        _warn_nominal(table.text("name"), name)


@cache
def _warn_nominal(robot: str, argument: str) -> None:
    """Warn once that the calibration of `robot`, a xacro argument called `argument`, is not
    given."""
    warnings.warn(
        f"robot {robot!r} has its maker's nominal kinematics; name the file of the arm's own "
        f"calibration by xacro_arguments.{argument}",
        RobotModelWarning,
        stacklevel=2,
    )


def _argument(value: str, folder: Path) -> str:
    """Return the value of a xacro argument. A value that begins like a relative path is resolved
    relative to `folder`; any other value is returned unchanged."""
    return str((folder / value).resolve()) if value.startswith(RELATIVE) else value


@contextmanager
def _recorded(table: TableReader, key: str) -> Iterator[None]:
    """Record errors that are raised in the `with` block as problems of one value in a table,
    instead of raising them.

    Args:
        table: the table.
        key: key of the value.
    """
    try:
        yield
    except UrdfError as error:
        for problem in error.problems:
            table.add(key, f"{error.file}: {problem}")
    except (RobotModelError, OutsideError) as error:
        table.add(key, str(error))


def _read_named(table: TableReader) -> NamedRobot:
    """Return the files of the robot description that the key 'robot' names. A problem is recorded
    at the key 'urdf', and the result is then empty."""
    name = table.text("robot")
    if table.has("urdf"):
        table.add("urdf", "found beside 'robot'; give one of the two")
    elif not name:
        table.add("urdf", "is missing; 'robot' gives none")
    else:
        try:
            return named_robot(name)
        except OutsideError as error:
            table.add("urdf", f"robot = {shown(name)} {error}")
    return NamedRobot(Path(), (), ())


def _read_folders(table: TableReader, folder: Path) -> tuple[Path, ...]:
    value = table.raw("package_dirs", [])
    if not isinstance(value, list):
        table.add("package_dirs", f"found {shown(value)}; allowed is an array of folders")
        return ()
    if len(value) > MOST_FOLDERS:
        table.add("package_dirs", f"found {len(value)} folders; allowed are {MOST_FOLDERS}")
        return ()
    folders = []
    for index, entry in enumerate(value):
        if isinstance(entry, str) and os.path.isdir(folder / entry):
            folders.append((folder / entry).resolve())
        else:
            table.add(
                f"package_dirs[{index}]",
                f"found {shown(entry)}; allowed is a folder, its path relative to the workcell "
                "file",
            )
    return tuple(folders)


def _read_described(
    table: TableReader, key: str, folder: Path, package_dirs: tuple[Path, ...]
) -> Path:
    """Read the path of a robot's file; after a problem return `folder`. The file states a relative
    path or an address package://NAME/...

    Args:
        table: the arm's section of the workcell file.
        key: key of the path.
        folder: folder to which a path is relative.
        package_dirs: folders of packages for an address.
    """
    address = table.raw(key, None)
    if not isinstance(address, str) or not address.startswith(PACKAGE_SCHEME):
        return read_file(table, key, folder, safe_io.URDF_BYTES)
    name, _, rest = address.removeprefix(PACKAGE_SCHEME).partition("/")
    package = find_package(name, package_dirs, folder / "workcell")
    if package is None or ".." in rest.split("/"):
        table.add(
            key,
            f"found {shown(address)}, in no package that is found; packages are looked up in "
            "package_dirs, ROS_PACKAGE_PATH, AMENT_PREFIX_PATH and the Python environment",
        )
        return folder
    return read_file(table, key, folder, safe_io.URDF_BYTES, package / rest)


def _read_chain(table: TableReader) -> tuple[str, str]:
    """Read the names of the links at which the arm begins and ends, from the key 'chain' or
    'flange'.

    The first name is '' if the file states the flange only. Both are '' after a problem.
    """
    if not table.has("chain"):
        return "", table.text("flange")
    table.refuse("chain", ("flange",))
    links = table.texts("chain", "two links, root and tip")
    if len(links) == 2 and links[0] != links[1]:
        return links[0], links[1]
    if table.clean("chain"):
        table.add("chain", f"found {shown(list(links))}; allowed are two links, root and tip")
    return "", ""


def _read_model(
    table: TableReader, urdf: Urdf, locked: Positions, root: str, flange: str
) -> pin.Model | None:
    """Build the arm's model, and record problems of the description, the chain and the flange.

    Args:
        table: the robot's section.
        urdf: the robot's description.
        locked: joints that the user holds, with their positions [rad or m].
        root, flange: links at which the arm begins and ends; root '' for the whole description.

    Returns:
        The model; None if it cannot be built or is not a serial arm.
    """
    moving: tuple[str, ...] | None = None
    model: pin.Model | None = None
    with _recorded(table, "urdf"):
        reduced_model(urdf)
        with _recorded(table, "chain"):
            moving = moving_joints(urdf, root, flange, locked)
    if moving is not None:
        with _recorded(table, "locked_joints"):
            model = reduced_model(urdf, held_joints(urdf, moving, locked))
    if model is None:
        return None
    if problem := structure_problem(model):
        table.add("chain" if root else "urdf", problem)
        return None
    if table.clean("flange") and (problem := flange_problem(model, flange)):
        table.add("chain" if root else "flange", problem)
    return model


def _check_meshes(
    table: TableReader, urdf: Urdf, file: Path, package_dirs: tuple[Path, ...]
) -> None:
    for address in urdf.collision_meshes:
        path = resolve_mesh(address, file, package_dirs)
        problem = (
            "does not exist; package:// addresses are looked up in the folders of package_dirs, of "
            "ROS_PACKAGE_PATH and AMENT_PREFIX_PATH and of the Python environment, others beside "
            "the URDF"
        )
        if path is not None:
            try:
                safe_io.require(path, safe_io.MESH_BYTES)
                continue
            except OutsideError as error:
                problem = str(error)
        table.add("urdf", f"the collision mesh {shown(address)} that it names {problem}")


# --- descriptions by name ---


MODULES = "robot_descriptions"
FILES = "example-robot-data"

_ROBOT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}")


@dataclass(frozen=True)
class NamedRobot:
    """Files of a robot description that a package has on this machine.

    Attributes:
        path: the URDF or xacro file.
        arguments: arguments of the xacro file.
        package_dirs: folders of packages that the URDF or xacro file names.
    """

    path: Path
    arguments: Arguments
    package_dirs: tuple[Path, ...]


def named_robot(name: str) -> NamedRobot:
    """Return the files of the robot description called `name`; download them if necessary.

    Raises:
        OutsideError: no description has this name, a package is missing, or the download failed.
    """
    if not _ROBOT_NAME.fullmatch(name):
        raise OutsideError("is no name; allowed are letters, digits, '_' and '-'", code="no-name")
    return _downloaded(name) if name.endswith("_description") else _installed(name)


def _installed(name: str) -> NamedRobot:
    folder = find_package(FILES, (), Path("/"))
    if folder is None:
        raise OutsideError(
            f"is looked for in a package that is missing: pip install {FILES}; names that end in "
            f"_description are those of {MODULES}"
        )
    known = {path.stem: path for path in sorted((folder / "robots").rglob("*.urdf"))}
    named = [known[stem] for stem in (name, f"{name}_robot") if stem in known]
    path = next(filter(_has_links, named), None)
    if path is None:
        meant = (
            "; the file of this name has no links"
            if named
            else suggestion(name, known) or f"; {FILES} has {', '.join(known)}"
        )
        raise OutsideError(f"is the name of no description{meant}", code="unknown-description")
    return NamedRobot(path, (), (folder.parent,))


def _has_links(path: Path) -> bool:
    """Return True if a file describes at least one link. Some packages contain empty files."""
    return b"<link" in safe_io.read_bytes(path, safe_io.URDF_BYTES)


def _downloaded(name: str) -> NamedRobot:
    if find_spec(MODULES) is None:
        raise OutsideError(
            f'is looked for in a package that is missing: pip install "dual-arm-carry[robots]" '
            f"({MODULES})"
        )
    if find_spec(f"{MODULES}.{name}") is None:
        raise OutsideError(
            f"is the name of no description of {MODULES}{suggestion(name, _modules())}; "
            f"python -m {MODULES} list shows all",
            code="unknown-description",
        )
    try:
        with redirect_stdout(sys.stderr):  # it prints the repository that it clones
            module = import_module(f"{MODULES}.{name}")
    except Exception as error:  # of git, of the network, of the file system
        reason = " ".join(str(error).split())[-300:]
        raise OutsideError(
            f"cannot be downloaded; is the network reachable, and git installed? ({reason})",
            code="no-download",
        ) from error
    found = [getattr(module, f"{kind}_PATH", None) for kind in ("URDF", "XACRO", "MJCF")]
    path = next(filter(None, found), None)
    if path is None:
        raise OutsideError("has neither URDF nor MJCF; name a description that has")
    arguments = {} if found[0] else getattr(module, "XACRO_ARGS", {})
    package, repository = Path(module.PACKAGE_PATH), Path(module.REPOSITORY_PATH)
    folders = dict.fromkeys((package.parent, repository, repository.parent))
    named = tuple((str(key), str(value)) for key, value in arguments.items())
    return NamedRobot(Path(path), named, tuple(folders))


def _modules() -> Iterator[str]:
    folder = Path(str(find_spec(MODULES).origin)).parent  # type: ignore[union-attr]
    return (path.stem for path in sorted(folder.glob("*_description.py")))
