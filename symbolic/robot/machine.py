"""Which links of a robot's description belong to which arm, where one machine has both arms.

Two robots of a workcell that name one description at one place are the two arms of one machine.
Every link is then modelled once: behind an arm's first moving joint it belongs to that arm, what
a joint of both moves (a lift, a torso) to the first, and what neither moves stands still for both.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from symbolic.robot.chain import held_joints
from symbolic.robot.urdf import arm_model, link_frame, moving_joints, robot_urdf
from symbolic.robot.urdf_file import Urdf
from symbolic.workcell.records import Robot

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
        RobotModelError: see `symbolic.robot.urdf.arm_model`.
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
        RobotModelError: see `symbolic.robot.urdf.arm_model`.
    """
    if not one_machine(robots):
        return ()
    first, second = (tuple(arm_model(robot).names)[1:] for robot in robots)
    return tuple(name for name in first if name in second)


def machine_problem(robots: Arms) -> str:
    """Why two robots cannot be the arms of one machine, or an empty string.

    Raises:
        RobotModelError: see `symbolic.robot.urdf.arm_model`.
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
