"""The arms in robots' descriptions: chains of joints, Pinocchio's models, and whose link is whose.

A serial arm of six joints or more is picked from a description (`symbolic.read.urdf`); every other
joint is held.

Two robots of a workcell that name one description at one place are the two arms of one machine.
Every link is then modelled once: behind an arm's first moving joint it belongs to that arm, what
a joint of both moves (a lift, a torso) to the first, and what neither moves stands still for both.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from symbolic.errors import RobotModelError
from symbolic.read.urdf import Urdf, UrdfJoint, read_urdf
from symbolic.records import PAYLOAD, Robot, Workcell
from symbolic.records.problems import matching, suggestion

Positions = tuple[tuple[str, float], ...]
"""Names of joints and where they stand [rad or m]."""


def chain_joints(urdf: Urdf, root: str, tip: str) -> tuple[str, ...]:
    """The joints between two links that move, from the root to the tip.

    Raises:
        RobotModelError: a link does not exist, or the tip does not hang on the root.
    """
    links = urdf.links
    for link in (root, tip):
        if link not in links:
            raise RobotModelError(
                f"found {link!r}, no link of {urdf.file}"
                f"{suggestion(link, links) or f'; it has {listed(links)}'}"
            )
    moved_by = {joint.child: name for name, joint in urdf.joints.items()}
    found: list[str] = []
    link = tip
    while link != root:
        if link not in moved_by:
            raise RobotModelError(
                f"{tip!r} does not hang on {root!r}; allowed are two links one behind the other"
            )
        found.append(moved_by[link])
        link = urdf.joints[moved_by[link]].parent
    return tuple(name for name in reversed(found) if urdf.joints[name].kind != "fixed")


def held_joints(urdf: Urdf, moving: Sequence[str], locked: Positions) -> Positions:
    """Every joint of a description that does not move, with the position it is held at.

    That is the one of `locked`, else zero or the nearest that its limits allow; a joint that
    mimics another stands where that one puts it.

    Args:
        urdf: the description.
        moving: joints that move.
        locked: joints and positions that the user gives [rad or m].

    Raises:
        RobotModelError: a locked joint does not exist, or a joint mimics one that moves.
    """
    given = dict(locked)
    for name in given:
        _require_joint(urdf, name)
    positions: dict[str, float] = {}

    def position(name: str) -> float:
        if name not in positions:
            positions[name] = _held_at(name, urdf.joints[name])
        return positions[name]

    def _held_at(name: str, joint: UrdfJoint) -> float:
        if name in given:
            return given[name]
        if not joint.mimics:
            return float(np.clip(0.0, joint.lower, joint.upper))
        if joint.mimics in moving:
            raise RobotModelError(
                f"joint {name!r} mimics {joint.mimics!r}, which moves; hold it (locked_joints) or "
                "drop its links (drop_links)"
            )
        return joint.multiplier * position(joint.mimics) + joint.offset

    for name in moving:
        if urdf.joints[name].mimics:
            raise RobotModelError(
                f"joint {name!r} of the chain mimics {urdf.joints[name].mimics!r}; allowed are "
                "joints that move by themselves"
            )
    return tuple(
        (name, position(name))
        for name, joint in urdf.joints.items()
        if joint.kind != "fixed" and name not in moving
    )


def _require_joint(urdf: Urdf, name: str) -> None:
    moving = [other for other, joint in urdf.joints.items() if joint.kind != "fixed"]
    if name not in moving:
        raise RobotModelError(
            f"no moving joint {name!r} in {urdf.file}"
            f"{suggestion(name, moving) or f'; it has {listed(moving)}'}"
        )


def without_links(urdf: Urdf, patterns: tuple[str, ...]) -> Urdf:
    """A description without some links, all that hangs on them, and the joints that move these.

    Args:
        urdf: the description.
        patterns: names of links, or patterns with `*` and `?`.

    Raises:
        RobotModelError: a pattern matches no link, or every link would go.
    """
    dropped: set[str] = set()
    for pattern in patterns:
        found = matching(pattern, urdf.links)
        if not found:
            raise RobotModelError(
                f"found {pattern!r}, which matches no link of {urdf.file}"
                f"{suggestion(pattern, urdf.links) or f'; it has {listed(urdf.links)}'}"
            )
        dropped.update(found)
    waiting = list(dropped)
    while waiting:
        parent = waiting.pop()
        behind = {j.child for j in urdf.joints.values() if j.parent == parent} - dropped
        dropped |= behind
        waiting += behind
    if len(dropped) == len(urdf.links):
        raise RobotModelError(f"every link of {urdf.file} would be dropped; keep the arm")
    joints = {name: joint for name, joint in urdf.joints.items() if joint.child not in dropped}
    tree = ElementTree.fromstring(urdf.kinematics)
    for element in list(tree):
        kept = joints.keys() if element.tag == "joint" else set(urdf.links) - dropped
        if element.get("name") not in kept:
            tree.remove(element)
    return replace(
        urdf,
        links=tuple(link for link in urdf.links if link not in dropped),
        joints=MappingProxyType(joints),
        collisions=MappingProxyType(
            {link: found for link, found in urdf.collisions.items() if link not in dropped}
        ),
        visuals=MappingProxyType(
            {link: found for link, found in urdf.visuals.items() if link not in dropped}
        ),
        kinematics=ElementTree.tostring(tree, encoding="unicode"),
    )


def listed(names: Sequence[str], most: int = 20) -> str:
    """Names for a message, the first of many."""
    text = ", ".join(repr(name) for name in names[:most]) or "none"
    return f"{text} and {len(names) - most} more" if len(names) > most else text


# --- Pinocchio's model of an arm ---


FOLLOWING = 6
"""Joints that follow the box; what an arm has beyond them is redundant."""


def robot_urdf(robot: Robot) -> Urdf:
    """The description of a robot of a workcell, without the links that it drops.

    Raises:
        RobotModelError: see `symbolic.read.urdf.read_urdf` and
            `without_links`.
    """
    urdf = read_urdf(robot.urdf, robot.xacro_arguments, robot.package_dirs)
    return without_links(urdf, robot.drop_links) if robot.drop_links else urdf


def reduced_model(urdf: Urdf, held: Positions = ()) -> pin.Model:
    """The Pinocchio model of a URDF with some joints held.

    Args:
        urdf: the robot's description.
        held: names of joints and the positions they are held at [rad or m]; a joint of several
            axes is held at its neutral position, whatever is given.

    Raises:
        RobotModelError: Pinocchio refuses the description.
    """
    return pin.Model(_reduced(urdf.kinematics, str(urdf.file), tuple(held)))


@lru_cache(maxsize=16)
def _reduced(kinematics: str, file: str, held: Positions) -> pin.Model:
    """See `reduced_model`; not to be modified."""
    try:
        model = pin.buildModelFromXML(kinematics)
    except (ValueError, RuntimeError, IndexError) as error:
        raise RobotModelError(f"Pinocchio cannot read {file}: {_first_line(error)}") from error
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
    """The joints that move an arm's flange.

    Args:
        urdf: the robot's description.
        chain_root: link that the chain begins at; '' for all joints that are not locked.
        flange: link that the chain ends at.
        locked: joints that the user holds, with their positions.

    Raises:
        RobotModelError: see `chain_joints`.
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


