"""Shapes of a scene with their poses in the world, and reports of parts that cannot become bodies.

Every part that is left out is reported by name and reason: an obstacle that is silently missing
would make every verdict on a cell wrong.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from symbolic import safe_io
from symbolic.array import Array, Range
from symbolic.errors import CollisionModelError, OutsideError
from symbolic.read.descriptions import find_package
from symbolic.read.elements import parse_elements
from symbolic.read.tables import TableReader, read_body
from symbolic.records import PAYLOAD_NAME, Body, Box, Capsule, Cylinder, Mesh, Shape, Sphere
from symbolic.records.poses import axes_with_z, rpy_from_rotation, transform
from symbolic.records.problems import MAX_NAME_LENGTH, Problems, shown

MOST_BODIES = 5000
SLAB = (10.0, 10.0, 0.1)
"""Size of the box that replaces a plane [m]: as wide as a body may be, around the plane's point
nearest to the world's origin."""

ANY = Range(-1e9, 1e9)
"""Range of a number that is only read; it is checked later with the body."""

DIGITS = 12
"""Decimals of lengths and angles that are written. Further decimals are rounding of poses."""


def slab_below(pose: Array) -> tuple[Box, Array]:
    """Return a box that stands for the half-space below a plane, and its pose (4, 4) in the world.
    The upper face of the box lies in the plane.

    Args:
        pose: (4, 4) pose in the world of a frame whose x-y plane is the plane.
    """
    normal = pose[:3, 2]
    middle = normal * (normal @ pose[:3, 3] - SLAB[2] / 2.0)
    return Box(np.array(SLAB)), transform(pose[:3, :3], middle)


@dataclass(frozen=True)
class ImportedScene:
    """The obstacles of a scene.

    Attributes:
        bodies: bodies in the world frame, with unique names that are valid for the environment.
        left_out: parts that could not become bodies, each 'NAME: reason'.
        notes: differences between a body and the scene, and bodies that are only visible, each
            'NAME: text'.
        files: meshes embedded in the scene, as STL content by the path that the body names.
    """

    bodies: tuple[Body, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]
    files: Mapping[str, bytes]

    def tables(self, folder: Path, meshes: Path) -> list[dict[str, Any]]:
        """Return the bodies as `[[environment]]` tables of a workcell file, one per body.

        No file is written; the caller stores the scene's embedded meshes (the attribute `files`).

        Args:
            folder: folder of the workcell file, to which mesh paths in the tables are relative.
            meshes: folder in which the caller stores the contents of `files` under their names.
        """
        return [_table(body, folder, meshes) for body in self.bodies]


