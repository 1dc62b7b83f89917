"""A URDF file as checked records, before any other library sees it.

What is taken over is what this project uses: the tree of links and joints, masses and inertias,
collision shapes, and the addresses of meshes. Everything taken is checked here, each problem with
its element and attribute; everything else in the file is left alone. Pinocchio is given
`Urdf.kinematics`, which holds nothing that was not checked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError, UrdfError
from symbolic.geometry.pieces import Capsule
from symbolic.robot.urdf_elements import Part, parse_elements
from symbolic.robot.urdf_joint import UrdfJoint, origin_element, pose_of, read_joint
from symbolic.robot.urdf_tree import mimic_problem, tree_problem
from symbolic.robot.xacro_file import Arguments, description_content
from symbolic.workcell import quantities as quantity
from symbolic.workcell.problems import Problems
from symbolic.workcell.records import Box, Cylinder, Sphere

MOST_LINKS = 500
MOST_MESHES = 2000
"""Most different mesh files."""

LARGEST_GYRATION = 10.0
"""No inertia is larger than that of its mass at this distance [m]."""

INERTIA_SLACK = 1e-6
"""Published inertias are rounded, and those of small covers often wrong by more than they are: so
much below zero a principal moment may lie [kg m^2]; a hundredth of it at larger ones."""

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class UrdfMesh:
    """A mesh by its address as written; scale: (3,) factor per axis."""

    address: str
    scale: Array


@dataclass(frozen=True)
class UrdfCollision:
    """A collision shape of a link; pose: (4, 4) in the link's frame."""

    shape: Box | Cylinder | Sphere | Capsule | UrdfMesh
    pose: Array


@dataclass(frozen=True)
class Urdf:
    """What a URDF file says, checked.

    Attributes:
        file: the file's name, without its folder.
        links: names, in the order of the file.
        joints: by name, in the order of the file.
        collisions: by link that has any, in the order of the file.
        visuals: by link the addresses of its visual meshes as written.
        kinematics: URDF text of links with their inertias and of joints, nothing else.
    """

    file: str
    links: tuple[str, ...]
    joints: Mapping[str, UrdfJoint]
    collisions: Mapping[str, tuple[UrdfCollision, ...]]
    visuals: Mapping[str, tuple[str, ...]]
    kinematics: str

    @property
    def collision_links(self) -> tuple[str, ...]:
        """Links that have a collision shape."""
        return tuple(self.collisions)

    @property
    def collision_meshes(self) -> tuple[str, ...]:
        """Addresses of collision meshes as written, each once."""
        shapes = (shape.shape for found in self.collisions.values() for shape in found)
        return tuple(dict.fromkeys(s.address for s in shapes if isinstance(s, UrdfMesh)))

    @property
    def visual_meshes(self) -> tuple[str, ...]:
        """Addresses of visual meshes as written, each once."""
        return tuple(dict.fromkeys(mesh for found in self.visuals.values() for mesh in found))


def read_urdf(path: Path, arguments: Arguments = (), package_dirs: Sequence[Path] = ()) -> Urdf:
    """Read and check a robot's description.

    Args:
        path: a URDF, or a xacro file, which is expanded.
        arguments: values of the xacro file's arguments, by name.
        package_dirs: folders of packages that the xacro file may name.

    Raises:
        UrdfError: the file cannot be read, is no XML in UTF-8, or an element of it is wrong; every
            problem with its element and attribute.
    """
    try:
        content = description_content(path, arguments, package_dirs)
    except OutsideError as error:
        raise UrdfError(path.name, (str(error),)) from error
    return parse_urdf(content, path.name)


@lru_cache(maxsize=8)
def parse_urdf(content: bytes, file: str) -> Urdf:
    """The records of a URDF's content; `file` names it in messages.

    Raises:
        UrdfError: see `read_urdf`.
    """
    problems = Problems()
    try:
        root = parse_elements(outside.xml_text(content))
        urdf = _read(Part(root, "", problems), file)
    except OutsideError as error:
        raise UrdfError(file, (str(error),)) from error
    if problems.found:
        raise UrdfError(file, problems.messages())
    return urdf


def _read(root: Part, file: str) -> Urdf:
    links = root.named("link")
    joints = root.named("joint")
    if len(links) > MOST_LINKS:
        raise OutsideError(
            f"has {len(links)} links; allowed are {MOST_LINKS}: remove what the arm does not need"
        )
    reduced = ElementTree.Element("robot", {"name": "robot"})
    for name, link in links.items():
        element = ElementTree.SubElement(reduced, "link", {"name": name})
        element.extend(_inertial(link))
    read: dict[str, UrdfJoint] = {}
    for name, joint in joints.items():
        element, read[name] = read_joint(joint, name)
        reduced.append(element)
    if root.problems.clean():
        problem = tree_problem(tuple(links), {n: (j.parent, j.child) for n, j in read.items()})
        # Published files name joints to be mimicked that they do not have.
        read = {n: j if j.mimics in read else replace(j, mimics="") for n, j in read.items()}
        problem = problem or mimic_problem({n: j.mimics for n, j in read.items() if j.mimics})
        if problem:
            root.problems.add(*problem)
    collisions = {
        name: tuple(map(_collision, link.all("collision"))) for name, link in links.items()
    }
    urdf = Urdf(
        file=file,
        links=tuple(links),
        joints=MappingProxyType(read),
        collisions=MappingProxyType({name: found for name, found in collisions.items() if found}),
        visuals=MappingProxyType({name: _visual_meshes(link) for name, link in links.items()}),
        kinematics=ElementTree.tostring(reduced, encoding="unicode"),
    )
    meshes = len({*urdf.collision_meshes, *urdf.visual_meshes})
    if meshes > MOST_MESHES:
        raise OutsideError(f"names {meshes} mesh files; allowed are {MOST_MESHES}: merge them")
    return urdf


def _inertial(link: Part) -> list[ElementTree.Element]:
    """The checked inertial element of a link, if it has one."""
    inertial = link.child("inertial")
    if inertial is None:
        return []
    kept = ElementTree.Element("inertial")
    kept.extend(origin_element(inertial))
    mass_part = inertial.required("mass")
    mass = mass_part.number("value", quantity.LINK_MASS)
    matrix = inertial.required("inertia")
    values = {key: matrix.number(key, quantity.INERTIA) for key in _MOMENTS}
    if inertial.problems.clean(mass_part.path, matrix.path):
        xx, xy, xz, yy, yz, zz = values.values()
        problem = _inertia_problem(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), mass)
        if problem:
            inertial.problems.add(matrix.path, problem)
    ElementTree.SubElement(kept, "mass", mass_part.written("value"))
    ElementTree.SubElement(kept, "inertia", matrix.written(*_MOMENTS))
    return [kept]


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


def _collision(part: Part) -> UrdfCollision:
    pose = pose_of(part)
    shape: Box | Cylinder | Sphere | Capsule | UrdfMesh = Sphere(1.0)
    element = part.required("geometry").only(("box", "cylinder", "sphere", "capsule", "mesh"))
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
                element.problems.add(f"{element.path} scale", "is zero; allowed is none of it zero")
            shape = UrdfMesh(element.text("filename", most=1000), scale)
    return UrdfCollision(shape, pose)


def _visual_meshes(link: Part) -> tuple[str, ...]:
    found = (mesh.get("filename", "") for mesh in link.element.findall("visual/geometry/mesh"))
    return tuple(address for address in found if address)
