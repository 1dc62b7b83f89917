"""Both arms of a cell as bundles name them: their makers and joints, and one URDF of both with a
simulator's hardware for ros2_control.

Names of links and joints begin with the robot's prefix. The arms of one machine share its
description and need no prefix. Joints that the workcell holds are fixed at their positions.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.arms import (
    arm_model,
    held_joints,
    moving_joints,
    one_machine,
    robot_urdf,
    turning_joints,
)
from symbolic.read.urdf import UrdfMesh
from symbolic.records import Body, Box, Capsule, Cylinder, Mesh, Robot, Shape, Sphere, Workcell
from symbolic.records.cell import ADDRESS
from symbolic.records.poses import pose_matrix, rpy_from_rotation

_LONGEST_COMMENT = 60
WORLD, PAD = "world", "contact_pad"
PLUGIN = "gz_ros2_control/GazeboSimSystem"
STATE_INTERFACES = ("position", "velocity", "effort")

ABB = "ABB"

UR = "UR e-series"

FRANKA = "Franka"

SIX, SEVEN = 6, 7
"""Numbers of axes of an arm that targets in a maker's language support."""

_SIGNS = {
    ABB: re.compile(r"(?<![a-z])(abb|irb|crb|gofa|yumi|swifti)(?![a-z])"),
    FRANKA: re.compile(r"(?<![a-z])(panda|fr3|fp3|fer|franka)(?![a-z])"),
    UR: re.compile(r"(?<![a-z0-9])(ur(3|5|10|16)e|ur(7e|8|12e|15|18|20|30))(?![a-z0-9])"),
}


def require_arms(
    workcell: Workcell,
    target: str,
    maker: str,
    axes: Sequence[int],
    has_address: bool = False,
    any_arm: bool = False,
) -> None:
    """Check that both arms fit a target: their maker, their joints and, if asked, their addresses.

    Args:
        workcell: the cell.
        target: name of the target, for messages.
        maker: maker of the arms that the target supports.
        axes: allowed numbers of revolute joints per arm.
        has_address: True if the workcell has to state the address of each arm's controller.
        any_arm: True to accept arms of any maker.

    Raises:
        SettingsError: no name in an arm's description (file, robot, links, xacro arguments)
            indicates the maker; an arm has another number of joints or a sliding joint; or an
            address is missing.
    """
    for robot in workcell.robots:
        if not any_arm and not _SIGNS[maker].search(described(robot)):
            raise SettingsError(
                f"robot {robot.name!r} is described by {robot.urdf.name}, which does not look like "
                f"an arm of {maker}; {target} is theirs: choose another target, or force it "
                "(--any-arm) where zero and signs of its joints are the controller's",
                code="another-maker",
            )
        turning = turning_joints(arm_model(robot))
        if len(turning) not in axes or not all(turning):
            slide = "" if all(turning) else f", {turning.count(False)} of them sliding"
            raise SettingsError(
                f"robot {robot.name!r} has {len(turning)} joints{slide}; targets of {target} "
                f"hold {' or '.join(map(str, axes))} turning axes, choose another target",
                code="joint-count",
            )
        if has_address and not robot.driver.address:
            raise SettingsError(
                f"{target} has to know where the controller of {robot.name!r} is: write "
                '[robots.driver] with address = "..." into its section of the workcell, or export '
                "with --address HOST HOST, in the order of the robots",
                code="no-address",
            )


SECTION_OF_EACH = (
    "the workcell's section of each robot before the study, or into a file for export --driver"
)
"""Text on where a driver's key may be stated. A stored trajectory keeps the cell in which it was
found."""


