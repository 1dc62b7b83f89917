"""What may be wrong with a URDF: a change to the GoFa's, the place that is named, what is said."""

from __future__ import annotations

from collections.abc import Callable


def swap(old: str, new: str, count: int = 1) -> Callable[[str], str]:
    return lambda text: text.replace(old, new, count)


def mass(value: str) -> Callable[[str], str]:
    return swap('<mass value="8.411"/>', f'<mass value="{value}"/>')


def inertia(moments: str) -> Callable[[str], str]:
    own = 'ixx="0.0486" ixy="0" ixz="0" iyy="0.0378" iyz="-0.0008" izz="0.0394"'
    return swap(own, moments)


def child(of: str, other: str) -> Callable[[str], str]:
    return swap(f'<child link="{of}"/>', f'<child link="{other}"/>')


def axis(numbers: str) -> Callable[[str], str]:
    return swap('<axis xyz="0 1 0"/>', f'<axis xyz="{numbers}"/>')


def beside(more: str) -> Callable[[str], str]:
    return swap("</robot>", f"{more}</robot>")


def shape(instead: str) -> Callable[[str], str]:
    """Another shape in the first collision element of `base_link`."""
    before = '<collision>\n      <origin xyz="-0.0025 0 0.015" rpy="0 0 0"/>\n      <geometry>'
    return swap(f'{before}<box size="0.205 0.2 0.03"/>', before + instead)


LOOP = (
    '<link name="a"/><link name="b"/>'
    '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
)
MESHES = "".join(
    f"<visual><geometry><mesh filename='package://a/{k}.stl'/></geometry></visual>"
    for k in range(2001)
)
INERTIAL, SHAPE = "link 'link_1'/inertial", "link 'base_link'/collision[0]/geometry"
MASS, INERTIA = f"{INERTIAL}/mass value", f"{INERTIAL}/inertia"
IN_GRAMS = 'ixx="900" ixy="0" ixz="0" iyy="900" iyz="0" izz="900"'

CASES: list[tuple[Callable[[str], str], str, str]] = [
    (mass("nan"), MASS, "'nan'"),
    (mass("-1"), MASS, "0 to 10000 kg"),
    (mass("1e308"), MASS, "1e+308"),
    (mass("heavy"), MASS, "'heavy'"),
    (mass("1_0"), MASS, "'1_0'"),
    (swap('<mass value="8.411"/>', ""), INERTIAL, "<mass> is missing"),
    (swap('ixx="0.0486"', 'ixx="NaN"'), f"{INERTIA} ixx", "'NaN'"),
    (swap('izz="0.0394"', ""), f"{INERTIA} izz", "is missing"),
    (swap('ixx="0.0486"', 'ixx="-0.0486"'), INERTIA, "none below zero"),
    (inertia(IN_GRAMS), INERTIA, "are the units kg m^2?"),
    (child("link_3", "link_2"), "joint 'joint_3'", "same link 'link_2'"),
    (swap("</robot>", LOOP), "link 'a'", "part of a loop"),
    (child("link_3", "link_4"), "joint 'joint_4'/child link", "child of joint 'joint_3' already"),
    (beside('<link name="a"/>'), "robot", "2 links without parent ('base_link', 'a')"),
    (child("link_3", "lnik_3"), "joint 'joint_3'/child link", "did you mean 'link_"),
    (axis("0 0 0"), "joint 'joint_2'/axis xyz", "an axis without length"),
    (axis("0 1"), "joint 'joint_2'/axis xyz", "allowed: 3 numbers"),
    (
        swap('"joint_4" type="revolute"', '"joint_4" type="revolut"'),
        "joint 'joint_4' type",
        "did you mean 'revolute'",
    ),
    (swap('name="link_2">', 'name="link_1">'), "link[2] name", "found 'link_1' again"),
    (swap('<link name="link_2">', "<link>"), "link[2] name", "is missing"),
    (shape('<box size="205 200 30"/>'), f"{SHAPE}/box size[0]", "205 mm are 0.205 m"),
    (shape('<sphere radius="-1"/>'), f"{SHAPE}/sphere radius", "found -1"),
    (shape('<cone radius="1"/>'), SHAPE, "found 'cone'; allowed is one of box"),
    (shape(""), SHAPE, "found nothing"),
    (shape('<mesh filename="a.stl" scale="nan 1 1"/>'), f"{SHAPE}/mesh scale[0]", "'nan'"),
    (shape('<mesh filename="a.stl" scale="1 0 1"/>'), f"{SHAPE}/mesh scale", "none of it zero"),
    (shape("<mesh/>"), f"{SHAPE}/mesh filename", "is missing"),
    (swap('"utf-8"', '"ebcdic"'), "declares the encoding", "'ebcdic'; allowed is UTF-8"),
    (swap("<robot", '<!DOCTYPE r [<!ENTITY a "b">]>\n<robot'), "has a document type", "remove it"),
    (beside('<x:a xmlns:x="http://www.ros.org/wiki/xacro"/>'), "holds xacro macros", "expand it"),
    (beside("<a>" * 40 + "</a>" * 40), "nested too deeply", "a depth of 32"),
    (
        beside("<a " + " ".join(f"a{k}=''" for k in range(500_001)) + "/>"),
        "has more than 500000 attributes",
        "",
    ),
    (swap("</link>", f"{MESHES}</link>"), "names 2001 mesh files; allowed are 2000", ""),
    (
        swap('velocity="2.094395102393195"', 'velocity="-1"'),
        "joint 'joint_1'/limit velocity",
        "found -1; allowed is 0",
    ),
    (beside("<a/>" * 100_001), "has more than 100000 elements", ""),
]
