"""Cells with redundant joints, with these joints locked, and with boxes that are turned over; the
rack with a robot on a rail and grippers, in odd words and in plain ones."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import Waypoint, Workcell
from symbolic.records.poses import Orientation, rotation_from_rpy
from tests.machines import MACHINES, SINGLE, machine_cell, single_cell
from tests.symbolic.cells import fixed, free, hand_cell, with_task
from tests.symbolic.read.samples import GOFA, RACK

PANDA_JOINT = "panda_joint3"


def locked_pandas(folder: Path, angle: float) -> Workcell:
    """Two Pandas that carry a box a little, their third joints locked."""
    return load(single_cell(SINGLE["panda"], folder, {PANDA_JOINT: angle}))


def _redundant(path: Path, *entries: str) -> Workcell:
    """The cell of a file whose task is told these redundant joints."""
    given = f'"redundant" = [{", ".join(f"{{joint = {entry}}}" for entry in entries)}]'
    path.write_text(path.read_text().replace('"samples" =', f'{given}, "samples" ='))
    return load(path)


def free_pandas(folder: Path, entry: str = "", joint: str = PANDA_JOINT) -> Workcell:
    """The same, these joints redundant; `entry` is what the file says of them, or of another."""
    path = single_cell(SINGLE["panda"], folder, {})
    return _redundant(path, f'"{joint}", {entry}') if entry else load(path)


def seven_joints(name: str, folder: Path) -> Workcell:
    """A cell of an arm of `SINGLE` or a machine of `MACHINES`, the joint that is locked there
    redundant."""
    if name in SINGLE:
        arms = [SINGLE[name]]
        path = single_cell(SINGLE[name], folder, {})
    else:
        machine = MACHINES[name]
        arms = [machine.left, machine.right]
        left, right = (replace(arm, locked={}) for arm in arms)
        path = machine_cell(replace(machine, left=left, right=right), folder)
    text = path.read_text()
    for arm in arms:  # a joint of both robots' arms is named twice, as it has to be
        text = re.sub(
            rf'(?<="chain" = \["{arm.chain[0]}", "{arm.chain[1]}"\], )',
            f'"redundant_joints" = {json.dumps(list(arm.locked))}, ',
            text,
        )
    path.write_text(text)
    joints = [entry for arm in arms for entry in arm.locked.items()]
    return _redundant(path, *(f'"{joint}", initial = {angle}' for joint, angle in joints))


def _slide(limits: str) -> str:
    """The links of a rail below an arm, as URDF."""
    return (
        '<link name="rail"/><joint name="slide" type="prismatic"><parent link="rail"/>'
        f'<child link="base_link"/><axis xyz="1 0 0"/>{limits}</joint>'
    )


def _railed(gofa: str) -> str:
    """An arm's URDF with a rail below it."""
    slide = _slide('<limit lower="-9" upper="9" effort="2000" velocity="1.0"/>')
    return _changed(gofa, {'<robot name="gofa12">': f'<robot name="gofa12">{slide}'})


def _on_rail(folder: Path, robots: tuple[str, str], away: float, room: float) -> Path:
    """The file of the rack with the keys of both robots in place of their `urdf`, the left one on
    a slide; see `rack_on_rail`."""
    text = RACK.read_text(encoding="utf-8")
    flange = 'urdf = "../robots/gofa12.urdf"\nflange = "tool0"\n'
    for keys in robots:
        assert flange in text
        text = text.replace(flange, keys, 1)
    # The root's x axis is the world's -y.
    text = _changed(text, {"[-0.15, 1.15, 0.20]": f"[-0.15, {1.15 + away}, 0.20]"})
    low, high = away - room, away + room
    given = f'redundant = [{{joint = "slide", lower = {low}, upper = {high}, initial = {away}}}]'
    path = folder / "cell.toml"
    path.write_text(text.replace("[task]", f"[task]\n{given}"), encoding="utf-8")
    return path


def rack_on_rail(folder: Path, away: float, room: float = 0.0) -> Workcell:
    """The rack, its left robot on a slide whose root stands `away` [m] behind its place: it is
    there where the slide is out by as much, as in the hand-made trajectory. Elsewhere it may be as
    far from there as there is room [m]."""
    (folder / "rail.urdf").write_text(_railed(GOFA.read_text()))
    left, right = (f'urdf = "{urdf}"\nflange = "tool0"\n' for urdf in ("rail.urdf", GOFA))
    return load(_on_rail(folder, (left, right), away, room))


