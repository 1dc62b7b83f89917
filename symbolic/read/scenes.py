"""Read scenes of other programs as bodies of a cell's environment.

The formats are SDF (Gazebo, Drake), MJCF (MuJoCo), and planning scenes of MoveIt, either the
message in YAML or the text that RViz saves.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import OutsideError, SceneError
from symbolic.read.elements import ElementReader, parse_elements
from symbolic.read.mjcf import read_mjcf
from symbolic.read.scene_bodies import (
    ANY,
    WHERE,
    ImportedScene,
    SceneBuilder,
    file_at,
    quaternion_pose,
)
from symbolic.read.tables import TableReader
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.poses import inverse, pose_matrix
from symbolic.records.problems import shown, suggestion

SDF_SHAPES = {"box": Box, "sphere": Sphere, "cylinder": Cylinder, "capsule": Capsule}


def read_scene(path: Path) -> ImportedScene:
    """Read the obstacles of a scene file.

    This is an SDF file (a world or a model), an MJCF file, or a MoveIt planning scene (the message
    in YAML, or the text format .scene).

    Raises:
        SceneError: the file cannot be read, is no scene, or is wrong. The message lists every
            problem with its place.
    """
    found = SceneBuilder()
    try:
        text = safe_io.text(safe_io.read_bytes(path, safe_io.URDF_BYTES))
        head = re.match(r"\s*+(?:(?><\?.*?\?>|<!--.*?-->)\s*+)*+<([A-Za-z]\w*)", text, re.DOTALL)
        kind = head[1] if head else path.suffix.lower()
        if kind not in READERS:
            raise OutsideError(
                "is no scene that is read; allowed are SDF (<sdf>), MJCF (<mujoco>) and planning "
                "scenes of MoveIt (.yaml, .scene)",
                code="no-scene",
            )
        READERS[kind](path, found)
    except OutsideError as error:
        raise SceneError(f"{path.name}: {error}") from error
    if found.problems.found:
        told = "".join(f"\n  - {problem}" for problem in found.problems.messages())
        raise SceneError(f"{path.name}: cannot be read as a scene{told}")
    if not found.bodies and not found.left_out:
        raise SceneError(
            "; ".join([f"{path.name}: holds no obstacle", *found.notes[:5]]), code="no-obstacle"
        )
    return ImportedScene(
        tuple(found.bodies), tuple(found.left_out), tuple(found.notes), found.files
    )


# --- SDF ---


MOST_FILES = 500
MOST_FRAMES = 100
"""Largest length of a chain of frames, each relative to the next."""

OWN = ("", "__model__", "__root__")
"""Names of a model's own frame."""


@dataclass
class _Scope:
    """A world or model of an SDF file, inside which names are unique.

    Attributes:
        part: the element of the world or model.
        file: the file with the element.
        frames: for each frame by name, the name of the frame to which it is relative, and its pose
            (4, 4) there.
        inner: the models inside, by name.
    """

    part: ElementReader
    file: Path
    frames: dict[str, tuple[str, Array]] = field(default_factory=dict)
    inner: dict[str, _Scope] = field(default_factory=dict)

    def enter(self, name: str, base: str, pose: Array) -> None:
        if name in self.frames:
            raise OutsideError(f"{self.part.path}: holds two things called {shown(name)}")
        self.frames[name] = (base, pose)

    def frame(self, name: str) -> Array:
        """Compute the pose (4, 4) of a named frame relative to this world or model.

        Raises:
            OutsideError: the frame does not exist, or depends on itself.
        """
        T_name, met = np.eye(4), 0
        while name not in (*OWN, "world") or (name == "world" and self.part.tag == "model"):
            head, _, rest = name.partition("::")
            if head not in self.frames or (rest and head not in self.inner):
                raise OutsideError(
                    f"{self.part.path}: names the frame {shown(name)}, which is not in it"
                    f"{suggestion(name, self.frames)}",
                    code="unknown-frame",
                )
            met += 1
            if met > MOST_FRAMES:
                raise OutsideError(
                    f"{self.part.path}: frame {shown(name)} depends on itself", code="circular"
                )
            if rest:
                T_name = self.inner[head].frame(rest) @ T_name
            name, pose = self.frames[head]
            T_name = pose @ T_name
        return T_name


