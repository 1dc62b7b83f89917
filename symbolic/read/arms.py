"""Arms in robot descriptions: chains of joints, Pinocchio models, and the links that belong to each
arm.

A serial arm of six joints or more is picked from a description (`symbolic.read.urdf`); every
other joint is held.

Two robots of a workcell with the same description at the same place are the two arms of one
machine. Every link is then modelled once. A link that one arm's joints move belongs to this arm. A
link that only a common joint (a lift, a torso) moves belongs to the first arm. A link that neither
arm moves is fixed for both.

A description without such an arm raises a `RobotModelError`.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.errors import DualArmWarning, RobotModelError
from symbolic.read.urdf import Urdf, read_urdf
from symbolic.records import PAYLOAD_NAME, Robot, Workcell
from symbolic.records.problems import matching, suggestion

Positions = tuple[tuple[str, float], ...]
"""Names of joints with their positions [rad or m]."""


def chain_joints(urdf: Urdf, root: str, tip: str) -> tuple[str, ...]:
    """Return the names of the moving joints between two links, from the root to the tip.

    Args:
        urdf: the description.
        root, tip: names of the links.

    Raises:
        RobotModelError: a link does not exist, or the tip does not descend from the root.
    """
    links = urdf.links
    for link in (root, tip):
        if link not in links:
            raise RobotModelError(
                f"found {link!r}, no link of {urdf.file}"
                f"{suggestion(link, links) or f'; it has {listed(links)}'}",
                code="unknown-link",
            )
    way = list(urdf.above(tip))
    ends = [tip, *(urdf.joints[name].parent for name in way)]
    if root not in ends:
        raise RobotModelError(
            f"{tip!r} does not hang on {root!r}; allowed are two links one behind the other",
            code="not-connected",
        )
    below = way[: ends.index(root)]
    return tuple(name for name in reversed(below) if urdf.joints[name].kind != "fixed")


def held_joints(urdf: Urdf, moving: Sequence[str], locked: Positions) -> Positions:
    """Return the joints of a description that are held while the joints `moving` move, each with
    its position [rad or m].

    The position is the one in `locked`, else zero or the limit closest to zero. A joint that mimics
    a held joint follows from the position of that joint. A joint that mimics one of `moving` is
    held at its offset, with a warning, if it moves no link with a shape or mass.

    Args:
        urdf: the description.
        moving: joints that move the flange.
        locked: joints that the user holds, with their positions [rad or m].

    Raises:
        RobotModelError: a locked joint does not exist, one of `moving` mimics another joint, or
            another joint mimics one of `moving` and moves a link with a shape or mass.
    """
    given = dict(locked)
    free = [name for name, joint in urdf.joints.items() if joint.kind != "fixed"]
    for name in given:
        if name not in free:
            hint = suggestion(name, free) or f"; it has {listed(free)}"
            raise RobotModelError(
                f"no moving joint {name!r} in {urdf.file}{hint}", code="unknown-joint"
            )
    for name in moving:
        if urdf.joints[name].mimics:
            raise RobotModelError(
                f"joint {name!r} of the chain mimics {urdf.joints[name].mimics!r}; allowed are "
                "joints that move by themselves",
                code="mimicking-joint",
            )

    def position(name: str) -> float:
        joint = urdf.joints[name]
        if name in given:
            return given[name]
        if not joint.mimics:
            return float(np.clip(0.0, joint.lower, joint.upper))
        if joint.mimics in moving and _is_empty_behind(urdf, name):
            _warn_left_out(urdf.file, name, joint.mimics)
            return joint.offset
        if joint.mimics in moving:
            raise RobotModelError(
                f"joint {name!r} mimics {joint.mimics!r}, which moves; hold it (locked_joints) or "
                "drop its links (drop_links)",
                code="mimics-moving-joint",
            )
        return joint.multiplier * position(joint.mimics) + joint.offset

    return tuple((name, position(name)) for name in free if name not in moving)


class RobotModelWarning(DualArmWarning):
    """Warning that a part of a description is left out."""


@cache
def _warn_left_out(file: str, joint: str, mimicked: str) -> None:
    """Warn once that a joint mimics a moving joint but is held in the model.

    Args:
        file: name of the URDF file.
        joint: the joint that is held.
        mimicked: the joint that it mimics.
    """
    warnings.warn(
        f"{file}: joint {joint!r} does not follow {mimicked!r}, which moves; what hangs on it has "
        "neither shape nor mass",
        RobotModelWarning,
        stacklevel=2,
    )


def _is_empty_behind(urdf: Urdf, joint: str) -> bool:
    behind = {link for link in urdf.links if joint in urdf.above(link)}
    tree = ElementTree.fromstring(urdf.kinematics)
    heavy = {link.get("name") for link in tree.iter("link") if _mass(link) > 0.0}
    return not behind & (heavy | urdf.collisions.keys())


def _mass(link: ElementTree.Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value", "0"))


def without_links(urdf: Urdf, patterns: tuple[str, ...]) -> Urdf:
    """Return a description without some links and all links behind them.

    The joints that move these links are removed too.

    Args:
        urdf: the description.
        patterns: names of links, or patterns with `*` and `?`.

    Raises:
        RobotModelError: a pattern matches no link, or no link would be left.
    """
    dropped: set[str] = set()
    for pattern in patterns:
        found = matching(pattern, urdf.links)
        if not found:
            hint = suggestion(pattern, urdf.links) or f"; it has {listed(urdf.links)}"
            raise RobotModelError(
                f"found {pattern!r}, which matches no link of {urdf.file}{hint}",
                code="unknown-link",
            )
        dropped.update(found)
    for link in urdf.links:
        if any(urdf.joints[name].parent in dropped for name in urdf.above(link)):
            dropped.add(link)
    if len(dropped) == len(urdf.links):
        raise RobotModelError(
            f"every link of {urdf.file} would be dropped; keep the arm", code="no-link-left"
        )
    joints = {name: joint for name, joint in urdf.joints.items() if joint.child not in dropped}
    tree = ElementTree.fromstring(urdf.kinematics)
    for element in list(tree):
        kept = joints.keys() if element.tag == "joint" else set(urdf.links) - dropped
        if element.get("name") not in kept:
            tree.remove(element)

    def left(by_link: Mapping[str, tuple[Any, ...]]) -> Mapping[str, tuple[Any, ...]]:
        return MappingProxyType({k: found for k, found in by_link.items() if k not in dropped})

    return replace(
        urdf,
        links=tuple(link for link in urdf.links if link not in dropped),
        joints=MappingProxyType(joints),
        collisions=left(urdf.collisions),
        visuals=left(urdf.visuals),
        kinematics=ElementTree.tostring(tree, encoding="unicode"),
    )


def listed(names: Sequence[str], most: int = 20) -> str:
    """Return names for a message, separated by commas: at most `most` names, then the number of the
    rest."""
    text = ", ".join(repr(name) for name in names[:most]) or "none"
    return f"{text} and {len(names) - most} more" if len(names) > most else text


# --- Pinocchio's model of an arm ---


FOLLOWING = 6
"""Number of joints that follow the box. Further joints of an arm are redundant."""


def robot_urdf(robot: Robot) -> Urdf:
    """Read the description of a workcell's robot, without the links of `drop_links`."""
    urdf = read_urdf(robot.urdf, robot.xacro_arguments, robot.package_dirs)
    return without_links(urdf, robot.drop_links) if robot.drop_links else urdf


