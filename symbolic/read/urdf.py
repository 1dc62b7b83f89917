"""URDF files as checked records, before any other library reads them.

Only what this project uses is read: the tree of links and joints, masses and inertias, collision
shapes, and the addresses of meshes. All of it is checked here, and each problem names its element
and attribute. The rest of the file is ignored. Pinocchio gets `Urdf.kinematics`, which contains
only checked content.

An SRDF, MoveIt's companion of a URDF, states which pairs of links are not checked for collision.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np

from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import OutsideError, UrdfError
from symbolic.read.descriptions import Arguments, description_content
from symbolic.read.elements import ElementReader, parse_elements
from symbolic.records import Box, Capsule, Cylinder, IgnoredPair, Sphere
from symbolic.records import quantities as quantity
from symbolic.records.poses import pose_matrix, read_only
from symbolic.records.problems import Problems, shown, suggestion

MOST_LINKS = 500
MOST_MESHES = 2000
"""Largest number of different mesh files."""

LARGEST_GYRATION = 10.0
"""Largest radius of gyration: an inertia may not exceed mass times its square [m]."""

INERTIA_SLACK = 1e-6
"""Published inertias are rounded, and those of small covers often have large relative errors. A
principal moment may be below zero by this [kg m^2], for larger inertias by a hundredth of the
inertia."""

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class UrdfMesh:
    """A mesh of a URDF.

    Attributes:
        address: the address as written in the file.
        scale: (3,) factor per axis.
    """

    address: str
    scale: Array


@dataclass(frozen=True)
class UrdfCollision:
    """A collision shape of a link.

    Attributes:
        shape: the shape.
        pose: (4, 4) pose of the shape in the link's frame.
    """

    shape: Box | Cylinder | Sphere | Capsule | UrdfMesh
    pose: Array


@dataclass(frozen=True)
class Urdf:
    """Checked content of a URDF file.

    Attributes:
        file: the file's name, without its folder.
        name: name of the robot.
        links: names of the links, in the order of the file.
        joints: joints by name, in the order of the file.
        collisions: collision shapes by link, in the order of the file; links without shapes are
            left out.
        visuals: addresses of visual meshes by link, as written.
        kinematics: URDF text with only the links, their inertias and the joints.
    """

    file: str
    name: str
    links: tuple[str, ...]
    joints: Mapping[str, UrdfJoint]
    collisions: Mapping[str, tuple[UrdfCollision, ...]]
    visuals: Mapping[str, tuple[str, ...]]
    kinematics: str

    @cached_property
    def moved_by(self) -> Mapping[str, str]:
        """Name of the joint that moves each link, by the link's name."""
        return {joint.child: name for name, joint in self.joints.items()}

    def above(self, link: str) -> Iterator[str]:
        """Yield the joints between a link and the root, starting at the link."""
        while link in self.moved_by:
            yield self.moved_by[link]
            link = self.joints[self.moved_by[link]].parent

    @property
    def collision_meshes(self) -> tuple[str, ...]:
        """Addresses of the collision meshes as written in the file, each once."""
        shapes = (shape.shape for found in self.collisions.values() for shape in found)
        return tuple(dict.fromkeys(s.address for s in shapes if isinstance(s, UrdfMesh)))

    @property
    def visual_meshes(self) -> tuple[str, ...]:
        """Addresses of the visual meshes as written in the file, each once."""
        return tuple(dict.fromkeys(mesh for found in self.visuals.values() for mesh in found))


def read_urdf(path: Path, arguments: Arguments = (), package_dirs: Sequence[Path] = ()) -> Urdf:
    """Read and check a robot's description.

    Args:
        path: a URDF, or a xacro file, which is expanded.
        arguments: values of the xacro file's arguments, by name.
        package_dirs: folders of packages that the xacro file may name.

    Raises:
        UrdfError: the file cannot be read, is not XML in UTF-8, or an element is wrong. The message
            lists every problem with its element and attribute.
    """
    try:
        content = description_content(path, arguments, package_dirs)
    except OutsideError as error:
        raise UrdfError(path.name, (str(error),)) from error
    return parse_urdf(content, path.name)


