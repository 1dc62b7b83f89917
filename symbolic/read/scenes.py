"""Scenes of other programs as bodies of a cell's environment: SDF.

A reader gathers shapes with their poses in the world. Whatever no body can be is told by its name
and its reason: an obstacle that is silently missing would make every verdict of a cell wrong.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import CollisionModelError, OutsideError, SceneError
from symbolic.read.descriptions import find_package
from symbolic.read.elements import Part, parse_elements
from symbolic.read.tables import Table, read_body
from symbolic.records import PAYLOAD, Body, Box, Capsule, Cylinder, Mesh, Shape, Sphere
from symbolic.records.poses import (
    inverse,
    pose_matrix,
    rpy_from_rotation,
    transform,
)
from symbolic.records.problems import MAX_NAME_LENGTH, Problems, shown, suggestion
from symbolic.records.quantities import Quantity

MOST_BODIES = 5000
SLAB = (10.0, 10.0, 0.1)
"""What stands for a plane: as wide as a body may be, around its point nearest to the world's origin
[m]."""

ANY = Quantity("", -1e9, 1e9)
"""A number that is only read; whether a body may have it is judged with the body."""

DIGITS = 12
"""Decimals of lengths and angles that are written: what is beyond them is rounding of poses."""


@dataclass(frozen=True)
class Scene:
    """The obstacles of a scene.

    Attributes:
        bodies: in the world; every name is a body's of an environment, and unique.
        left_out: what is no body of it, each 'NAME: why'.
        notes: what a body says otherwise than its scene, each 'NAME: what'.
    """

    bodies: tuple[Body, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]

    def tables(self, folder: Path) -> list[dict[str, Any]]:
        """`[[environment]]` of a workcell file in a folder, to which meshes are relative."""
        return [_table(body, folder) for body in self.bodies]


def read_scene(path: Path) -> Scene:
    """The obstacles of a scene: SDF (a world or a model).

    Raises:
        SceneError: the file cannot be read, is no scene, or is wrong; every problem with its
            place.
    """
    found = _Found()
    try:
        _reader(path)(path, found)
    except OutsideError as error:
        raise SceneError(f"{path.name}: {error}") from error
    if found.problems.found:
        told = "".join(f"\n  - {problem}" for problem in found.problems.messages())
        raise SceneError(f"{path.name}: cannot be read as a scene{told}")
    if not found.bodies and not found.left_out:
        raise SceneError(f"{path.name}: holds no obstacle")
    return Scene(tuple(found.bodies), tuple(found.left_out), tuple(found.notes))


def _reader(path: Path) -> Callable[[Path, _Found], None]:
    """What reads a file, by what is in it."""
    text = outside.text(outside.read_bytes(path, outside.URDF_BYTES))
    head = re.match(r"\s*(?:(?:<\?.*?\?>|<!--.*?-->)\s*)*<([A-Za-z]\w*)", text, re.DOTALL)
    if head and head[1] == "sdf":
        return _read_sdf
    raise OutsideError("is no scene that is read; allowed is SDF (<sdf>)")


# --- what every reader gathers ---


@dataclass
class _Found:
    """What a scene holds so far."""

    bodies: list[Body] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    problems: Problems = field(default_factory=Problems)
    names: set[str] = field(default_factory=lambda: {PAYLOAD})

    def add(self, name: str, shape: Shape, pose: Array) -> None:
        """Take a shape at its pose (4, 4) in the world, unless a workcell would refuse it."""
        if len(self.bodies) == MOST_BODIES:
            raise OutsideError(f"holds more than {MOST_BODIES} shapes; allowed are so many")
        body = Body(self._name(name), shape, pose)
        problems = Problems()
        if not np.all(np.isfinite(pose)):
            problems.add("pose", "is not finite")
        else:
            read_body(Table(_table(body, Path("/")), "", problems), Path("/"))
        if isinstance(shape, Mesh) and not problems.found:
            # Not imported at the top: reading meshes takes long to load.
            from symbolic.read.meshes import read_mesh

            try:
                read_mesh(shape.path, shape.scale)
            except CollisionModelError as error:
                problems.add("mesh", str(error))
        if problems.found:
            self.leave(name, "; ".join(problems.messages()))
        else:
            self.names.add(body.name)
            self.bodies.append(body)

    def capsule(self, name: str, shape: Capsule, pose: Array) -> None:
        """A capsule is a cylinder and the spheres at its ends."""
        self.add(name, Cylinder(shape.radius, shape.length), pose)
        for end in (-0.5, 0.5):
            place = transform(np.eye(3), [0.0, 0.0, end * shape.length])
            self.add(f"{name} end", Sphere(shape.radius), pose @ place)

    def plane(self, name: str, pose: Array) -> None:
        """The half-space below a frame's x-y plane."""
        normal = pose[:3, 2]
        middle = normal * (normal @ pose[:3, 3] - SLAB[2] / 2.0)
        self.note(name, f"is a plane; a slab of {SLAB[0]:g} x {SLAB[1]:g} x {SLAB[2]:g} m stands")
        self.add(name, Box(np.array(SLAB)), transform(pose[:3, :3], middle))

    def leave(self, name: str, why: str) -> None:
        """Something is no body."""
        self.left_out.append(f"{_printable(name) or 'scene'}: {why}")

    def note(self, name: str, what: str) -> None:
        """Something is taken otherwise than it is."""
        self.notes.append(f"{_printable(name) or 'scene'}: {what}")

    def _name(self, name: str) -> str:
        """One that an environment takes: a key path names bodies, a pattern stands for some."""
        wanted = re.sub(r"[/.*?\[\]]+", "-", _printable(name)).strip() or "body"
        wanted = wanted[: MAX_NAME_LENGTH - 6].strip()
        free = (wanted if k == 1 else f"{wanted} {k}" for k in range(1, MOST_BODIES + 3))
        return next(each for each in free if each not in self.names)