class _Sdf:
    """Reader of SDF files and of the files that they include."""

    def __init__(self, found: SceneBuilder) -> None:
        self._found = found
        self._files = 0

    def read(self, path: Path) -> None:
        """Add the shapes of an SDF file to the scene: those of its first world, or of all its
        models if it has no world."""
        root = self._root(path, found_in="")
        worlds = list(root.named("world").values())
        for further in worlds[1:]:
            self._found.leave(further.path, "only the first world of a file is read")
        part = worlds[0] if worlds else root
        for tag in ("population", "actor"):
            for each in part.all(tag):
                self._found.leave(each.raw("name") or tag, f"is {tag}, which is not read")
        for state in part.all("state"):
            self._found.note(state.path, "is not read; models stand where they are described")
        scope = self._scope(part, path, (path.resolve(),))
        if self._found.problems.found:
            return
        for name, model in scope.inner.items():
            static = model.part.inner_text("static")
            if static not in ("true", "1"):
                self._found.note(name, "is not static; it is taken where it stands, joints at zero")
            self._shapes(model, scope.frame(name), name)

    def _root(self, path: Path, found_in: str) -> ElementReader:
        self._files += 1
        if self._files > MOST_FILES:
            raise OutsideError(f"includes more than {MOST_FILES} files, which is the limit")
        content = safe_io.read_bytes(path, safe_io.URDF_BYTES)
        return ElementReader(
            parse_elements(safe_io.xml_text(content), "sdf"), found_in, self._found.problems
        )

    def _scope(self, part: ElementReader, file: Path, trail: tuple[Path, ...]) -> _Scope:
        scope = _Scope(part, file)
        for tag in ("link", "frame", "joint"):
            for name, each in part.named(tag).items():
                base, pose = self._pose(each)
                if tag == "frame":
                    base = base or each.raw("attached_to") or ""
                if tag == "joint":
                    base = base or each.inner_text("child")
                scope.enter(name, base, pose)
        for name, each in part.named("model").items():
            self._place(scope, name, self._scope(each, file, trail), self._pose(each), each)
        for each in part.all("include"):
            self._include(scope, each, trail)
        return scope

    def _place(
        self, scope: _Scope, name: str, model: _Scope, placed: tuple[str, Array], by: ElementReader
    ) -> None:
        """Place a model in a world or in another model.

        Args:
            scope: the world or model that contains the placed model.
            name: name of the placed model.
            model: the placed model.
            placed: name of a frame in `scope`, and the pose (4, 4) of the model's placement frame
                relative to it.
            by: element that states which frame of the model is its placement frame.
        """
        base, pose = placed
        frame = by.raw("placement_frame") or by.inner_text("placement_frame")
        scope.enter(name, base, pose @ inverse(model.frame(frame)))
        scope.inner[name] = model

    def _include(self, scope: _Scope, part: ElementReader, trail: tuple[Path, ...]) -> None:
        address = part.inner_text("uri")
        wanted = part.inner_text("name")
        path = file_at(address, scope.file)
        if path is None or part.raw("merge") in ("true", "1"):
            why = "merges" if path else "includes"
            reason = "which is not read" if path else f"which is not found; {WHERE}"
            self._found.leave(wanted or part.path, f"{why} {shown(address)}, {reason}")
            return
        if path.resolve() in trail:
            raise OutsideError(f"{part.path}: {path.name} includes itself", code="circular")
        try:
            root = self._root(path, f"{path.name}:")
        except OutsideError as error:
            raise OutsideError(f"includes {shown(address)}: {error}") from error
        models = list(root.named("model").items())
        if not models:
            self._found.leave(wanted or part.path, f"includes {shown(address)}, without a model")
        for name, model in models[:1]:
            inner = self._scope(model, path, (*trail, path.resolve()))
            static = part.element.find("static")
            if static is not None:
                model.element[:] = [e for e in model.element if e.tag != "static"] + [static]
            by = part if part.element.find("placement_frame") is not None else model
            placed = self._pose(part if part.child("pose") else model)
            self._place(scope, wanted or name, inner, placed, by)

    def _pose(self, part: ElementReader) -> tuple[str, Array]:
        """Read an element's pose.

        Returns:
            Name of the frame to which the pose is relative, '' for the default frame; and the pose
            (4, 4) in that frame.
        """
        pose = part.child("pose")
        if pose is None:
            return "", np.eye(4)
        base = pose.raw("relative_to") or ""
        if not (pose.element.text or "").strip():
            return base, np.eye(4)
        if pose.raw("rotation_format") == "quat_xyzw":
            values = pose.content((ANY,) * 7)
            return base, quaternion_pose(values[:3], values[3:], pose.path, pose.problems)
        values = pose.content((ANY,) * 6)
        turn = np.pi / 180.0 if pose.raw("degrees") in ("true", "1") else 1.0
        return base, pose_matrix(values[:3], values[3:] * turn)

    # --- shapes ---

    def _shapes(self, scope: _Scope, T_world_model: Array, name: str) -> None:
        for link, part in scope.part.named("link").items():
            collisions = part.named("collision")
            for each, collision in collisions.items():
                base, pose = self._pose(collision)
                placed = scope.frame(base) if base else scope.frame(link)
                self._shape(
                    collision, scope.file, f"{name} {link} {each}", T_world_model @ placed @ pose
                )
            if not collisions and part.child("visual"):
                self._found.note(
                    f"{name} {link}", "is no body, only to be seen: no collision shape"
                )
        for inner, model in scope.inner.items():
            self._shapes(model, T_world_model @ scope.frame(inner), f"{name} {inner}")

    def _shape(self, collision: ElementReader, file: Path, name: str, pose: Array) -> None:
        geometry = collision.required("geometry")
        element = next(iter(geometry.element), None)
        if element is None:
            collision.problems.add(geometry.path, "is empty; allowed is a shape")
            return
        part = geometry.required(element.tag)
        kind = SDF_SHAPES.get(part.tag)
        if kind is not None:
            count = 3 if kind is Box else 1
            sizes = [part.required(each.name).content((ANY,) * count) for each in fields(kind)]
            self._found.add(name, kind(*(size if kind is Box else size[0] for size in sizes)), pose)
            return
        match part.tag:
            case "plane":
                written = part.child("normal")
                normal = written.content((ANY,) * 3) if written else np.eye(3)[2]
                self._found.half_space(name, normal, 0.0, pose)
            case "mesh" if part.child("submesh"):
                address = shown(part.inner_text("uri"))
                self._found.leave(name, f"is a part of the mesh {address}; export it alone")
            case "mesh":
                scale = part.child("scale")
                factors = scale.content((ANY,) * 3) if scale else np.ones(3)
                self._found.mesh(name, part.inner_text("uri"), file, factors, pose)
            case "empty":
                pass
            case other:
                self._found.leave(name, f"is of the kind {shown(other)}, which no body is")