def _carried_by_last(model: pin.Model, frame: pin.Frame) -> bool:
    return bool(frame.type == pin.FrameType.BODY and frame.parentJoint == model.njoints - 1)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ["no reason given"])[0]


# --- machines with two arms ---


Arms = tuple[Robot, Robot]


@dataclass(frozen=True)
class ArmLinks:
    """The links with collision shapes that are modelled as an arm's, in the order of its file.

    Attributes:
        moved: links behind the arm's first moving joint; those that only common joints move are
            listed with the first arm alone.
        still: links that stand still, listed with one arm only.
        mount: the link with shapes that the arm is mounted on; '' where there is none.
    """

    moved: tuple[str, ...]
    still: tuple[str, ...]
    mount: str


def one_machine(robots: Arms) -> bool:
    """Whether two robots are the arms of one machine: chains of one description at one place."""
    first, second = robots
    return (
        bool(first.chain_root and second.chain_root)
        and first.urdf == second.urdf
        and first.xacro_arguments == second.xacro_arguments
        and np.array_equal(first.T_world_base, second.T_world_base)
    )


def arm_links(robots: Arms, i: int) -> ArmLinks:
    """The links that are modelled as arm i's (0 or 1).

    Raises:
        RobotModelError: see `arm_model`.
    """
    moved, still = _sorted_links(robots[i])
    mount = _mount(robots[i], still)
    if one_machine(robots):
        on_common, for_other = (_moved_by(robots[arm], common_joints(robots)) for arm in (i, 1 - i))
        shared = [link for link in on_common if link in for_other]
        mount = _mount(robots[i], (*still, *shared))
        moved = tuple(
            link for link in moved if link not in on_common or (i == 0 and link in shared)
        )
        _, still_for_other = _sorted_links(robots[1 - i])
        still = tuple(link for link in still if link in still_for_other) if i == 0 else ()
    return ArmLinks(moved, still, mount)