def _printable(name: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in name).split())


def _table(body: Body, folder: Path) -> dict[str, Any]:
    """A body as a table of a workcell file, its mesh relative to a folder."""
    table: dict[str, Any] = {"name": body.name, "kind": type(body.shape).__name__.lower()}
    match body.shape:
        case Box(size):
            table["size"] = _plain(size)
        case Cylinder(radius, length):
            table |= {"radius": float(radius), "length": float(length)}
        case Sphere(radius):
            table["radius"] = float(radius)
        case Mesh(path, scale):
            table["path"] = Path(os.path.relpath(path, folder)).as_posix()
            if not np.array_equal(scale, np.ones(3)):
                table["scale"] = _plain(scale)
    table["xyz"] = _plain(body.pose[:3, 3])
    rpy = _plain(rpy_from_rotation(body.pose[:3, :3]))
    return table | {"rpy": rpy} if any(rpy) else table


def _plain(values: Array) -> list[float]:
    return [round(value, DIGITS) + 0.0 for value in np.asarray(values, dtype=float).tolist()]


def _quaternion_pose(xyz: Array, xyzw: Array, at: str, problems: Problems) -> Array:
    """(4, 4) of a position and a quaternion x, y, z, w; of all zeros no rotation, as in MoveIt."""
    length = float(np.linalg.norm(xyzw))
    if length == 0.0:
        return transform(np.eye(3), xyz)
    if abs(length - 1.0) > 1e-2:
        problems.add(at, f"found a quaternion of length {length:g}; allowed is 1")
        return np.eye(4)
    x, y, z, w = xyzw / length
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return transform(rotation, xyz)


def _upwards(normal: Array) -> Array:
    """A rotation (3, 3) whose z axis is along a vector (3,)."""
    z = np.asarray(normal) / np.linalg.norm(normal)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


# --- SDF: frames of worlds and models ---


MOST_FILES = 500
MOST_FRAMES = 100
"""Longest chain of frames, each relative to the next."""

OWN = ("", "__model__", "__root__")
"""What a model's own frame is called."""


@dataclass
class _Scope:
    """A world or a model: its frames by name, and the models in it."""

    part: Part
    file: Path
    frames: dict[str, tuple[str, Array]] = field(default_factory=dict)
    inner: dict[str, _Scope] = field(default_factory=dict)

    def enter(self, name: str, base: str, pose: Array) -> None:
        """Add a frame at a pose (4, 4) in the frame called `base`."""
        if name in self.frames:
            raise OutsideError(f"{self.part.path}: holds two things called {shown(name)}")
        self.frames[name] = (base, pose)

    def frame(self, name: str) -> Array:
        """(4, 4) of a frame in the scope's own."""
        T_name, met = np.eye(4), 0
        while name not in (*OWN, "world") or (name == "world" and self.part.tag == "model"):
            head, _, rest = name.partition("::")
            if head not in self.frames or (rest and head not in self.inner):
                raise OutsideError(
                    f"{self.part.path}: names the frame {shown(name)}, which is not in it"
                    f"{suggestion(name, self.frames)}"
                )
            met += 1
            if met > MOST_FRAMES:
                raise OutsideError(f"{self.part.path}: frame {shown(name)} depends on itself")
            if rest:
                T_name = self.inner[head].frame(rest) @ T_name
            name, pose = self.frames[head]
            T_name = pose @ T_name
        return T_name


def _read_sdf(path: Path, found: _Found) -> None:
    _Sdf(found).read(path)