def machine_on_lift(folder: Path, height: float, free: bool) -> Workcell:
    """TIAGo's two arms, its lift a joint of both that is redundant or locked [m]."""
    machine = MACHINES["tiago_dual"]
    folder.mkdir(parents=True, exist_ok=True)
    arms = []
    for arm in (machine.left, machine.right):
        held = arm.locked if free else arm.locked | {"torso_lift_joint": height}
        arms.append(replace(arm, chain=("base_footprint", arm.chain[1]), locked=held))
    x, y, z = machine.box
    lifted = replace(machine, left=arms[0], right=arms[1], box=(x, y, z + height))
    path = machine_cell(lifted, folder)
    return _redundant(path, f'"torso_lift_joint", initial = {height}') if free else load(path)


QUARTER = np.pi / 2.0
TURNS = [0.0, 0.7, QUARTER, 2.5, np.pi]
"""Of the box about the line through both pads at the waypoints: through a right angle, where roll,
pitch and yaw are singular."""

REFERENCE = Orientation("quaternion", rotation_from_rpy([0.0, -QUARTER, 0.0]))
"""Rotation vectors count from a box that lies on its side."""


def turned_cell(time_law: str = "constant") -> Workcell:
    """The hand-written cell with the box turned over; waypoints may tilt it as well."""
    return with_task(
        hand_cell(),
        waypoints=_waypoints(),
        time_law=time_law,
        orientation=REFERENCE,
        samples=30,
    )


def _waypoints() -> tuple[Waypoint, ...]:
    given = hand_cell().task.waypoints
    half = [0.05, 0.03, 0.05, 0.12, 0.1, 0.12]
    poses = [np.array([*(w.lower + w.upper)[:3] / 2.0, 0.0, QUARTER, 0.0]) for w in given]
    for pose, turn in zip(poses, TURNS, strict=True):
        pose[4] += turn
    return (fixed(poses[0]), *(free(pose, half) for pose in poses[1:-1]), fixed(poses[-1]))


def turned_transfer(folder: Path) -> Workcell:
    """The transfer cell without its obstacles, its crate turned over about the pads' line and
    tilted on the way, as a file."""
    text = RACK.with_name("transfer.toml").read_text()
    text = text.replace("../robots/", f"{RACK.parent.parent}/robots/")
    text = text[: text.index("[task]")]
    task = f"""[task]
rotation = "quaternion"
start = [-0.30, 0.0, 0.90, 0.0, 0.0, 0.0]
goal = [0.30, 0.0, 0.90, 0.0, {np.pi}, 0.0]
samples = 60
time_law = "constant"
reference_speed = 0.30
reference_force = 117.68
initial = [[0.0, 0.0, 0.95, 0.05, {QUARTER}, -0.05]]

[[task.waypoints]]
lower = [-0.05, -0.05, 0.90, -0.1, 1.4, -0.1]
upper = [0.05, 0.05, 1.00, 0.1, 1.8, 0.1]
"""
    path = folder / "turned.toml"
    path.write_text(text + task)
    return load(path)


def random_x(cell: Workcell, seed: int) -> Array:
    """A decision vector within the bounds."""
    return np.random.default_rng(seed).uniform(cell.task.lower, cell.task.upper)


# --- the rack twice: as people have robots (xacro, packages, meshes, patterns), and plainly ---


AWAY, GRIP, MULTIPLIER, OFFSET = 0.3, 0.4, -2.0, 0.5
"""Where the rail is out [m], the gripper's held joint [rad], and how the other finger follows."""

BASE, UPPER, ELBOW = (0.205, 0.2, 0.03), (0.161, 0.093, 0.707), (0.126, 0.106, 0.115)
"""Boxes of the arm that become meshes, of an installed, an ament and a ROS package [m]."""

NEVER = ("link_1", "link_4")
FULL_TURN = 4.712388980384690
SOURCES = ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH")
"""Variables that have to name `folder/ament` and `folder/ros`; `folder/site` has to be on
`sys.path`."""

_INERTIAL = (
    '<inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" '
    'iyz="0"/></inertial>'
)
_FINGER = (
    '<link name="{0}">' + _INERTIAL + '<collision><origin xyz="0.02 0 0"/><geometry>'
    '<box size="0.03 0.01 0.01"/></geometry></collision></link>'
)


def _finger_joint(name: str, kind: str, inside: str, angle: float = 0.0) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="tool0"/><child link="{name}_finger"/>'
        f'<origin xyz="0.04 0 0.02" rpy="0 0 {angle!r}"/><axis xyz="0 0 1"/>{inside}</joint>'
    )


def _box(size: tuple[float, float, float]) -> str:
    return f'<box size="{size[0]:g} {size[1]:g} {size[2]:g}"/>'


