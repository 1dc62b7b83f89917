"""Planning scenes of MoveIt: the message in YAML, and the text that its panel in RViz saves."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.read.scenes.bodies import ANY, WHERE, SceneBuilder, file_at, quaternion_pose, upwards
from symbolic.read.tables import Table
from symbolic.records import Box, Cylinder, Mesh, Sphere
from symbolic.records.poses import transform
from symbolic.records.problems import shown

FIXED = ("", "world")
"""Frames that are taken for the world's."""

_DIMENSIONS = {"box": 3, "sphere": 1, "cylinder": 2, "cone": 2, "plane": 4}
_TYPES = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone"}
_ADDED = (None, 0, "", "0", "\0", "ADD", "add")


class _Loader(yaml.CSafeLoader):
    """YAML in which 1e-05 is a number, as those say who write it so."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?[0-9]+(?:\.[0-9]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_message(path: Path) -> dict[str, Any]:
    """The fields of a message that `ros2 topic echo` or robowflex wrote as YAML.

    Raises:
        OutsideError: it is no such file.
    """
    text = outside.text(outside.read_bytes(path, outside.URDF_BYTES))
    try:
        # `ros2 topic echo` ends a message by a line that begins the next one.
        document = next(iter(yaml.load_all(text, Loader=_Loader)), None)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise OutsideError(f"is not readable YAML: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(document, dict):
        raise OutsideError("is no message; allowed is a mapping, as `ros2 topic echo` writes it")
    return document


def read_moveit(path: Path, found: SceneBuilder) -> None:
    """Gather a planning scene's message, or its world alone.

    Raises:
        OutsideError: it is no such scene.
    """
    document = read_message(path)
    scene = document.get("scene")
    whole = Table(scene if isinstance(scene, dict) else document, "", found.problems)
    world = whole.table("world", {}) if "world" in whole else whole
    if "collision_objects" not in world:
        raise OutsideError("has no world.collision_objects; is it a planning scene of MoveIt?")
    frames = {
        str(each.raw("child_frame_id", "")).lstrip("/"): _frame(
            each.table("transform", {}), "translation", "rotation"
        )
        for each in whole.tables("fixed_frame_transforms")
    }
    for each in world.tables("collision_objects"):
        _object(each, frames, path, found)
    if world.table("octomap", {}).table("octomap", {}).raw("data", None):
        found.leave("octomap", "is a map of what a camera saw, which no body is")
    for each in whole.table("robot_state", {}).tables("attached_collision_objects"):
        name = each.table("object", {}).raw("id", "")
        found.leave(str(name), "is attached to a robot; describe it as the payload or a tool")


def _object(table: Table, frames: Mapping[str, Array], path: Path, found: SceneBuilder) -> None:
    """One collision object: its primitives, meshes and planes."""
    name = str(table.raw("id", "") or "object")
    if table.raw("operation", None) not in _ADDED:
        found.leave(name, f"is not added: its operation is {shown(table.raw('operation'))}")
        return
    frame = str(table.table("header", {}).raw("frame_id", "") or "").lstrip("/")
    if frame not in FIXED and frame not in frames:
        found.note(name, f"stands in the frame {shown(frame)}, which is taken for the world")
    T_world_object = frames.get(frame, np.eye(4)) @ _frame(table.table("pose", {}))
    for kind, places in _PLACES.items():
        shapes, poses = table.tables(kind), table.tables(places)
        if len(poses) != len(shapes) and (poses or len(shapes) > 1):
            table.problems.add(
                table.at(places),
                f"found {len(poses)}; allowed are as many as {kind}, {len(shapes)}",
            )
            continue
        for index, shape in enumerate(shapes):
            pose = T_world_object @ (_frame(poses[index]) if poses else np.eye(4))
            called = f"{name} {kind} {index + 1}" if len(shapes) > 1 else name
            if kind == "primitives":
                written = shape.raw("type")
                word = _TYPES.get(written) if isinstance(written, int) else str(written).lower()
                count = _DIMENSIONS.get(word or "")
                if word is None or count is None or word == "plane":
                    found.leave(called, f"is of the type {shown(written)}, which no body is")
                else:
                    _primitive(
                        called, word, shape.vector("dimensions", (ANY,) * count), pose, found
                    )
            elif kind == "planes":
                _primitive(called, "plane", shape.vector("coef", (ANY,) * 4), pose, found)
            else:
                _moveit_mesh(called, shape, pose, path, found)


_PLACES = {"primitives": "primitive_poses", "meshes": "mesh_poses", "planes": "plane_poses"}


def _frame(table: Table, place: str = "position", turn: str = "orientation") -> Array:
    """(4, 4) of a pose, its numbers by letters or in a row; a part that is missing is zero."""
    parts = []
    for key, letters in ((place, "xyz"), (turn, "xyzw")):
        if isinstance(table.raw(key, None), Mapping):
            inner = table.table(key)
            parts.append(np.array([inner.number(letter, ANY, 0.0) for letter in letters]))
        else:
            parts.append(table.vector(key, (ANY,) * len(letters), (0.0,) * len(letters)))
    return quaternion_pose(parts[0], parts[1], table.at(turn), table.problems)


def _primitive(name: str, kind: str, sizes: Array, pose: Array, found: SceneBuilder) -> None:
    """A shape of MoveIt's message; of a cylinder the length comes first, of a plane its factors."""
    match kind:
        case "box":
            found.add(name, Box(sizes), pose)
        case "sphere":
            found.add(name, Sphere(float(sizes[0])), pose)
        case "cylinder":
            found.add(name, Cylinder(float(sizes[1]), float(sizes[0])), pose)
        case "plane":
            normal, offset = sizes[:3], float(sizes[3])
            if np.linalg.norm(normal) < 1e-6:
                found.problems.add(name, "found a plane without a normal")
            else:
                foot = -offset / float(normal @ normal) * normal
                found.plane(name, pose @ transform(upwards(normal), foot))
        case other:
            found.leave(name, f"is a {other}, which no body is")