@dataclass
class SceneBuilder:
    """Collector of the bodies of a scene.

    Attributes:
        bodies: bodies in the world frame.
        left_out: parts that could not become bodies, each 'NAME: reason'.
        notes: differences between a body and the scene, each 'NAME: text'.
        files: embedded meshes, as STL content by path.
        problems: collector of problems.
        names: names that are taken.
    """

    bodies: list[Body] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    problems: Problems = field(default_factory=Problems)
    names: set[str] = field(default_factory=lambda: {PAYLOAD_NAME})

    def add(self, name: str, shape: Shape | Capsule, pose: Array) -> None:
        """Add a shape as a body of the scene. If a workcell file may not contain it, leave it out
        and report the reason.

        A capsule becomes a cylinder and two spheres.

        Args:
            name: name of the shape in the scene.
            shape: the shape.
            pose: (4, 4) pose of the shape in the world.
        """
        if isinstance(shape, Capsule):
            self.add(name, Cylinder(shape.radius, shape.length), pose)
            for end in (-0.5, 0.5):
                place = transform(np.eye(3), [0.0, 0.0, end * shape.length])
                self.add(f"{name} end", Sphere(shape.radius), pose @ place)
            return
        if len(self.bodies) == MOST_BODIES:
            raise OutsideError(f"holds more than {MOST_BODIES} shapes, which is the limit")
        body = Body(self._name(name), shape, pose)
        problems = Problems()
        if not np.all(np.isfinite(pose)):
            problems.add("pose", "is not finite")
        else:
            read_body(TableReader(_table(body, Path("/"), Path("/")), "", problems), Path("/"))
        if isinstance(shape, Mesh) and not problems.found:
            # Not imported at the top: reading meshes takes long to load.
            from symbolic.read.meshes import read_mesh

            try:
                read_mesh(shape.path, shape.scale)
            except CollisionModelError as error:
                problems.add("mesh", str(error).removeprefix(f"{shape.path}: "))
        if problems.found:
            self.leave(name, "; ".join(problems.messages()))
        else:
            self.names.add(body.name)
            self.bodies.append(body)

    def triangles(self, name: str, vertices: Array, faces: NDArray[np.int64], pose: Array) -> None:
        """Add a mesh that is stated by its triangles.

        Args:
            name: name of the mesh in the scene.
            vertices: (n, 3) vertices [m].
            faces: (m, 3) indices of each triangle's vertices.
            pose: (4, 4) in the world.
        """
        import trimesh

        content = trimesh.exchange.stl.export_stl(trimesh.Trimesh(vertices, faces, process=False))
        file = f"{len(self.files) + 1}-{re.sub(r'[^A-Za-z0-9_-]+', '-', name)[:60]}.stl"
        count = len(self.bodies)
        with TemporaryDirectory() as folder:  # a body's mesh is judged as a file
            path = Path(folder).resolve() / file
            path.write_bytes(content)
            self.add(name, Mesh(path, np.ones(3)), pose)
        if len(self.bodies) > count:
            self.bodies[-1] = replace(self.bodies[-1], shape=Mesh(Path(file), np.ones(3)))
            self.files[file] = content

    def mesh(self, name: str, address: str, file: Path, scale: Array, pose: Array) -> None:
        """Add a mesh that a scene's file names by an address.

        Args:
            name: name of the mesh in the scene.
            address: the address.
            file: the scene's file.
            scale: (3,) scale factors along x, y and z.
            pose: (4, 4) in the world.
        """
        path = file_at(address, file)
        if path is None:
            self.leave(name, f"its mesh {shown(address)} is not found; {WHERE}")
        else:
            self.add(name, Mesh(path, scale), pose)

    def half_space(self, name: str, normal: Array, offset: float, pose: Array) -> None:
        """Add the half-space of all points x with normal . x + offset <= 0 in a frame.

        Args:
            name: name of the plane in the scene.
            normal: (3,) normal of the plane, of any length.
            offset: offset of the plane [m, for a unit normal].
            pose: (4, 4) of the frame in the world.
        """
        length = float(np.linalg.norm(normal))
        if length < 1e-6:
            self.problems.add(name, "found a plane without a normal")
        else:
            foot = -offset / float(normal @ normal) * normal
            self.plane(name, pose @ transform(axes_with_z(normal / length), foot))

    def plane(self, name: str, pose: Array) -> None:
        """Add the half-space below the x-y plane of a frame.

        Args:
            name: name of the plane in the scene.
            pose: (4, 4) of the frame in the world.
        """
        size = " x ".join(f"{side:g}" for side in SLAB)
        self.note(name, f"is a plane; a slab of {size} m below it takes its place")
        self.add(name, *slab_below(pose))

    def leave(self, name: str, why: str) -> None:
        """Report that the part `name` of the scene is left out, with the reason `why`."""
        self.left_out.append(f"{safe_io.printable(name) or 'scene'}: {why}")

    def note(self, name: str, what: str) -> None:
        """Report how a body of the result differs from the scene.

        Args:
            name: name of the body.
            what: description of the difference.
        """
        self.notes.append(f"{safe_io.printable(name) or 'scene'}: {what}")

    def _name(self, name: str) -> str:
        """Return a unique name for a body, similar to `name`, in which '-' replaces the characters
        that key paths and patterns of a workcell file use."""
        wanted = re.sub(r"[/.*?\[\]]+", "-", safe_io.printable(name)).strip() or "body"
        wanted = wanted[: MAX_NAME_LENGTH - 6].strip()
        free = (wanted if k == 1 else f"{wanted} {k}" for k in range(1, MOST_BODIES + 3))
        return next(each for each in free if each not in self.names)


