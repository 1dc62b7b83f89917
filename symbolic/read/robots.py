"""The robots section of a workcell file: descriptions, arms, limits, tools.

Robots may be named: descriptions that Python packages hold or download. A name that ends in
`_description` is a module of the package `robot_descriptions`, which clones the repository with the
files when it is first asked for. Any other is a file of `example-robot-data`, whose wheel holds the
files themselves.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pinocchio as pin

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError, RobotModelError, UrdfError
from symbolic.read.arms import (
    FOLLOWING,
    Positions,
    flange_problem,
    held_joints,
    moving_joints,
    reduced_model,
    structure_problem,
    without_links,
)
from symbolic.read.descriptions import (
    PACKAGE_SCHEME,
    Arguments,
    find_package,
    further_package_dirs,
    is_xacro,
    resolve_mesh,
)
from symbolic.read.tables import Table, read_body, read_file, read_inertia, read_pose
from symbolic.read.urdf import LARGEST_GYRATION, Urdf, read_srdf, read_urdf
from symbolic.records import SEARCHED, Driver, Robot, ToolLoad
from symbolic.records import quantities as quantity
from symbolic.records.poses import read_only
from symbolic.records.problems import shown, suggestion
from symbolic.records.quantities import Quantity

# Joint accelerations are rarely published; this is slow for an arm of this class.
DEFAULT_ACCELERATION = 5.0  # [rad/s^2]
DEFAULT_MIN_MANIPULABILITY = 0.005  # [m^3], exceeded by 9 of 10 random poses of a 1.3 m arm
MAX_START_BRANCH = 1000


def read_robot(table: Table, folder: Path, stored: bool = False) -> tuple[Robot, int]:
    """One arm and the index of its start branch (-1: the criterion's choice, -2: searched for).

    Args:
        table: its section.
        folder: what paths are relative to.
        stored: whether the cell was unpacked from an archive, see `symbolic.read.cell.load`.
    """
    problems = table.problems
    name = table.text("name")
    if "/" in name:
        problems.add(table.at("name"), f"found {name!r}; allowed is a name without '/'")
    described, model = read_description(table, folder, stored)
    limits = _read_limits(table, model)
    robot = Robot(
        name=name,
        urdf=described.urdf,
        package_dirs=described.package_dirs,
        flange=described.flange,
        locked_joints=described.locked_joints,
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
        xacro_arguments=described.xacro_arguments,
        srdf=described.srdf,
        chain_root=described.chain_root,
        drop_links=described.drop_links,
        tool_load=_read_tool_load(table),
        redundant_joints=_read_redundant(table, model),
        jerk_max=_read_jerk(table, len(limits["acceleration_max"])),
        driver=_read_driver(table),
    )
    branch = SEARCHED
    if table.raw("start_branch", -1) != "search":
        branch = table.integer("start_branch", -1, MAX_START_BRANCH, -1)
    table.close()
    return robot, branch


def _read_jerk(table: Table, joints: int) -> Array | None:
    """The joints' largest jerks, where the file states them."""
    if not table.has("jerk_max"):
        return None
    return table.vector("jerk_max", (quantity.ANGULAR_JERK,) * joints, scalar_fills=True)


def _read_redundant(table: Table, model: pin.Model | None) -> tuple[str, ...]:
    """The joints beyond six that the file names; () leaves the choice to the tool."""
    names = read_texts(table, "redundant_joints", "names of joints")
    if model is None or not names:
        return names
    beyond = model.nq - FOLLOWING
    joints = list(model.names)[1:]
    unknown = [name for name in names if name not in joints]
    if unknown or len(set(names)) != beyond:
        told = f"{unknown[0]!r}, which is none of them" if unknown else f"{len(set(names))} names"
        table.problems.add(
            table.at("redundant_joints"),
            f"found {told}; allowed are {beyond} of the {len(joints)} joints: {', '.join(joints)}",
        )
    return names


def _read_tool_load(table: Table) -> ToolLoad | None:
    if not table.has("tool_load"):
        return None
    inner = table.table("tool_load")
    mass = inner.number("mass", quantity.MASS)
    centre = inner.vector("centre_of_mass", (quantity.POSITION,) * 3, default=(0.0, 0.0, 0.0))
    inertia = read_only(np.zeros((3, 3)))
    if inner.has("inertia"):
        inertia = read_inertia(inner, mass * LARGEST_GYRATION**2)
    inner.close()
    return ToolLoad(mass, centre, inertia)


ADDRESS = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.:-]{0,251}[A-Za-z0-9])?")
"""Host names, IPv4 and IPv6 addresses; nothing that ends a string of a robot's language."""