class _Sdf:
    """Reads SDF files, those that are included as well."""

    def __init__(self, found: _Found) -> None:
        self._found = found
        self._files = 0

    def read(self, path: Path) -> None:
        """Gather the first world of a file, or its models."""
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
            static = (model.part.element.findtext("static") or "").strip()
            if static not in ("true", "1"):
                self._found.note(name, "is not static; it is taken where it stands, joints at zero")
            self._shapes(model, scope.frame(name), name)

    def _root(self, path: Path, found_in: str) -> Part:
        self._files += 1
        if self._files > MOST_FILES:
            raise OutsideError(f"includes more than {MOST_FILES} files; allowed are so many")
        content = outside.read_bytes(path, outside.URDF_BYTES)
        return Part(
            parse_elements(outside.xml_text(content), "sdf"), found_in, self._found.problems
        )

    def _scope(self, part: Part, file: Path, trail: tuple[Path, ...]) -> _Scope:
        scope = _Scope(part, file)
        for tag in ("link", "frame", "joint"):
            for name, each in part.named(tag).items():
                base, pose = self._pose(each)
                if tag == "frame":
                    base = base or each.raw("attached_to") or ""
                if tag == "joint":
                    base = base or (each.element.findtext("child") or "").strip()
                scope.enter(name, base, pose)
        for name, each in part.named("model").items():
            self._place(scope, name, self._scope(each, file, trail), self._pose(each), each)
        for each in part.all("include"):
            self._include(scope, each, trail)
        return scope

    def _place(
        self, scope: _Scope, name: str, model: _Scope, placed: tuple[str, Array], by: Part
    ) -> None:
        """Enter a model, which stands where `placed` puts its placement frame."""
        base, pose = placed
        frame = (by.raw("placement_frame") or by.element.findtext("placement_frame") or "").strip()
        scope.enter(name, base, pose @ inverse(model.frame(frame)))
        scope.inner[name] = model

    def _include(self, scope: _Scope, part: Part, trail: tuple[Path, ...]) -> None:
        address = (part.element.findtext("uri") or "").strip()
        wanted = (part.element.findtext("name") or "").strip()
        path = _sdf_file(address, scope.file)
        if path is None or part.raw("merge") in ("true", "1"):
            why = "merges" if path else "includes"
            reason = "which is not read" if path else f"which is not found; {_WHERE}"
            self._found.leave(wanted or part.path, f"{why} {shown(address)}, {reason}")
            return
        if path.resolve() in trail:
            raise OutsideError(f"{part.path}: {path.name} includes itself")
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

    def _pose(self, part: Part) -> tuple[str, Array]:
        """The frame to which an element's pose is relative, '' for its own default; (4, 4)."""
        pose = part.child("pose")
        if pose is None:
            return "", np.eye(4)
        base = pose.raw("relative_to") or ""
        if not (pose.element.text or "").strip():
            return base, np.eye(4)
        if pose.raw("rotation_format") == "quat_xyzw":
            values = pose.content((ANY,) * 7)
            return base, _quaternion_pose(values[:3], values[3:], pose.path, pose.problems)
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
                self._found.leave(f"{name} {link}", "is only to be seen, without a collision shape")
        for inner, model in scope.inner.items():
            self._shapes(model, T_world_model @ scope.frame(inner), f"{name} {inner}")

    def _shape(self, collision: Part, file: Path, name: str, pose: Array) -> None:
        geometry = collision.required("geometry")
        element = next(iter(geometry.element), None)
        if element is None:
            collision.problems.add(geometry.path, "is empty; allowed is a shape")
            return
        part = geometry.required(element.tag)

        def number(tag: str) -> float:
            return float(part.required(tag).content((ANY,))[0])

        match part.tag:
            case "box":
                self._found.add(name, Box(part.required("size").content((ANY,) * 3)), pose)
            case "sphere":
                self._found.add(name, Sphere(number("radius")), pose)
            case "cylinder":
                self._found.add(name, Cylinder(number("radius"), number("length")), pose)
            case "capsule":
                self._found.capsule(name, Capsule(number("radius"), number("length")), pose)
            case "plane":
                written = part.child("normal")
                normal = written.content((ANY,) * 3) if written else np.eye(3)[2]
                if np.linalg.norm(normal) < 1e-6:
                    collision.problems.add(part.path, "found a normal without length")
                else:
                    self._found.plane(name, pose @ transform(_upwards(normal), np.zeros(3)))
            case "mesh":
                self._mesh(part, file, name, pose)
            case "empty":
                pass
            case other:
                self._found.leave(name, f"is of the kind {shown(other)}, which no body is")

    def _mesh(self, part: Part, file: Path, name: str, pose: Array) -> None:
        address = (part.element.findtext("uri") or "").strip()
        path = _sdf_file(address, file)
        scale = part.child("scale")
        factors = scale.content((ANY,) * 3) if scale else np.ones(3)
        if path is None:
            self._found.leave(name, f"its mesh {shown(address)} is not found; {_WHERE}")
        elif part.child("submesh"):
            self._found.leave(name, f"is a part of the mesh {shown(address)}; export it alone")
        else:
            self._found.add(name, Mesh(path, factors), pose)


_WHERE = "name the folder that holds it in GZ_SIM_RESOURCE_PATH, or write a path beside the scene"
_VARIABLES = ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH")


def _sdf_file(address: str, file: Path) -> Path | None:
    """The file behind an address in an SDF file; of a model's folder the file that it names."""
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
    """What a model's folder names as its description; of several versions the last."""
    config = folder / "model.config"
    if not config.is_file():
        return None
    content = outside.read_bytes(config, outside.WORKCELL_BYTES)
    root = parse_elements(outside.xml_text(content), "model")
    named = [(each.text or "").strip() for each in root.findall("sdf")]
    return named[-1] if named else None