@lru_cache(maxsize=8)
def parse_urdf(content: bytes, file: str) -> Urdf:
    """Parse the content of a URDF file.

    Args:
        content: content of the file.
        file: name of the file, for messages.

    Raises:
        UrdfError: the content is not XML in UTF-8, or an element is wrong.
    """
    problems = Problems()
    try:
        root = parse_elements(safe_io.xml_text(content))
        urdf = _read_robot(ElementReader(root, "", problems), file)
    except OutsideError as error:
        raise UrdfError(file, (str(error),)) from error
    if problems.found:
        raise UrdfError(file, problems.messages())
    return urdf


def _read_robot(root: ElementReader, file: str) -> Urdf:
    links, joints = root.named("link"), root.named("joint")
    if len(links) > MOST_LINKS:
        raise OutsideError(
            f"has {len(links)} links; allowed are {MOST_LINKS}: remove what the arm does not need"
        )
    for link in links.values():
        _check_inertial(link)
    read = {name: _joint(joint) for name, joint in joints.items()}
    if root.problems.clean():
        # Published files name joints to be mimicked that they do not have.
        read = {n: j if j.mimics in read else replace(j, mimics="") for n, j in read.items()}
        problem = _tree_problem(tuple(links), read) or _mimic_problem(read)
        if problem:
            root.problems.add(*problem)
    shapes = {name: tuple(map(_collision, link.all("collision"))) for name, link in links.items()}
    root.kept.set("name", "robot")
    urdf = Urdf(
        file=file,
        name=root.element.get("name", ""),
        links=tuple(links),
        joints=MappingProxyType(read),
        collisions=MappingProxyType({name: found for name, found in shapes.items() if found}),
        visuals=MappingProxyType({name: _visual_meshes(link) for name, link in links.items()}),
        kinematics=ElementTree.tostring(root.kept, encoding="unicode"),
    )
    meshes = len({*urdf.collision_meshes, *urdf.visual_meshes})
    if meshes > MOST_MESHES:
        raise OutsideError(f"names {meshes} mesh files; allowed are {MOST_MESHES}: merge them")
    return urdf


def _check_inertial(link: ElementReader) -> None:
    inertial = link.child("inertial")
    if inertial is None:
        return
    pose_of(inertial)
    mass_part, matrix = inertial.required("mass"), inertial.required("inertia")
    mass = mass_part.number("value", quantity.LINK_MASS)
    xx, xy, xz, yy, yz, zz = (matrix.number(key, quantity.INERTIA) for key in _MOMENTS)
    if inertial.problems.clean(mass_part.path, matrix.path):
        problem = _inertia_problem(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), mass)
        if problem:
            inertial.problems.add(matrix.path, problem)


def _inertia_problem(inertia: Array, mass: float) -> str:
    moments = np.linalg.eigvalsh(inertia)
    listed = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] < -max(INERTIA_SLACK, 0.01 * moments[2]):
        return f"found principal moments {listed} kg m^2; allowed are none below zero"
    if moments[2] > mass * LARGEST_GYRATION**2 + INERTIA_SLACK:
        return (
            f"found a principal moment of {moments[2]:.6g} kg m^2 with a mass of {mass:g} kg; "
            f"allowed is at most that mass times ({LARGEST_GYRATION:g} m)^2 (are the units kg m^2?)"
        )
    return ""