PREFIX = re.compile(r"(?:[A-Za-z][A-Za-z0-9_]{0,39})?")
"""What names of joints may begin with in ROS; '' for nothing."""


def _read_driver(table: Table) -> Driver:
    inner = table.table("driver", {})
    driver = Driver(
        address=_matching(inner, "address", ADDRESS, "a host name or an IP address") or "",
        prefix=_matching(inner, "prefix", PREFIX, "letters, digits, _, with a letter first"),
        rate=inner.number("rate", quantity.RATE) if inner.has("rate") else None,
        lag=inner.number("lag", quantity.LAG, 0.0),
        force_control=inner.flag("force_control"),
    )
    inner.close()
    return driver


def _matching(table: Table, key: str, allowed: re.Pattern[str], meaning: str) -> str | None:
    """A text of a form; None where there is none, or after a problem."""
    value = table.raw(key, None)
    if value is None or (isinstance(value, str) and allowed.fullmatch(value)):
        return value
    table.problems.add(table.at(key), f"found {shown(value)}; allowed: {meaning}")
    return None


def _read_limits(table: Table, model: pin.Model | None) -> dict[str, Array]:
    """The limits, from the file or else from the URDF; (n,) each."""
    n = FOLLOWING if model is None else model.nq
    from_urdf: dict[str, Array | None] = {
        "position_lower": None if model is None else model.lowerPositionLimit,
        "position_upper": None if model is None else model.upperPositionLimit,
        "velocity_max": None if model is None else model.velocityLimit,
        "torque_max": None if model is None else model.effortLimit,
        "acceleration_max": np.full(n, DEFAULT_ACCELERATION),
    }
    allowed = {
        "position_lower": quantity.JOINT_POSITION,
        "position_upper": quantity.JOINT_POSITION,
        "velocity_max": quantity.ANGULAR_SPEED,
        "torque_max": quantity.TORQUE,
        "acceleration_max": quantity.ANGULAR_ACCELERATION,
    }
    limits = {key: _limit(table, key, (allowed[key],) * n, from_urdf[key]) for key in allowed}
    problems = table.problems
    if model is not None and problems.clean(table.at("position_lower"), table.at("position_upper")):
        for joint in range(n):
            low, high = limits["position_lower"][joint], limits["position_upper"][joint]
            if low >= high:
                problems.add(
                    f"{table.at('position_lower')}[{joint}]",
                    f"found {low:g} rad for joint {model.names[joint + 1]!r}, not below its upper "
                    f"limit {high:g} rad; allowed is lower < upper",
                )
    return limits


def _limit(table: Table, key: str, each: tuple[Quantity, ...], urdf_value: Array | None) -> Array:
    if table.has(key):
        # One number for all joints is right for a bound on magnitude, not for a range's end.
        return table.vector(key, each, scalar_fills=not key.startswith("position"))
    if urdf_value is None:
        return read_only(np.ones(len(each)))
    for joint, (value, allowed) in enumerate(zip(urdf_value, each, strict=True)):
        if not allowed.contains(float(value)):
            table.problems.add(
                table.at(key),
                f"the description gives {value:g} for joint {joint + 1}; allowed is "
                f"{allowed.allowed()}{allowed.suspicion(float(value))}; correct it, or give {key} "
                "here",
            )
            return read_only(np.ones(len(each)))
    return read_only(urdf_value)


# --- the description that a section names ---


MOST_FOLDERS = 100
"""Most package folders of a robot: every mesh is looked for in each."""


@dataclass(frozen=True)
class Description:
    """What a robot's section says of its description; see `symbolic.records.Robot`."""

    urdf: Path
    xacro_arguments: Arguments
    package_dirs: tuple[Path, ...]
    srdf: Path | None
    chain_root: str
    flange: str
    locked_joints: Positions
    drop_links: tuple[str, ...]


def read_description(
    table: Table, folder: Path, stored: bool
) -> tuple[Description, pin.Model | None]:
    """A robot's description and the arm's model; None after problems.

    Args:
        table: the robot's section.
        folder: what paths are relative to.
        stored: whether the cell was unpacked from an archive, see `symbolic.read.cell.load`.
    """
    package_dirs = _read_folders(table, folder)
    own = _read_xacro_arguments(table)
    if table.has("robot"):
        found = _read_named(table)
        path, package_dirs = found.path, package_dirs + found.package_dirs
        arguments = tuple((dict(found.arguments) | dict(own)).items())
    else:
        path, arguments = _read_described(table, "urdf", folder, package_dirs), own
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
    return (
        Description(path, arguments, package_dirs, srdf, root, flange, locked, drop_links),
        model,
    )