@dataclass(frozen=True)
class Lines:
    """Names that a target allows for the outputs that switch hands, and for the inputs that report
    their state.

    Attributes:
        output, input: regular expression of an output's and of an input's name.
        meaning: description of both names, for messages.
    """

    output: str
    input: str
    meaning: str

    def require(self, workcell: Workcell, target: str) -> None:
        """Check that the names of the outputs that switch a cell's hands, and of the inputs that
        report their state, are names that a target allows. Inputs may be missing.

        Args:
            workcell: the cell.
            target: name of the target, for messages.

        Raises:
            SettingsError: a name is not allowed; the message states the key and the allowed names.
        """
        for robot in workcell.robots:
            driver = robot.driver
            known = [("grip_output", self.output, driver.grip_output)]
            known += [("grip_input", self.input, driver.grip_input)] if driver.grip_input else []
            for key, pattern, found in known:
                if not re.fullmatch(pattern, found):
                    raise SettingsError(
                        f"{target} reaches the hands of {robot.name!r} by {self.meaning}; "
                        f'{key} is {found!r}: write [robots.driver] with {key} = "..." into '
                        f"{SECTION_OF_EACH}",
                        code="hand-lines",
                    )


def plan_of(
    workcell: Workcell,
    target: str,
    program: str,
    leads: Sequence[float],
    stiffness: float | None,
    presses: bool,
) -> dict[str, Any]:
    """Return the planned values of a bundle as JSON values: driver settings, stiffness and leads.
    The bundle's bring-up program compares them with measured values.

    Args:
        workcell: the cell.
        target: name of the target.
        program: name of the program that runs the job.
        leads: for each arm, the part of its delay that the program compensates by sending commands
            ahead [s].
        stiffness: stiffness of each arm at its pad [N/m]; None if the job does not depend on it.
        presses: True if the bring-up program presses a block and measures the force by the arms'
            sensors.
    """
    drivers = [vars(robot.driver).items() for robot in workcell.robots]
    return {
        "target": target,
        "program": program,
        "leads": list(leads),
        "presses": presses,
        "stiffness": stiffness,
        "drivers": [{k: v for k, v in driver if v is not None} for driver in drivers],
    }


SERVICES = Lines(
    "/.+",
    "/.+",
    "a service of std_srvs/srv/SetBool and a topic of std_msgs/msg/Bool, /NAME each",
)
"""Names of hands in ROS 2, for any arms."""


def addressed(workcell: Workcell, addresses: tuple[str, str]) -> Workcell:
    """Return the cell with other host names or IP addresses of its two controllers.

    Args:
        addresses: host name or IP address of each robot's controller.

    Raises:
        SettingsError: an address is neither a host name nor an IP address.
    """
    for address in addresses:
        if ADDRESS.problem(address):
            raise SettingsError(
                f"address {address!r} is no host name or IP address", code="wrong-address"
            )
    robots = zip(workcell.robots, addresses, strict=True)
    first, second = (replace(r, driver=replace(r.driver, address=at)) for r, at in robots)
    return replace(workcell, robots=(first, second))


def described(robot: Robot) -> str:
    """Return the words that may name the maker of a robot, in one lower-case text: its file, name,
    links and values of xacro arguments."""
    urdf = robot_urdf(robot)
    words = [robot.urdf.name, urdf.name, *urdf.links]
    words += [value for _, value in robot.xacro_arguments]
    return " ".join(words).lower().replace("_", " ")


def robot_prefix(name: str) -> str:
    """Convert a robot's name to a prefix that ROS and RAPID accept: lower-case letters, digits and
    underscores, with '_' at the end."""
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name.lower())
    return f"{'r' if not plain[:1].isalpha() else ''}{plain}_"


