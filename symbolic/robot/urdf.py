"""A robot's URDF as a serial arm of six revolute joints, and the files the URDF names.

`symbolic.robot.urdf_file` reads and checks the file.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import pinocchio as pin

from symbolic.errors import RobotModelError
from symbolic.robot.urdf_file import Urdf, read_urdf
from symbolic.workcell.reader import suggestion
from symbolic.workcell.records import Robot

N_JOINTS = 6


def robot_urdf(robot: Robot) -> Urdf:
    """The description of a robot of a workcell.

    Raises:
        UrdfError: see `symbolic.robot.urdf_file.read_urdf`.
    """
    return read_urdf(robot.urdf, robot.xacro_arguments, robot.package_dirs)


def reduced_model(urdf: Urdf, locked_joints: Iterable[tuple[str, float]] = ()) -> pin.Model:
    """The Pinocchio model of a URDF with some joints held.

    Args:
        urdf: the robot's description.
        locked_joints: names of single-axis joints and their positions [rad or m].

    Raises:
        RobotModelError: Pinocchio refuses the description, or a locked joint does not exist.
    """
    try:
        model = pin.buildModelFromXML(urdf.kinematics)
    except (ValueError, RuntimeError, IndexError) as error:
        raise RobotModelError(f"Pinocchio cannot read {urdf.file}: {_first_line(error)}") from error
    configuration = pin.neutral(model)
    locked = []
    for name, position in locked_joints:
        if name not in list(model.names)[1:]:
            candidates = list(model.names)[1:]
            raise RobotModelError(
                f"no moving joint {name!r} in {urdf.file}"
                f"{suggestion(name, candidates) or f'; it has {_listed(candidates)}'}"
            )
        joint = model.getJointId(name)
        if model.joints[joint].nq != 1:
            raise RobotModelError(
                f"joint {name!r} of {urdf.file} is continuous or has several axes; only revolute "
                "and prismatic joints can be locked"
            )
        configuration[model.joints[joint].idx_q] = position
        locked.append(joint)
    return pin.buildReducedModel(model, locked, configuration) if locked else model


def arm_model(robot: Robot) -> pin.Model:
    """The model of a robot of a workcell, its locked joints held.

    Raises:
        RobotModelError: it is not a serial arm of six revolute joints with that flange.
    """
    model = reduced_model(robot_urdf(robot), robot.locked_joints)
    for problem in (structure_problem(model), flange_problem(model, robot.flange)):
        if problem:
            raise RobotModelError(f"robot {robot.name!r}: {problem}")
    return model


def structure_problem(model: pin.Model) -> str:
    """Why a model is no serial arm of six revolute joints, or an empty string."""
    names = list(model.names)[1:]
    if model.njoints - 1 != N_JOINTS:
        return (
            f"found {len(names)} joints that are not locked ({_listed(names)}); allowed are "
            f"{N_JOINTS}, name others under locked_joints"
        )
    for joint, name in enumerate(names, start=1):
        kind = str(model.joints[joint].shortname())
        if not kind.startswith("JointModelR") or model.joints[joint].nq != 1:
            return (
                f"joint {name!r} is of kind {kind.removeprefix('JointModel')}; allowed are "
                "revolute joints with limits"
            )
        if model.parents[joint] != joint - 1:
            return (
                f"joint {name!r} does not follow the joint before it; allowed is one serial chain"
            )
    return ""


def flange_problem(model: pin.Model, flange: str) -> str:
    """Why a frame cannot carry the tool, or an empty string."""
    bodies = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    last = [frame.name for frame in model.frames if _carried_by_last(model, frame)]
    if flange not in bodies:
        hint = suggestion(flange, last)
        return f"found {flange!r}, no link of the URDF; allowed are {_listed(last)}{hint}"
    if flange not in last:
        return f"found {flange!r}, which the last joint does not move; allowed are {_listed(last)}"
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


def _listed(names: Sequence[str], most: int = 20) -> str:
    text = ", ".join(repr(name) for name in names[:most]) or "none"
    return f"{text} and {len(names) - most} more" if len(names) > most else text