def _read_named(table: Table) -> NamedRobot:
    """The description of a robot's name; what is wrong stands at the key that it takes the place
    of."""
    name = table.text("robot")
    if table.has("urdf"):
        table.problems.add(table.at("urdf"), "found beside 'robot'; give one of the two")
    elif not name:
        table.problems.add(table.at("urdf"), "is missing; 'robot' gives none")
    else:
        try:
            return named_robot(name)
        except OutsideError as error:
            table.problems.add(table.at("urdf"), f"robot = {shown(name)} {error}")
    return NamedRobot(Path(), (), ())


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


def _read_locked(table: Table) -> Positions:
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
    if not table.has("srdf"):
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
    if not table.has("chain"):
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


def _read_model(
    table: Table, urdf: Urdf, locked: Positions, chain: tuple[str, str]
) -> pin.Model | None:
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


MODULES = "robot_descriptions"
FILES = "example-robot-data"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}")
_KEY = re.compile(r"""(?<![\w.-])robot(\s*=\s*)(["'])([\w-]+)\2""")


@dataclass(frozen=True)
class NamedRobot:
    """A description on this machine.

    Attributes:
        path: the URDF or xacro file.
        arguments: of the xacro file.
        package_dirs: folders that hold the packages that it names.
    """

    path: Path
    arguments: Arguments
    package_dirs: tuple[Path, ...]


def named_robot(name: str) -> NamedRobot:
    """The description of a name, downloaded where it is not there yet.

    Raises:
        OutsideError: none has that name, a package is missing, or the download failed.
    """
    if not _NAME.fullmatch(name):
        raise OutsideError("is no name; allowed are letters, digits, '_' and '-'")
    return _downloaded(name) if name.endswith("_description") else _installed(name)


def _installed(name: str) -> NamedRobot:
    folder = find_package(FILES, (), Path("/"))
    if folder is None:
        raise OutsideError(
            f"is looked for in a package that is missing: pip install {FILES}; names that end in "
            f"_description are those of {MODULES}"
        )
    known = {path.stem: path for path in sorted((folder / "robots").rglob("*.urdf"))}
    path = known.get(name) or known.get(f"{name}_robot")
    if path is None:
        meant = suggestion(name, known) or f"; {FILES} has {', '.join(known)}"
        raise OutsideError(f"is the name of no description{meant}")
    return NamedRobot(path, (), (folder.parent,))


def _downloaded(name: str) -> NamedRobot:
    if find_spec(MODULES) is None:
        raise OutsideError(
            f'is looked for in a package that is missing: pip install "dual-arm-carry[robots]" '
            f"({MODULES})"
        )
    if find_spec(f"{MODULES}.{name}") is None:
        raise OutsideError(
            f"is the name of no description of {MODULES}{suggestion(name, _modules())}; "
            f"python -m {MODULES} list shows all"
        )
    try:
        with redirect_stdout(sys.stderr):  # it tells what it clones
            module = import_module(f"{MODULES}.{name}")
    except Exception as error:  # of git, of the network, of the file system
        reason = " ".join(str(error).split())[-300:]
        raise OutsideError(
            f"cannot be downloaded; is the network reachable, and git installed? ({reason})"
        ) from error
    path = getattr(module, "URDF_PATH", None)
    arguments = {} if path else getattr(module, "XACRO_ARGS", {})
    path = path or getattr(module, "XACRO_PATH", None)
    path = path or getattr(module, "MJCF_PATH", None)
    if path is None:
        raise OutsideError("has neither URDF nor MJCF; name a description that has")
    package, repository = Path(module.PACKAGE_PATH), Path(module.REPOSITORY_PATH)
    folders = dict.fromkeys((package.parent, repository, repository.parent))
    named = tuple((str(key), str(value)) for key, value in arguments.items())
    return NamedRobot(Path(path), named, tuple(folders))


def _modules() -> Iterator[str]:
    """Names of all descriptions of the package."""
    folder = Path(str(find_spec(MODULES).origin)).parent  # type: ignore[union-attr]
    return (path.stem for path in sorted(folder.glob("*_description.py")))


def with_paths(text: str, names: Collection[str]) -> str:
    """A workcell file's text with these robots' names replaced by the paths of their descriptions.

    Raises:
        OutsideError: see `named_robot`.
    """

    def address(found: re.Match[str]) -> str:
        before, quote, name = found.groups()
        path = named_robot(name).path if name in names else None
        return f"urdf{before}{quote}{path}{quote}" if path else found[0]

    return _KEY.sub(address, text)