def comment(text: str) -> str:
    """Return a text with a '?' for each character that could end a comment line in a robot's
    language, cut to the longest allowed length."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:_LONGEST_COMMENT]


def prefixes(workcell: Workcell) -> tuple[str, str]:
    """Return for each robot the prefix of its links and joints in ROS.

    Both are '' if the robots are arms of one machine.

    Raises:
        SettingsError: the prefixes in the file would give joints of both arms the same names.
    """
    if one_machine(workcell.robots):
        return "", ""
    stated = [robot.driver.prefix for robot in workcell.robots]
    if stated[0] is not None and stated[0] == stated[1]:
        if set(_moving(workcell.robots[0])) & set(_moving(workcell.robots[1])):
            raise SettingsError(
                f"both drivers have the prefix {stated[0]!r}, so that both arms' joints have the "
                "same names: give [robots.driver] of each robot a prefix of its own",
                code="prefix",
            )
        return stated[0], stated[0]
    first, second = (
        robot_prefix(robot.name) if prefix is None else prefix
        for robot, prefix in zip(workcell.robots, stated, strict=True)
    )
    return (first, second) if first != second else (f"a_{first}", f"b_{second}")


def ros_joints(workcell: Workcell) -> dict[str, int]:
    """Return the column of each joint, by its name in ROS, in arrays (n, joints) of both arms side
    by side. A joint that moves both arms of a machine has its column in the first arm."""
    both = zip(workcell.robots, prefixes(workcell), strict=True)
    names = [f"{prefix}{name}" for robot, prefix in both for name in _moving(robot)]
    return {name: names.index(name) for name in names}


def pad_frame(prefix: str, arm: int) -> str:
    """Return the name of the frame of an arm's pad, from its prefix or, without one, its index."""
    return f"{prefix or f'arm_{arm + 1}_'}{PAD}"


def description(workcell: Workcell, q: Array) -> str:
    """Return the text of a URDF of the whole cell: both arms, tools, pads and environment.

    Args:
        workcell: the cell.
        q: (joints,) joint positions of both arms side by side, at which a simulator starts [rad or
            m].
    """
    root = ElementTree.Element("robot", {"name": "cell"})
    ElementTree.SubElement(root, "link", {"name": WORLD})
    shared = one_machine(workcell.robots)
    moving_of_both = {name for robot in workcell.robots for name in _moving(robot)}
    for arm, (robot, prefix) in enumerate(zip(workcell.robots, prefixes(workcell), strict=True)):
        if not (shared and arm == 1):
            moving = moving_of_both if shared else set(_moving(robot))
            _add_robot(root, robot, prefix, moving)
        flange, pad = f"{prefix}{robot.flange}", pad_frame(prefix, arm)
        _add_fixed(root, flange, f"{pad.removesuffix(PAD)}tool_of_cell", robot.tool)
        _joint(root, f"{pad}_fixed", flange, pad, robot.T_flange_pad)
        ElementTree.SubElement(root, "link", {"name": pad})
    for body in workcell.environment:
        _add_fixed(root, WORLD, f"environment_{robot_prefix(body.name)}".rstrip("_"), (body,))
    joints = ros_joints(workcell)
    _add_hardware(root, list(joints), q[list(joints.values())])
    # Robots compensate their own weight; a simulator leaves it out.
    for link in root.findall("link"):
        weightless = ElementTree.SubElement(root, "gazebo", {"reference": link.attrib["name"]})
        ElementTree.SubElement(weightless, "gravity").text = "false"
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _moving(robot: Robot) -> tuple[str, ...]:
    return moving_joints(robot_urdf(robot), robot.chain_root, robot.flange, robot.locked_joints)


def _add_robot(root: ElementTree.Element, robot: Robot, prefix: str, moving: set[str]) -> None:
    urdf = robot_urdf(robot)
    held = dict(held_joints(urdf, sorted(moving), robot.locked_joints))
    children = {joint.child for joint in urdf.joints.values()}
    base = next(link for link in urdf.links if link not in children)
    _joint(root, f"{prefix}mount", WORLD, f"{prefix}{base}", robot.T_world_base)
    for element in ElementTree.fromstring(urdf.kinematics):
        name = element.attrib["name"]
        element.set("name", f"{prefix}{name}")
        if element.tag == "link":
            for collision in urdf.collisions.get(name, ()):
                _shapes(element, collision.shape, collision.pose)
        else:
            for end in ("parent", "child"):
                found = element.find(end)
                assert found is not None, "a checked joint has both ends"
                found.set("link", f"{prefix}{found.attrib['link']}")
            if name in held:
                _hold(element, held[name])
        root.append(element)


