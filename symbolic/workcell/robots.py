"""The robots section of a workcell file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.robot.urdf import FOLLOWING
from symbolic.robot.urdf_file import LARGEST_GYRATION
from symbolic.workcell import quantities as quantity
from symbolic.workcell.descriptions import read_description, read_texts
from symbolic.workcell.reader import Quantity, Table, read_only
from symbolic.workcell.records import SEARCHED, Robot, ToolLoad
from symbolic.workcell.sections import read_body, read_inertia, read_pose

# Joint accelerations are rarely published; this is slow for an arm of this class.
DEFAULT_ACCELERATION = 5.0  # [rad/s^2]
DEFAULT_MIN_MANIPULABILITY = 0.005  # [m^3], exceeded by 9 of 10 random poses of a 1.3 m arm
MAX_START_BRANCH = 1000


def read_robot(table: Table, folder: Path, stored: bool = False) -> tuple[Robot, int]:
    """One arm and the index of its start branch (-1: the criterion's choice, -2: searched for).

    Args:
        table: its section.
        folder: what paths are relative to.
        stored: whether the cell was unpacked from an archive, see `symbolic.workcell.file.load`.
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
    )
    branch = SEARCHED
    if table.raw("start_branch", -1) != "search":
        branch = table.integer("start_branch", -1, MAX_START_BRANCH, -1)
    table.close()
    return robot, branch


def _read_jerk(table: Table, joints: int) -> Array | None:
    """The joints' largest jerks, where the file states them."""
    if "jerk_max" not in table:
        table.raw("jerk_max", None)
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
    if "tool_load" not in table:
        table.raw("tool_load", None)
        return None
    inner = table.table("tool_load")
    mass = inner.number("mass", quantity.MASS)
    centre = inner.vector("centre_of_mass", (quantity.POSITION,) * 3, default=(0.0, 0.0, 0.0))
    inertia = read_only(np.zeros((3, 3)))
    if "inertia" in inner:
        inertia = read_inertia(inner, mass * LARGEST_GYRATION**2)
    inner.raw("inertia", None)
    inner.close()
    return ToolLoad(mass, centre, inertia)


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
    if key in table:
        # One number for all joints is right for a bound on magnitude, not for a range's end.
        return table.vector(key, each, scalar_fills=not key.startswith("position"))
    table.raw(key, None)
    if urdf_value is None:
        return read_only(np.ones(len(each)))
    for joint, (value, allowed) in enumerate(zip(urdf_value, each, strict=True)):
        if not allowed.contains(float(value)):
            table.problems.add(
                table.at(key),
                f"the URDF gives {value:g} for joint {joint + 1}; allowed is {allowed.allowed()}"
                f"{allowed.suspicion(float(value))}; correct the URDF or give {key} here",
            )
            return read_only(np.ones(len(each)))
    return read_only(urdf_value)
