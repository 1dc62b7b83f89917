"""A robot's URDF as a serial arm of six joints or more, and the files the URDF names.

`symbolic.robot.urdf_file` reads and checks the file.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pinocchio as pin

from symbolic.errors import RobotModelError
from symbolic.robot.chain import Held, chain_joints, held_joints, listed, without_links
from symbolic.robot.urdf_file import Urdf, read_urdf
from symbolic.workcell.problems import suggestion
from symbolic.workcell.records import Robot

FOLLOWING = 6
"""Joints that follow the box; what an arm has beyond them is redundant."""


def robot_urdf(robot: Robot) -> Urdf:
    """The description of a robot of a workcell, without the links that it drops.

    Raises:
        RobotModelError: see `symbolic.robot.urdf_file.read_urdf` and
            `symbolic.robot.chain.without_links`.
    """
    urdf = read_urdf(robot.urdf, robot.xacro_arguments, robot.package_dirs)
    return without_links(urdf, robot.drop_links) if robot.drop_links else urdf


def reduced_model(urdf: Urdf, held: Held = ()) -> pin.Model:
    """The Pinocchio model of a URDF with some joints held.

    Args:
        urdf: the robot's description.
        held: names of joints and the positions they are held at [rad or m]; a joint of several
            axes is held at its neutral position, whatever is given.

    Raises:
        RobotModelError: Pinocchio refuses the description.
    """
    try:
        model = pin.buildModelFromXML(urdf.kinematics)
    except (ValueError, RuntimeError, IndexError) as error:
        raise RobotModelError(f"Pinocchio cannot read {urdf.file}: {_first_line(error)}") from error
    configuration = pin.neutral(model)
    joints = []
    for name, position in held:
        joint = model.getJointId(name)
        if model.joints[joint].nq == 1:
            configuration[model.joints[joint].idx_q] = position
        joints.append(joint)
    return pin.buildReducedModel(model, joints, configuration) if joints else model


def moving_joints(urdf: Urdf, chain_root: str, flange: str, locked: Held) -> tuple[str, ...]:
    """The joints that move an arm's flange.

    Args:
        urdf: the robot's description.
        chain_root: link that the chain begins at; '' for all joints that are not locked.
        flange: link that the chain ends at.
        locked: joints that the user holds, with their positions.

    Raises:
        RobotModelError: see `symbolic.robot.chain.chain_joints`.
    """
    if chain_root:
        found = chain_joints(urdf, chain_root, flange)
    else:
        mimicking = {name for name, joint in urdf.joints.items() if joint.mimics}
        found = tuple(
            name
            for name, joint in urdf.joints.items()
            if joint.kind != "fixed" and name not in mimicking
        )
    held = dict(locked)
    return tuple(name for name in found if name not in held)


def arm_model(robot: Robot) -> pin.Model:
    """The model of a robot of a workcell: its chain, all else held, its tool's mass included.

    Raises:
        RobotModelError: it is not a serial arm with that flange.
    """
    urdf = robot_urdf(robot)
    moving = moving_joints(urdf, robot.chain_root, robot.flange, robot.locked_joints)
    model = reduced_model(urdf, held_joints(urdf, moving, robot.locked_joints))
    for problem in (structure_problem(model), flange_problem(model, robot.flange)):
        if problem:
            raise RobotModelError(f"robot {robot.name!r}: {problem}")
    if robot.tool_load is not None:
        load = robot.tool_load
        flange = model.frames[link_frame(model, robot.flange)]
        inertia = pin.Inertia(load.mass, load.centre_of_mass, load.inertia)
        model.appendBodyToJoint(flange.parentJoint, inertia, flange.placement)
    return model


def turning_joints(model: pin.Model) -> tuple[bool, ...]:
    """Which joints of an arm turn, in the order of q; the others slide."""
    return tuple(str(joint.shortname()).startswith("JointModelR") for joint in model.joints[1:])


def structure_problem(model: pin.Model) -> str:
    """Why a model is no serial arm of at least six joints, or an empty string."""
    names = list(model.names)[1:]
    if len(names) < FOLLOWING:
        return (
            f"found {len(names)} joints that are not locked ({listed(names)}); allowed are "
            f"{FOLLOWING} or more that move the flange"
        )
    for joint, name in enumerate(names, start=1):
        kind = str(model.joints[joint].shortname())
        if not kind.startswith(("JointModelR", "JointModelP")) or model.joints[joint].nq != 1:
            return (
                f"joint {name!r} is of kind {kind.removeprefix('JointModel')}; allowed are "
                "revolute, continuous and prismatic joints; hold others by locked_joints"
            )
        if model.parents[joint] != joint - 1:
            return (
                f"joint {name!r} does not follow the joint before it; allowed is one serial chain: "
                "pick it (chain), or name joints that do not belong to it under locked_joints"
            )
    return ""


def flange_problem(model: pin.Model, flange: str) -> str:
    """Why a frame cannot carry the tool, or an empty string."""
    bodies = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    last = [frame.name for frame in model.frames if _carried_by_last(model, frame)]
    if flange not in bodies:
        hint = suggestion(flange, last)
        return f"found {flange!r}, no link of the URDF; allowed are {listed(last)}{hint}"
    if flange not in last:
        return f"found {flange!r}, which the last joint does not move; allowed are {listed(last)}"
    return ""


def link_frame(model: pin.Model, link: str) -> int:
    """Index of a link's frame; a joint may have the same name."""
    return int(model.getFrameId(link, pin.FrameType.BODY))


def resolve_mesh(address: str, urdf: Path, package_dirs: Sequence[Path]) -> Path | None:
    """The file behind a mesh address of a URDF, or None where there is none.

    `package://NAME/REST` is looked up as NAME/REST in each package folder; `file://` addresses
    are absolute; anything else is relative to the URDF's folder.
    """
    if address.startswith("package://"):
        rest = address.removeprefix("package://")
        candidates = [folder / rest for folder in package_dirs]
    else:
        candidates = [urdf.parent / address.removeprefix("file://")]
    return next(
        (candidate.resolve() for candidate in candidates if os.path.exists(candidate)), None
    )


def _carried_by_last(model: pin.Model, frame: pin.Frame) -> bool:
    return bool(frame.type == pin.FrameType.BODY and frame.parentJoint == model.njoints - 1)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ["no reason given"])[0]