def _collision(part: ElementReader) -> UrdfCollision:
    pose = pose_of(part)
    shape: Box | Cylinder | Sphere | Capsule | UrdfMesh = Sphere(1.0)
    element = part.required("geometry").one_of(("box", "cylinder", "sphere", "capsule", "mesh"))
    size = quantity.SHAPE_SIZE
    match element.tag:
        case "box":
            shape = Box(element.numbers("size", (size,) * 3))
        case "sphere":
            shape = Sphere(element.number("radius", size))
        case "cylinder":
            shape = Cylinder(element.number("radius", size), element.number("length", size))
        case "capsule":
            shape = Capsule(element.number("radius", size), element.number("length", size))
        case "mesh":
            scale = element.numbers("scale", (quantity.MESH_SCALE,) * 3, "1 1 1")
            if element.problems.clean(element.path) and np.any(scale == 0.0):
                element.problems.add(element.at("scale"), "is zero; allowed is none of it zero")
            shape = UrdfMesh(element.text("filename", most=1000), scale)
    return UrdfCollision(shape, pose)


def _visual_meshes(link: ElementReader) -> tuple[str, ...]:
    found = (mesh.get("filename", "") for mesh in link.element.findall("visual/geometry/mesh"))
    return tuple(address for address in found if address)


# --- joints and origins ---


JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
SMALLEST_AXIS = 1e-6
FULL_TURNS = 4.0 * np.pi
"""A continuous joint counts as a revolute joint with limits of this size in both directions
[rad]."""


@dataclass(frozen=True)
class UrdfJoint:
    """A joint of the tree of links.

    Attributes:
        kind: one of `JOINT_TYPES`.
        parent, child: names of links.
        lower, upper: limits [rad or m]; `FULL_TURNS` in both directions for a continuous joint.
        mimics: name of the joint that this joint follows; '' if it moves by itself.
        multiplier, offset: position = multiplier * (position of the followed joint) + offset.
    """

    kind: str
    parent: str
    child: str
    lower: float
    upper: float
    mimics: str = ""
    multiplier: float = 1.0
    offset: float = 0.0


def _joint(joint: ElementReader) -> UrdfJoint:
    kind = joint.choice("type", JOINT_TYPES)
    parent, child = (joint.required(tag).text("link") for tag in ("parent", "child"))
    pose_of(joint)
    axis = joint.child("axis") if kind not in ("fixed", "floating") else None
    if axis is not None:
        direction = axis.numbers("xyz", (quantity.DIRECTION,) * 3)
        if axis.problems.clean(axis.path) and np.linalg.norm(direction) < SMALLEST_AXIS:
            axis.problems.add(
                axis.at("xyz"),
                f"found {shown(axis.raw('xyz'))}, an axis without length; allowed is a direction "
                "such as '0 0 1'",
            )
    # Limits of joints that an arm moves are checked where it is known which these are.
    limit = joint.child("limit")
    lower = upper = 0.0
    if limit is not None:
        for key in ("effort", "velocity"):
            limit.number(key, quantity.JOINT_MOST, "0")
            limit.kept.attrib.setdefault(key, "0")  # Pinocchio's reader requires them
        lower, upper = (limit.number(key, quantity.JOINT_LIMIT, "0") for key in ("lower", "upper"))
    if limit is None and kind in ("revolute", "prismatic", "continuous"):
        none = dict.fromkeys(("effort", "velocity", "lower", "upper"), "0")
        kept = ElementTree.SubElement(joint.kept, "limit", none)
    if kind == "continuous":
        # Pinocchio gives a continuous joint two coordinates; here every moving joint has one.
        lower, upper = -FULL_TURNS, FULL_TURNS
        kept = kept if limit is None else limit.kept
        kept.attrib |= {"lower": repr(lower), "upper": repr(upper)}
        joint.kept.set("type", "revolute")
    dynamics = joint.child("dynamics")
    if dynamics is not None:
        for key in ("damping", "friction"):
            dynamics.number(key, quantity.JOINT_LIMIT, "0")
    found = UrdfJoint(kind, parent, child, lower, upper)
    for mimic in joint.all("mimic")[:1]:
        multiplier = mimic.number("multiplier", quantity.JOINT_LIMIT, "1")
        offset = mimic.number("offset", quantity.JOINT_LIMIT, "0")
        mimics = mimic.text("joint")
        found = replace(found, mimics=mimics, multiplier=multiplier, offset=offset)
    return found