def _hold(joint: ElementTree.Element, position: float) -> None:
    """Replace a URDF joint, in place, by a fixed joint at a given position.

    Args:
        joint: the joint's element.
        position: position of the joint at which it is fixed [rad or m].
    """
    origin, axis = joint.find("origin"), joint.find("axis")
    xyz, rpy = (
        _numbers("0 0 0" if origin is None else origin.get(key, "0 0 0")) for key in ("xyz", "rpy")
    )
    direction = np.array([1.0, 0.0, 0.0] if axis is None else _numbers(axis.attrib["xyz"]))
    direction = direction / np.linalg.norm(direction)
    moved = np.eye(4)
    if joint.attrib["type"] == "revolute":
        moved[:3, :3] = Rotation.from_rotvec(position * direction).as_matrix()
    elif joint.attrib["type"] == "prismatic":
        moved[:3, 3] = position * direction
    for child in list(joint):
        if child.tag not in ("parent", "child"):
            joint.remove(child)
    joint.set("type", "fixed")
    _origin(joint, pose_matrix(xyz, rpy) @ moved)


def _add_fixed(root: ElementTree.Element, parent: str, name: str, bodies: Sequence[Body]) -> None:
    """Add a link `name` with some bodies to a URDF, fixed to the link `parent` and with the same
    frame."""
    _joint(root, f"{name}_fixed", parent, name, np.eye(4))
    link = ElementTree.SubElement(root, "link", {"name": name})
    for body in bodies:
        _shapes(link, body.shape, body.pose)


def _shapes(link: ElementTree.Element, shape: Shape | Capsule | UrdfMesh, pose: Array) -> None:
    """Add a shape at a pose (4, 4) to a URDF link, as visual and as collision geometry. Capsules,
    which URDF lacks, become a cylinder and two spheres."""
    if isinstance(shape, Capsule):
        _shapes(link, Cylinder(shape.radius, shape.length), pose)
        for side in (-0.5, 0.5):
            end = pose.copy()
            end[:3, 3] += side * shape.length * pose[:3, 2]
            _shapes(link, Sphere(shape.radius), end)
        return
    for kind in ("visual", "collision"):
        element = ElementTree.SubElement(link, kind)
        _origin(element, pose)
        geometry = ElementTree.SubElement(element, "geometry")
        match shape:
            case Box():
                ElementTree.SubElement(geometry, "box", {"size": _text(shape.size)})
            case Cylinder():
                size = {"radius": repr(shape.radius), "length": repr(shape.length)}
                ElementTree.SubElement(geometry, "cylinder", size)
            case Sphere():
                ElementTree.SubElement(geometry, "sphere", {"radius": repr(shape.radius)})
            case Mesh() | UrdfMesh():
                address = shape.address if isinstance(shape, UrdfMesh) else f"file://{shape.path}"
                mesh = {"filename": address, "scale": _text(shape.scale)}
                ElementTree.SubElement(geometry, "mesh", mesh)


def _add_hardware(root: ElementTree.Element, joints: Sequence[str], q: Array) -> None:
    control = ElementTree.SubElement(root, "ros2_control", {"name": "cell", "type": "system"})
    hardware = ElementTree.SubElement(control, "hardware")
    ElementTree.SubElement(hardware, "plugin").text = PLUGIN
    for name, position in zip(joints, q.tolist(), strict=True):
        joint = ElementTree.SubElement(control, "joint", {"name": name})
        ElementTree.SubElement(joint, "command_interface", {"name": "effort"})
        for state in STATE_INTERFACES:
            interface = ElementTree.SubElement(joint, "state_interface", {"name": state})
            if state == "position":
                value = ElementTree.SubElement(interface, "param", {"name": "initial_value"})
                value.text = repr(position)


def _joint(root: ElementTree.Element, name: str, parent: str, child: str, pose: Array) -> None:
    joint = ElementTree.SubElement(root, "joint", {"name": name, "type": "fixed"})
    _origin(joint, pose)
    ElementTree.SubElement(joint, "parent", {"link": parent})
    ElementTree.SubElement(joint, "child", {"link": child})


def _origin(element: ElementTree.Element, pose: Array) -> None:
    origin = {"xyz": _text(pose[:3, 3]), "rpy": _text(rpy_from_rotation(pose[:3, :3]))}
    ElementTree.SubElement(element, "origin", origin)


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.split()]


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))