def common_joints(robots: Arms) -> tuple[str, ...]:
    """Joints that move both arms of one machine, in their order.

    Raises:
        RobotModelError: see `arm_model`.
    """
    if not one_machine(robots):
        return ()
    first, second = (tuple(arm_model(robot).names)[1:] for robot in robots)
    return tuple(name for name in first if name in second)


def machine_problem(robots: Arms) -> str:
    """Why two robots cannot be the arms of one machine, or an empty string.

    Raises:
        RobotModelError: see `arm_model`.
    """
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
    """Whether a link hangs on one of these joints."""
    moved_by = {joint.child: other for other, joint in urdf.joints.items()}
    while link in moved_by:
        if moved_by[link] in joints:
            return True
        link = urdf.joints[moved_by[link]].parent
    return False


def _sorted_links(robot: Robot) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Links with shapes that the arm moves, and those that it does not."""
    model = arm_model(robot)
    moved: list[str] = []
    still: list[str] = []
    for link in robot_urdf(robot).collision_links:
        is_still = model.frames[link_frame(model, link)].parentJoint == 0
        (still if is_still else moved).append(link)
    return tuple(moved), tuple(still)


def _moved_by(robot: Robot, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Links with shapes that hang on one of these joints and on no later one of the arm."""
    if not joints:
        return ()
    model = arm_model(robot)
    return tuple(
        link
        for link in robot_urdf(robot).collision_links
        if model.names[model.frames[link_frame(model, link)].parentJoint] in joints
    )


def _mount(robot: Robot, still: tuple[str, ...]) -> str:
    """The last link with shapes on the way from the root to the arm's first own joint."""
    urdf = robot_urdf(robot)
    parents = {joint.child: joint.parent for joint in urdf.joints.values()}
    link = robot.flange
    while link not in still:
        if link not in parents:
            return ""
        link = parents[link]
    return link


# --- names of bodies ---


def body_names(workcell: Workcell) -> dict[str, tuple[str, ...]]:
    """The names by which collision pairs are addressed, per owner.

    The payload is `payload`, an environment body has its own name, a link or tool body of a
    robot is `ROBOT/NAME`; what stands still of a machine with both arms bears the name of the
    first. The keys are `payload`, `environment` and the robots' names.
    """
    names = {
        PAYLOAD: (PAYLOAD,),
        "environment": tuple(body.name for body in workcell.environment),
    }
    for i, robot in enumerate(workcell.robots):
        owned = arm_links(workcell.robots, i)
        links = tuple(
            x for x in robot_urdf(robot).collision_links if x in owned.moved + owned.still
        )
        tools = tuple(body.name for body in robot.tool)
        names[robot.name] = tuple(f"{robot.name}/{name}" for name in (*links, *tools))
    return names