def pose_of(part: ElementReader) -> Array:
    """Read the origin of an element as a pose (4, 4); the identity if the element has none."""
    origin = part.child("origin")
    if origin is None:
        return read_only(np.eye(4))
    xyz = origin.numbers("xyz", (quantity.POSITION,) * 3, "0 0 0")
    rpy = origin.numbers("rpy", (quantity.URDF_ANGLE,) * 3, "0 0 0")
    return read_only(pose_matrix(xyz, rpy))


def _tree_problem(
    links: tuple[str, ...], joints: Mapping[str, UrdfJoint]
) -> tuple[str, str] | None:
    """Return why links and joints do not form a tree, as a pair of the wrong element and a text;
    None if they do."""
    if not links:
        return "robot", "has no links; allowed is a tree of links and joints"
    moved_by: dict[str, str] = {}
    inner: dict[str, list[str]] = {link: [] for link in links}
    for name, joint in joints.items():
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in inner:
                hint = suggestion(link, links)
                return f"joint {name!r}/{role} link", f"found {link!r}, no link of the file{hint}"
        if joint.parent == joint.child:
            same = f"its parent and its child are the same link {joint.child!r}"
            return f"joint {name!r}", same
        if joint.child in moved_by:
            return (
                f"joint {name!r}/child link",
                f"found {joint.child!r}, which is the child of joint {moved_by[joint.child]!r} "
                "already; allowed is a tree",
            )
        moved_by[joint.child] = name
        inner[joint.parent].append(joint.child)
    roots = [link for link in links if link not in moved_by]
    if not roots:
        return "robot", "every link is the child of a joint, so they form a loop; allowed is a tree"
    if len(roots) > 1:
        listed = ", ".join(map(repr, roots[:5])) + (" ..." if len(roots) > 5 else "")
        return "robot", f"found {len(roots)} links without parent ({listed}); allowed is one root"
    met, waiting = set(roots), list(roots)
    while waiting:
        met.update(behind := inner[waiting.pop()])
        waiting += behind
    for link in links:
        if link not in met:
            return f"link {link!r}", "is part of a loop of joints; allowed is a tree"
    return None


def _mimic_problem(joints: Mapping[str, UrdfJoint]) -> tuple[str, str] | None:
    """Return the problem if joints mimic each other in a circle, as a pair of the wrong element and
    a text; None if they do not."""
    for name in joints:
        met, followed = {name}, joints[name].mimics
        while followed:
            if followed in met:
                return f"joint {name!r}/mimic joint", "joints follow one another in a circle"
            met.add(followed)
            followed = joints[followed].mimics
    return None


# --- SRDF ---


def read_srdf(path: Path) -> tuple[IgnoredPair, ...]:
    """Read the pairs of links in the `disable_collisions` elements of an SRDF file, in order.

    Each pair has the reason that the file states, such as 'Adjacent' or 'Never', or ''. The rest of
    the file is ignored.

    Raises:
        UrdfError: the file cannot be read, is not XML, or such an element lacks a link.
    """
    try:
        return _parse_srdf(safe_io.read_bytes(path, safe_io.URDF_BYTES), path.name)
    except OutsideError as error:
        raise UrdfError(path.name, (str(error),)) from error


@lru_cache(maxsize=8)
def _parse_srdf(content: bytes, file: str) -> tuple[IgnoredPair, ...]:
    problems = Problems()
    root = ElementReader(parse_elements(safe_io.xml_text(content)), "", problems)
    pairs = tuple(
        IgnoredPair(part.text("link1"), part.text("link2"), part.raw("reason") or "")
        for part in root.all("disable_collisions")
    )
    if problems.found:
        raise UrdfError(file, problems.messages())
    return pairs
