"""The rack with its left robot on a rail and a gripper on both, written twice for tests: as people
have robots (xacro, packages, meshes, SRDF, patterns, joints of every kind), and plainly."""

from __future__ import annotations

from pathlib import Path

import trimesh

from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.symbolic.read.samples import GOFA, RACK

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


def _slide(limits: str) -> str:
    return (
        '<link name="rail"/><joint name="slide" type="prismatic"><parent link="rail"/>'
        f'<child link="base_link"/><axis xyz="1 0 0"/>{limits}</joint>'
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


def _cell(folder: Path, robots: tuple[str, str], ignored: str) -> Workcell:
    """The rack with the keys of both robots in place of their `urdf`."""
    text = RACK.read_text(encoding="utf-8")
    flange = 'urdf = "../robots/gofa12.urdf"\nflange = "tool0"\n'
    for keys in robots:
        assert flange in text
        text = text.replace(flange, keys, 1)
    # The rail's x axis is the world's -y.
    text = _changed(text, {"[-0.15, 1.15, 0.20]": f"[-0.15, {1.15 + AWAY}, 0.20]"})
    low, high = AWAY - 0.05, AWAY + 0.05
    slide = f'redundant = [{{joint = "slide", lower = {low}, upper = {high}, initial = {AWAY}}}]'
    path = folder / "cell.toml"
    text = text.replace("[task]", f"[task]\n{slide}")
    path.write_text(f"{text}\n{ignored}", encoding="utf-8")
    return load(path)


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
    ignored = _ignored("right/*_finger", "middle boar?") + _ignored("*/base_li?k", "left ped*")
    return _cell(folder, (left, right), ignored)


def plain_cell(folder: Path) -> Workcell:
    """The same in plain words: two URDFs with boxes, every angle and every pair written out."""
    text = GOFA.read_text(encoding="utf-8")
    # A continuous joint may turn twice either way.
    sixth = text.index('name="joint_6"')
    turns = text[sixth:].replace(f"{FULL_TURN:.15f}", "12.566370614359172")
    text = text[:sixth] + turns
    limits = '<limit lower="-9" upper="9" effort="2000" velocity="1.0"/>'
    railed = text.replace('<robot name="gofa12">', f'<robot name="gofa12">{_slide(limits)}')
    fingers = "".join(
        _FINGER.format(f"{name}_finger") + _finger_joint(name, "fixed", "", angle)
        for name, angle in (("grip", GRIP), ("follow", MULTIPLIER * GRIP + OFFSET))
    )
    (folder / "left.urdf").write_text(railed, encoding="utf-8")
    (folder / "right.urdf").write_text(text.replace("</robot>", f"{fingers}</robot>"))
    left, right = (f'urdf = "{side}.urdf"\nflange = "tool0"\n' for side in ("left", "right"))
    pairs = [
        (f"left/{NEVER[0]}", f"left/{NEVER[1]}"),
        ("left/base_link", "left pedestal"),
        ("right/grip_finger", "middle board"),
        ("right/follow_finger", "middle board"),
    ]
    return _cell(folder, (left, right), "".join(_ignored(*pair) for pair in pairs))


def _ignored(first: str, second: str) -> str:
    return (
        f'[[collision.ignored]]\nfirst = "{first}"\nsecond = "{second}"\nreason = "for the test"\n'
    )
