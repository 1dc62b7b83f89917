"""What may be wrong with a URDF: a change to the GoFa's, the place that is named, what is said."""

from __future__ import annotations

from collections.abc import Callable


def swap(old: str, new: str, count: int = 1) -> Callable[[str], str]:
    return lambda text: text.replace(old, new, count)


MESH = "<visual><geometry><mesh filename='package://a/{}.stl'/></geometry></visual>"


MASS = '<mass value="8.411"/>'


INERTIA = 'ixx="0.0486" ixy="0" ixz="0" iyy="0.0378" iyz="-0.0008" izz="0.0394"'


BOX = '<box size="0.205 0.2 0.03"/>'


LOOP = (
    '<link name="a"/><link name="b"/>'
    '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
)


COLLISION = (
    '<collision>\n      <origin xyz="-0.0025 0 0.015" rpy="0 0 0"/>\n      '
    f"<geometry>{BOX}</geometry>"
)


def in_collision(shape: str) -> Callable[[str], str]:
    return swap(COLLISION, COLLISION.replace(BOX, shape))


CASES: list[tuple[str, Callable[[str], str], str, str]] = [
    ("mass nan", swap(MASS, '<mass value="nan"/>'), "link 'link_1'/inertial/mass value", "'nan'"),
    (
        "mass negative",
        swap(MASS, '<mass value="-1"/>'),
        "link 'link_1'/inertial/mass value",
        "0 to 10000 kg",
    ),
    (
        "mass huge",
        swap(MASS, '<mass value="1e308"/>'),
        "link 'link_1'/inertial/mass value",
        "1e+308",
    ),
    (
        "mass word",
        swap(MASS, '<mass value="heavy"/>'),
        "link 'link_1'/inertial/mass value",
        "'heavy'",
    ),
    (
        "mass underscore",
        swap(MASS, '<mass value="1_0"/>'),
        "link 'link_1'/inertial/mass value",
        "'1_0'",
    ),
    ("mass missing", swap(MASS, ""), "link 'link_1'/inertial", "<mass> is missing"),
    (
        "inertia nan",
        swap(INERTIA, INERTIA.replace("0.0486", "NaN")),
        "link 'link_1'/inertial/inertia ixx",
        "'NaN'",
    ),
    (
        "inertia incomplete",
        swap(INERTIA, INERTIA.replace('izz="0.0394"', "")),
        "link 'link_1'/inertial/inertia izz",
        "is missing",
    ),
    (
        "inertia negative",
        swap(INERTIA, INERTIA.replace("0.0486", "-0.0486")),
        "link 'link_1'/inertial/inertia",
        "none below zero",
    ),
    (
        "inertia in kg mm^2",
        swap(INERTIA, 'ixx="900" ixy="0" ixz="0" iyy="900" iyz="0" izz="900"'),
        "link 'link_1'/inertial/inertia",
        "are the units kg m^2?",
    ),
    (
        "own child",
        swap('<child link="link_3"/>', '<child link="link_2"/>'),
        "joint 'joint_3'",
        "same link 'link_2'",
    ),
    (
        "loop beside the root",
        swap(
            "</robot>",
            LOOP,
        ),
        "link 'a'",
        "part of a loop",
    ),
    (
        "two parents",
        swap('<child link="link_3"/>', '<child link="link_4"/>'),
        "joint 'joint_4'/child link",
        "child of joint 'joint_3' already",
    ),
    (
        "two roots",
        swap("</robot>", '<link name="a"/></robot>'),
        "robot",
        "2 links without parent ('base_link', 'a')",
    ),
    (
        "unknown link",
        swap('<child link="link_3"/>', '<child link="lnik_3"/>'),
        "joint 'joint_3'/child link",
        "did you mean 'link_",
    ),
    (
        "zero axis",
        swap('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'),
        "joint 'joint_2'/axis xyz",
        "an axis without length",
    ),
    (
        "axis of two",
        swap('<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>'),
        "joint 'joint_2'/axis xyz",
        "allowed: 3 numbers",
    ),
    (
        "joint type",
        swap('"joint_4" type="revolute"', '"joint_4" type="revolut"'),
        "joint 'joint_4' type",
        "did you mean 'revolute'",
    ),
    (
        "names twice",
        swap('<link name="link_2">', '<link name="link_1">'),
        "link[2] name",
        "found 'link_1' again",
    ),
    ("no name", swap('<link name="link_2">', "<link>"), "link[2] name", "is missing"),
    (
        "shape in mm",
        in_collision('<box size="205 200 30"/>'),
        "link 'base_link'/collision[0]/geometry/box size[0]",
        "205 mm are 0.205 m",
    ),
    (
        "shape negative",
        in_collision('<sphere radius="-1"/>'),
        "link 'base_link'/collision[0]/geometry/sphere radius",
        "found -1",
    ),
    (
        "shape unknown",
        in_collision('<cone radius="1"/>'),
        "link 'base_link'/collision[0]/geometry",
        "found 'cone'; allowed is one of box",
    ),
    ("shape empty", in_collision(""), "link 'base_link'/collision[0]/geometry", "found nothing"),
    (
        "mesh scaled by nan",
        in_collision('<mesh filename="a.stl" scale="nan 1 1"/>'),
        "link 'base_link'/collision[0]/geometry/mesh scale[0]",
        "'nan'",
    ),
    (
        "mesh scaled by zero",
        in_collision('<mesh filename="a.stl" scale="1 0 1"/>'),
        "link 'base_link'/collision[0]/geometry/mesh scale",
        "none of it zero",
    ),
    (
        "mesh without address",
        in_collision("<mesh/>"),
        "link 'base_link'/collision[0]/geometry/mesh filename",
        "is missing",
    ),
    (
        "encoding",
        swap('encoding="utf-8"', 'encoding="ebcdic"'),
        "declares the encoding",
        "'ebcdic'; allowed is UTF-8",
    ),
    (
        "entities",
        swap("<robot", '<!DOCTYPE r [<!ENTITY a "b">]>\n<robot'),
        "has a document type",
        "remove it",
    ),
    (
        "xacro",
        swap("</robot>", '<x:a xmlns:x="http://www.ros.org/wiki/xacro"/></robot>'),
        "holds xacro macros",
        "expand it",
    ),
    (
        "deep",
        swap("</robot>", "<a>" * 40 + "</a>" * 40 + "</robot>"),
        "nested too deeply",
        "a depth of 32",
    ),
    (
        "attributes",
        swap("</robot>", "<a " + " ".join(f"a{k}=''" for k in range(500_001)) + "/></robot>"),
        "has more than 500000 attributes",
        "",
    ),
    (
        "meshes",
        swap("</link>", "".join(MESH.format(k) for k in range(2001)) + "</link>"),
        "names 2001 mesh files; allowed are 2000",
        "",
    ),
    (
        "speed",
        swap('velocity="2.094395102393195"', 'velocity="-1"'),
        "joint 'joint_1'/limit velocity: found -1; allowed is 0",
        "",
    ),
    ("many", swap("</robot>", "<a/>" * 100_001 + "</robot>"), "has more than 100000 elements", ""),
]