def _changed(text: str, changes: dict[str, str]) -> str:
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def described_cell(folder: Path) -> Workcell:
    """As people have robots; see `SOURCES` for what has to be set before."""
    files = {
        folder / "site" / "cmeel.prefix" / "share" / "plinth" / "base.stl": (BASE, 1000.0),
        folder / "ament" / "share" / "upper" / "arm.dae": (UPPER, 1.0),
        folder / "ros" / "src" / "elbow" / "meshes" / "elbow.obj": (ELBOW, 1.0),
    }
    for path, (size, scale) in files.items():
        path.parent.mkdir(parents=True)
        trimesh.creation.box([scale * length for length in size]).export(path)
    (folder / "ros" / "src" / "elbow" / "package.xml").write_text("<package/>")
    macro = (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="rail" params="v">'
    )
    limits = '<limit lower="-9" upper="9" effort="2000" velocity="${v}"/>'
    (folder / "ament" / "share" / "upper" / "rail.xacro").write_text(
        f"{macro}{_slide(limits)}</xacro:macro></robot>"
    )
    gripper = (
        _FINGER.format("grip_finger")
        + _FINGER.format("follow_finger")
        + _finger_joint("grip", "revolute", '<limit lower="-1" upper="1" effort="9" velocity="3"/>')
        + _finger_joint(
            "follow",
            "revolute",
            '<limit lower="-3" upper="3" effort="9" velocity="3"/>'
            f'<mimic joint="grip" multiplier="{MULTIPLIER}" offset="{OFFSET}"/>',
        )
    )
    on_rail = (
        '<xacro:arg name="on_rail" default="false"/><xacro:if value="$(arg on_rail)">'
        '<xacro:include filename="$(find upper)/rail.xacro"/>'
        '<xacro:rail v="${2 * 0.5}"/></xacro:if>'
    )
    text = _changed(
        GOFA.read_text(encoding="utf-8"),
        {
            '<robot name="gofa12">': '<robot name="gofa12" '
            f'xmlns:xacro="http://www.ros.org/wiki/xacro">{on_rail}',
            _box(BASE): '<mesh filename="package://plinth/base.stl" scale="0.001 0.001 0.001"/>',
            _box(UPPER): '<mesh filename="package://upper/arm.dae"/>',
            _box(ELBOW): '<mesh filename="package://elbow/meshes/elbow.obj"/>',
            'name="joint_6" type="revolute"': 'name="joint_6" type="continuous"',
            "</robot>": f"{gripper}</robot>",
        },
    )
    (folder / "gofa.urdf.xacro").write_text(text, encoding="utf-8")
    (folder / "gofa.srdf").write_text(
        f'<robot><disable_collisions link1="{NEVER[0]}" link2="{NEVER[1]}" reason="Never"/></robot>'
    )
    urdf = 'urdf = "gofa.urdf.xacro"\n'
    left = (
        f'{urdf}chain = ["rail", "tool0"]\nxacro_arguments = {{ on_rail = "true" }}\n'
        'drop_links = ["*_finger"]\nsrdf = "gofa.srdf"\n'
    )
    right = f'{urdf}chain = ["base_link", "tool0"]\nlocked_joints = {{ grip = {GRIP} }}\n'
    ignored = [("right/*_finger", "middle boar?"), ("*/base_li?k", "left ped*")]
    return _ignoring(_on_rail(folder, (left, right), AWAY, 0.05), ignored)


def plain_cell(folder: Path) -> Workcell:
    """The same in plain words: two URDFs with boxes, every angle and every pair written out."""
    text = GOFA.read_text(encoding="utf-8")
    # A continuous joint may turn twice either way.
    sixth = text.index('name="joint_6"')
    turns = text[sixth:].replace(f"{FULL_TURN:.15f}", "12.566370614359172")
    text = text[:sixth] + turns
    fingers = "".join(
        _FINGER.format(f"{name}_finger") + _finger_joint(name, "fixed", "", angle)
        for name, angle in (("grip", GRIP), ("follow", MULTIPLIER * GRIP + OFFSET))
    )
    (folder / "left.urdf").write_text(_railed(text), encoding="utf-8")
    (folder / "right.urdf").write_text(text.replace("</robot>", f"{fingers}</robot>"))
    left, right = (f'urdf = "{side}.urdf"\nflange = "tool0"\n' for side in ("left", "right"))
    pairs = [
        (f"left/{NEVER[0]}", f"left/{NEVER[1]}"),
        ("left/base_link", "left pedestal"),
        ("right/grip_finger", "middle board"),
        ("right/follow_finger", "middle board"),
    ]
    return _ignoring(_on_rail(folder, (left, right), AWAY, 0.05), pairs)


def _ignoring(path: Path, pairs: list[tuple[str, str]]) -> Workcell:
    """The cell of a file in which some pairs of bodies are not checked."""
    tables = [
        f'[[collision.ignored]]\nfirst = "{first}"\nsecond = "{second}"\nreason = "for the test"\n'
        for first, second in pairs
    ]
    path.write_text("\n".join([path.read_text(), *tables]))
    return load(path)