def reduced_model(urdf: Urdf, held: Positions = ()) -> pin.Model:
    """Return the Pinocchio model of a URDF with some joints held.

    Args:
        urdf: the robot's description.
        held: names of held joints with their positions [rad or m]. A joint with several axes is
            always held at its neutral position.

    Raises:
        RobotModelError: Pinocchio refuses the description.
    """
    return pin.Model(_reduced(urdf.kinematics, str(urdf.file), tuple(held)))


@lru_cache(maxsize=16)
def _reduced(kinematics: str, file: str, held: Positions) -> pin.Model:
    """Return the Pinocchio model of a URDF with some joints held.

    The result is cached, so callers must not modify it.

    Args:
        kinematics: URDF text of the links and joints.
        file: name of the file, for messages.
        held: names and positions of the held joints [rad or m].

    Raises:
        RobotModelError: Pinocchio refuses the description.
    """
    try:
        model = pin.buildModelFromXML(kinematics)
    except (ValueError, RuntimeError, IndexError) as error:
        reason = (str(error).strip().splitlines() or ["no reason given"])[0]
        raise RobotModelError(f"Pinocchio cannot read {file}: {reason}") from error
    links = {frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
    for frame in model.frames:
        if frame.type == pin.FrameType.FIXED_JOINT and frame.name in links:
            frame.name += " (joint)"  # Pinocchio reduces no model in which a link has the same name
    configuration = pin.neutral(model)
    joints = []
    for name, position in held:
        joint = model.getJointId(name)
        if model.joints[joint].nq == 1:
            configuration[model.joints[joint].idx_q] = position
        joints.append(joint)
    return pin.buildReducedModel(model, joints, configuration) if joints else model


def moving_joints(urdf: Urdf, chain_root: str, flange: str, locked: Positions) -> tuple[str, ...]:
    """Return the names of the joints that move an arm's flange.

    Args:
        urdf: the robot's description.
        chain_root: link at which the chain of joints begins; '' for all joints that are not locked.
        flange: link at which the chain ends.
        locked: joints that the user holds, with their positions [rad or m].
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
    """Return the Pinocchio model of a robot's chain of moving joints.

    All other joints are held, and the mass of the tool is included.

    Raises:
        RobotModelError: the robot is not a serial arm that ends in its flange.
    """
    urdf = robot_urdf(robot)
    moving = moving_joints(urdf, robot.chain_root, robot.flange, robot.locked_joints)
    held = held_joints(urdf, moving, robot.locked_joints)
    for problem in _problems(urdf.kinematics, str(urdf.file), tuple(held), robot.flange):
        raise RobotModelError(f"robot {robot.name!r}: {problem}")
    model = reduced_model(urdf, held)
    if robot.tool_load is not None:
        load = robot.tool_load
        flange = model.frames[link_frame(model, robot.flange)]
        inertia = pin.Inertia(load.mass, load.centre_of_mass, load.inertia)
        model.appendBodyToJoint(flange.parentJoint, inertia, flange.placement)
    return model


@lru_cache(maxsize=16)
def _problems(kinematics: str, file: str, held: Positions, flange: str) -> tuple[str, ...]:
    """Return the reasons why a description is not a serial arm with this flange; () if it is.

    Args:
        kinematics: URDF text of the links and joints.
        file: name of the file, for messages.
        held: names and positions of the held joints [rad or m].
        flange: name of the flange's frame.
    """
    model = _reduced(kinematics, file, held)
    found = structure_problem(model), flange_problem(model, flange)
    return tuple(problem for problem in found if problem)


def turning_joints(model: pin.Model) -> tuple[bool, ...]:
    """Return for each joint in the order of q True if it is revolute, False if it is prismatic."""
    return tuple(str(joint.shortname()).startswith("JointModelR") for joint in model.joints[1:])


def structure_problem(model: pin.Model) -> str:
    """Return why a model is not a serial arm of at least six joints; '' if it is."""
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
    """Return why the frame `flange` of a model cannot carry the tool: it is no link, or the last
    joint does not move it. The result is '' if it can."""
    bodies = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    tip = model.njoints - 1
    last = [x for x in bodies if model.frames[link_frame(model, x)].parentJoint == tip]
    if flange not in bodies:
        hint = suggestion(flange, last)
        return f"found {flange!r}, no link of the URDF; allowed are {listed(last)}{hint}"
    if flange not in last:
        return f"found {flange!r}, which the last joint does not move; allowed are {listed(last)}"
    return ""


def link_frame(model: pin.Model, link: str) -> int:
    """Return the index of a link's frame in a model, even if a joint has the same name."""
    return int(model.getFrameId(link, pin.FrameType.BODY))


def link_lengths(model: pin.Model, flange: str) -> Array:
    """Compute the distances (n,) from each joint to the next and from the last to the flange [m].

    Args:
        model: model of an arm with n joints.
        flange: name of the flange's frame.
    """
    offsets = [model.jointPlacements[joint].translation for joint in range(2, model.njoints)]
    offsets.append(model.frames[link_frame(model, flange)].placement.translation)
    return np.asarray(np.linalg.norm(offsets, axis=1))


MANIPULABILITY_SHARE = 1e-3
"""Default of `min_manipulability` over the cube of an arm's length. 2 to 24 % of random postures of
thirteen arms of 0.74 to 1.75 m are below it, 6 % for a GoFa 12."""


def usual_manipulability(model: pin.Model, flange: str) -> float:
    """Compute the default lower bound of an arm's manipulability, rounded to two digits [m^3].

    It is proportional to the cube of the arm's length, as the manipulability itself is. The length
    is the sum of the distances between the last seven joints and to the flange, so it excludes
    earlier joints that move the whole arm, such as a lift.

    Args:
        model: model of the arm.
        flange: name of the flange's frame.
    """
    length = float(link_lengths(model, flange)[-FOLLOWING - 1 :].sum())
    return float(f"{MANIPULABILITY_SHARE * length**3:.1e}")


# --- machines with two arms ---


Arms = tuple[Robot, Robot]


@dataclass(frozen=True)
class ArmLinks:
    """Links with collision shapes that are modelled with one arm, in the order of the file.

    Attributes:
        moved: links behind the arm's first moving joint. Links that only common joints of both arms
            move are listed with the first arm alone.
        still: links that do not move, listed with one arm only.
        mount: last link with shapes before the links of `moved` on the way to the flange, '' if
            there is none. It is fixed, or, for the second arm, moved by common joints.
    """

    moved: tuple[str, ...]
    still: tuple[str, ...]
    mount: str


def one_machine(robots: Arms) -> bool:
    """Return True if two robots are arms of one machine: both are chains of the same description,
    and the base of this description has one pose."""
    first, second = robots
    return (
        bool(first.chain_root and second.chain_root)
        and first.urdf == second.urdf
        and first.xacro_arguments == second.xacro_arguments
        and np.array_equal(first.T_world_base, second.T_world_base)
    )


def arm_links(robots: Arms, i: int) -> ArmLinks:
    """Return the links that are collision bodies of arm i (0 or 1), and the link on which it is
    mounted.

    If both arms belong to one machine, each link that both descriptions contain becomes a body of
    one arm only.

    Args:
        robots: both arms.
        i: index of the arm.
    """
    carried = _carriers(robots[i])
    still = [link for link in carried if carried[link] == UNMOVED]
    moved = [link for link in carried if carried[link] != UNMOVED]
    mount = _mount(robots[i], still)
    if one_machine(robots):
        common, on_other = common_joints(robots), _carriers(robots[1 - i])
        on_common = [link for link in moved if carried[link] in common]
        shared = [link for link in on_common if on_other.get(link) in common]
        mount = _mount(robots[i], (*still, *shared) if i else still)
        moved = [x for x in moved if x not in on_common or (i == 0 and x in shared)]
        still = [link for link in still if i == 0 and on_other.get(link) == UNMOVED]
    return ArmLinks(tuple(moved), tuple(still), mount)


UNMOVED = "universe"
"""Pinocchio's name of the joint to which everything fixed belongs."""


def common_joints(robots: Arms) -> tuple[str, ...]:
    """Return the names of the joints that move both arms of one machine, from the root outwards; ()
    for separate robots."""
    if not one_machine(robots):
        return ()
    first, second = (tuple(arm_model(robot).names)[1:] for robot in robots)
    return tuple(name for name in first if name in second)


def machine_problem(robots: Arms) -> str:
    """Return why two robots that are one machine cannot be its arms: because they do not move
    independently, or hold a joint at different positions. Return '' if they can, and for separate
    robots."""
    if not one_machine(robots):
        return ""
    chains, held = [], []
    for robot in robots:
        urdf = robot_urdf(robot)
        moving = moving_joints(urdf, robot.chain_root, robot.flange, robot.locked_joints)
        chains.append(moving)
        held.append(dict(held_joints(urdf, moving, robot.locked_joints)))
    if set(chains[0]) <= set(chains[1]) or set(chains[1]) <= set(chains[0]):
        return (
            "names the same arm as robots[0], at the same base; allowed is another arm of the "
            "machine, or another base"
        )
    for k, robot in enumerate(robots):
        urdf = robot_urdf(robot)
        for name in chains[1 - k]:
            if name not in chains[k] and _is_behind(urdf, robot.flange, (name,)):
                return (
                    f"joint {name!r} moves robot {robot.name!r} too, whose chain begins behind it; "
                    "begin both chains before it, or hold it with both robots (locked_joints)"
                )
    moved = {*chains[0], *chains[1]}
    for name, position in held[0].items():
        urdf = robot_urdf(robots[0])
        if name in moved or _is_behind(urdf, urdf.joints[name].parent, moved):
            continue
        other = held[1].get(name, position)
        if other != position:
            return (
                f"joint {name!r} of the machine is held at {position:g} by robot "
                f"{robots[0].name!r} and at {other:g} by robot {robots[1].name!r}; allowed is one "
                "position, give it to both (locked_joints)"
            )
    return ""


def _is_behind(urdf: Urdf, link: str, joints: Collection[str]) -> bool:
    return any(name in joints for name in urdf.above(link))


def _carriers(robot: Robot) -> dict[str, str]:
    """Return for each link with a collision shape the name of the arm's joint that moves it.

    This is the last of the arm's joints between the root and the link; 'universe' for a link that
    no joint of the arm moves.
    """
    model = arm_model(robot)
    links = robot_urdf(robot).collisions
    return {link: model.names[model.frames[link_frame(model, link)].parentJoint] for link in links}


def _mount(robot: Robot, still: Collection[str]) -> str:
    """Return the name of the link on which an arm is mounted: the last link on the way to its
    flange that has shapes and that the arm's own joints do not move. Return '' if there is none.

    Args:
        robot: the arm.
        still: names of the links with shapes that the arm's own joints do not move.
    """
    urdf = robot_urdf(robot)
    way = (robot.flange, *(urdf.joints[name].parent for name in urdf.above(robot.flange)))
    return next((link for link in way if link in still), "")


# --- names of bodies ---


def body_names(workcell: Workcell) -> dict[str, tuple[str, ...]]:
    """Return the names of all collision bodies, which a workcell file uses to exclude pairs from
    checks.

    Returns:
        Names of the bodies by owner: under `payload` the name `payload`, under `environment` the
        bodies' own names, and under each robot's name its links and tool bodies as `ROBOT/NAME`.
        Links that a machine with two arms has once are listed with the first robot.
    """
    names = {
        PAYLOAD_NAME: (PAYLOAD_NAME,),
        "environment": tuple(body.name for body in workcell.environment),
    }
    for i, robot in enumerate(workcell.robots):
        owned = arm_links(workcell.robots, i)
        links = tuple(x for x in robot_urdf(robot).collisions if x in owned.moved + owned.still)
        tools = tuple(body.name for body in robot.tool)
        names[robot.name] = tuple(f"{robot.name}/{name}" for name in (*links, *tools))
    return names