# --- MoveIt ---


FIXED = ("", "world")
"""Names of frames that count as the world frame."""

_DIMENSIONS = {"box": 3, "sphere": 1, "cylinder": 2, "cone": 2, "plane": 4}
_TYPES = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone"}
_ADDED = (None, 0, "", "0", "\0", "ADD", "add")


class _Loader(yaml.CSafeLoader):
    """YAML loader that reads words like 1e-05 as numbers, as the programs that write them
    intend.
    """


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?[0-9]+(?:\.[0-9]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_message(path: Path) -> dict[str, Any]:
    """Read the fields of a message that `ros2 topic echo` or robowflex wrote as YAML.

    Raises:
        OutsideError: the file is not such a message.
    """
    text = safe_io.text(safe_io.read_bytes(path, safe_io.URDF_BYTES))
    try:
        # `ros2 topic echo` ends a message by a line that begins the next one.
        document = next(iter(yaml.load_all(text, Loader=_Loader)), None)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise OutsideError(
            f"is not readable YAML: {' '.join(str(error).split())[:200]}", code="not-yaml"
        ) from error
    if not isinstance(document, dict):
        raise OutsideError(
            "is no message; allowed is a mapping, as `ros2 topic echo` writes it", code="no-message"
        )
    return document


def _read_moveit(path: Path, found: SceneBuilder) -> None:
    """Add the bodies of a MoveIt message, a planning scene or its world alone, to `found`.

    Raises:
        OutsideError: the file is not such a message.
    """
    document = read_message(path)
    scene = document.get("scene")
    whole = TableReader(scene if isinstance(scene, dict) else document, "", found.problems)
    world = whole.table("world", {}) if "world" in whole else whole
    if "collision_objects" not in world:
        raise OutsideError(
            "has no world.collision_objects; is it a planning scene of MoveIt?", code="no-scene"
        )
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


def _object(
    table: TableReader, frames: Mapping[str, Array], path: Path, found: SceneBuilder
) -> None:
    """Add a collision object of a planning scene: its primitives, meshes and planes.

    Args:
        table: table of the object.
        frames: poses (4, 4) in the world of named frames, to which the object's pose may be
            relative.
        path: file of the scene.
        found: collector of bodies.
    """
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


def _frame(table: TableReader, place: str = "position", turn: str = "orientation") -> Array:
    """Read a pose (4, 4) from a position and a quaternion. A missing position is zero, a missing
    quaternion means no rotation.

    Args:
        table: table with both.
        place, turn: keys of position and quaternion. The value of each is a table with the keys x,
            y, z (and w), or an array in this order.
    """
    parts = []
    for key, letters in ((place, "xyz"), (turn, "xyzw")):
        if isinstance(table.raw(key, None), Mapping):
            inner = table.table(key)
            parts.append(np.array([inner.number(letter, ANY, 0.0) for letter in letters]))
        else:
            parts.append(table.vector(key, (ANY,) * len(letters), (0.0,) * len(letters)))
    return quaternion_pose(parts[0], parts[1], table.at(turn), table.problems)


def _primitive(name: str, kind: str, sizes: Array, pose: Array, found: SceneBuilder) -> None:
    """Add a primitive of MoveIt's message.

    Args:
        name: name of the body.
        kind: kind of the primitive, such as 'box'.
        sizes: edges (3,) of a box, radius (1,) of a sphere, length and radius (2,) of a cylinder
            [m], or coefficients (4,) of a plane.
        pose: (4, 4) in the world.
        found: collector of bodies.
    """
    match kind:
        case "box":
            found.add(name, Box(sizes), pose)
        case "sphere":
            found.add(name, Sphere(float(sizes[0])), pose)
        case "cylinder":
            found.add(name, Cylinder(float(sizes[1]), float(sizes[0])), pose)
        case "plane":
            found.half_space(name, sizes[:3], float(sizes[3]), pose)
        case other:
            found.leave(name, f"is a {other}, which no body is")


def _moveit_mesh(
    name: str, table: TableReader, pose: Array, path: Path, found: SceneBuilder
) -> None:
    """Add a mesh of a planning scene, which is stated by an address or by its triangles.

    Args:
        name: name of the body.
        table: table of the mesh.
        pose: (4, 4) in the world.
        path: file of the scene.
        found: collector of bodies.
    """
    if table.has("resource"):
        scale = table.vector("dimensions", (ANY,) * 3, (1.0, 1.0, 1.0))
        found.mesh(name, str(table.raw("resource")), path, scale, pose)
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
    """Add a mesh that is stated by its triangles.

    Args:
        name: name of the body.
        vertices: list of n vertices, three numbers each [m].
        faces: list of triangles, three indices of vertices each.
        pose: (4, 4) in the world.
        found: collector of bodies.
    """
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


def _read_moveit_text(path: Path, found: SceneBuilder) -> None:
    """Add the objects of a scene in MoveIt's text format.

    Each object begins with a line `*NAME`; rows of numbers follow.

    Raises:
        OutsideError: the file is not in this format.
    """
    text = safe_io.text(safe_io.read_bytes(path, safe_io.URDF_BYTES))
    _, *objects = re.split(r"^\*", text, flags=re.MULTILINE)
    # Behind the first name stands a place, or in an old text the number of shapes.
    placed = any(len(line.split()) > 1 for each in objects[:1] for line in each.split("\n")[1:2])
    for written in objects:
        name, _, rest = written.partition("\n")
        try:
            _written_object(name.strip(), rest.split(), placed, found)
        except (ValueError, IndexError, OverflowError) as error:
            raise OutsideError(
                f"object {shown(name.strip())} is not as MoveIt writes it ({error})",
                code="not-as-written",
            ) from error


def _written_object(name: str, words: Sequence[str], placed: bool, found: SceneBuilder) -> None:
    """Add one object of a scene in MoveIt's text format.

    Args:
        name: name of the object.
        words: the words after the name.
        placed: True if the file states a pose of the object; False for an old file, whose shapes
            are relative to the world.
        found: collector of bodies.
    """
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


READERS: dict[str, Callable[[Path, SceneBuilder], None]] = {
    "sdf": lambda path, found: _Sdf(found).read(path),
    "mujoco": read_mjcf,
    ".yaml": _read_moveit,
    ".yml": _read_moveit,
    ".scene": _read_moveit_text,
}
"""Functions that read a scene file, by the root tag of XML or by the end of the file's name."""