def _table(body: Body, folder: Path, meshes: Path) -> dict[str, Any]:
    """Convert a body to a table of a workcell file.

    Args:
        body: the body.
        folder: folder of the workcell file, to which mesh paths become relative.
        meshes: folder to which relative mesh paths of the body refer.
    """
    table: dict[str, Any] = {"name": body.name, "kind": type(body.shape).__name__.lower()}
    for key, value in vars(body.shape).items():
        if key == "path":
            table[key] = Path(os.path.relpath(meshes / value, folder.absolute())).as_posix()
        elif key == "size" or (key == "scale" and not np.array_equal(value, np.ones(3))):
            table[key] = _plain(value)
        elif key != "scale":
            table[key] = float(value)
    table["xyz"] = _plain(body.pose[:3, 3])
    rpy = _plain(rpy_from_rotation(body.pose[:3, :3]))
    return table | {"rpy": rpy} if any(rpy) else table


def _plain(values: Array) -> list[float]:
    return [round(value, DIGITS) + 0.0 for value in np.asarray(values, dtype=float).tolist()]


def quaternion_pose(xyz: Array, xyzw: Array, at: str, problems: Problems) -> Array:
    """Compute a pose (4, 4) from a position and a quaternion.

    Args:
        xyz: (3,) position [m].
        xyzw: (4,) quaternion x, y, z, w; four zeros mean no rotation, as in MoveIt.
        at: place of the quaternion in the file, for messages.
        problems: collector of problems.
    """
    length = float(np.linalg.norm(xyzw))
    if length and abs(length - 1.0) > 1e-2:
        problems.add(at, f"found a quaternion of length {length:g}; allowed is 1")
    if not length or abs(length - 1.0) > 1e-2:
        return transform(np.eye(3), xyz)
    return transform(Rotation.from_quat(xyzw).as_matrix(), xyz)


# --- files that a scene names ---


WHERE = "name the folder that holds it in GZ_SIM_RESOURCE_PATH, or write a path beside the scene"
_VARIABLES = ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH")


def file_at(address: str, file: Path) -> Path | None:
    """Return the file behind an address in a scene; None if it does not exist. For the address of a
    model's folder it is the model's description.

    Args:
        address: a path relative to the scene's file, or an address file://, model:// or package://.
        file: the scene's file.
    """
    scheme, _, rest = address.rpartition("://")
    if not rest or "\0" in rest or scheme not in ("", "file", "model", "package"):
        return None
    if scheme in ("model", "package"):
        name, _, inside = rest.partition("/")
        variables = os.pathsep.join(os.environ.get(variable, "") for variable in _VARIABLES)
        above = file.resolve().parents[:2]
        near = [folder for parent in above for folder in (parent, parent / "models")]
        given = [Path(entry) for entry in variables.split(os.pathsep) if entry]
        package = find_package(name, [*near, *given], file)
        if package is None:
            return None
        path = package / inside
    else:
        path = file.parent / rest
    if path.is_dir():
        path = path / (_main_file(path) or "model.sdf")
    return path.resolve() if path.is_file() else None


def _main_file(folder: Path) -> str | None:
    """Return the name of the description file in a model's folder, as its model.config states it.
    Of several versions it is the last one. None if the folder has no such file.
    """
    config = folder / "model.config"
    if not config.is_file():
        return None
    content = safe_io.read_bytes(config, safe_io.WORKCELL_BYTES)
    root = parse_elements(safe_io.xml_text(content), "model")
    named = [(each.text or "").strip() for each in root.findall("sdf")]
    return named[-1] if named else None