def _moveit_mesh(name: str, table: Table, pose: Array, path: Path, found: SceneBuilder) -> None:
    """A mesh by its address, or by its triangles."""
    if table.has("resource"):
        address = str(table.raw("resource"))
        file = file_at(address, path)
        scale = table.vector("dimensions", (ANY,) * 3, (1.0, 1.0, 1.0))
        if file is None:
            found.leave(name, f"its mesh {shown(address)} is not found; {WHERE}")
        else:
            found.add(name, Mesh(file, scale), pose)
        return
    try:
        faces = [
            each["vertex_indices"] if isinstance(each, dict) else each
            for each in table.raw("triangles", ())
        ]
        vertices = [
            [each[letter] for letter in "xyz"] if isinstance(each, dict) else each
            for each in table.raw("vertices", ())
        ]
    except (KeyError, TypeError):
        faces = vertices = [[]]
    _triangles(name, vertices, faces, pose, found)


def _triangles(name: str, vertices: Any, faces: Any, pose: Array, found: SceneBuilder) -> None:
    """A mesh of vertices and corners as they are written."""
    try:
        places = np.array(vertices, dtype=float).reshape(-1, 3)
        corners = np.array(faces, dtype=float).reshape(-1, 3)
    except (ValueError, TypeError, OverflowError):
        found.problems.add(name, "found a mesh whose triangles and vertices are not rows of three")
        return
    if not np.all(np.isfinite(places)) or not corners.size:
        found.problems.add(
            name, "found a mesh without triangles or with vertices that are no place"
        )
    elif not np.all((corners >= 0.0) & (corners < len(places))):
        found.problems.add(name, "found a mesh with triangles whose corners it does not have")
    else:
        found.triangles(name, places, corners.astype(np.int64), pose)


def read_moveit_text(path: Path, found: SceneBuilder) -> None:
    """Gather a scene's text: objects behind stars, numbers in rows.

    Raises:
        OutsideError: it is no such text.
    """
    text = outside.text(outside.read_bytes(path, outside.URDF_BYTES))
    _, *objects = re.split(r"^\*", text, flags=re.MULTILINE)
    # Behind the first name stands a place, or in an old text the number of shapes.
    placed = any(len(line.split()) > 1 for each in objects[:1] for line in each.split("\n")[1:2])
    for written in objects:
        name, _, rest = written.partition("\n")
        try:
            _written_object(name.strip(), rest.split(), placed, found)
        except (ValueError, IndexError, OverflowError) as error:
            raise OutsideError(
                f"object {shown(name.strip())} is not as MoveIt writes it ({error})"
            ) from error


def _written_object(name: str, words: Sequence[str], placed: bool, found: SceneBuilder) -> None:
    """One object of such a text; in an old one shapes are in the world, in others in the object."""
    at = 0

    def numbers(count: int) -> Array:
        nonlocal at
        part = words[at : at + count]
        if len(part) < count:
            raise ValueError("it ends too early")
        at += count
        return np.array([float(word) for word in part])

    def counted() -> int:
        (number,) = numbers(1)
        if not 0 <= number <= len(words):
            raise ValueError(f"it counts {number:g} things")
        return int(number)

    def pose() -> Array:
        row = numbers(7)
        return quaternion_pose(row[:3], row[3:], name, found.problems)

    T_world_object = pose() if placed else np.eye(4)
    count = counted()
    for index in range(count):
        called = f"{name} {index + 1}" if count > 1 else name
        kind, at = words[at], at + 1
        if kind == "mesh":
            vertices, faces = counted(), counted()
            places, corners = numbers(3 * vertices), numbers(3 * faces)
            _triangles(called, places, corners, T_world_object @ pose(), found)
        elif kind in _DIMENSIONS:
            sizes = numbers(_DIMENSIONS[kind])
            # The text has the radius of a cylinder first.
            sizes = sizes[::-1] if kind == "cylinder" else sizes
            _primitive(called, kind, sizes, T_world_object @ pose(), found)
        else:
            raise ValueError(f"of the kind {shown(kind)}")
        numbers(4)  # its colour
