"""SDF, the scenes of Gazebo and Drake: collision shapes of links, where frames put them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.read.elements import Part, parse_elements
from symbolic.read.scenes.bodies import ANY, WHERE, SceneBuilder, file_at, quaternion_pose, upwards
from symbolic.records import Box, Capsule, Cylinder, Mesh, Sphere
from symbolic.records.poses import inverse, pose_matrix, transform
from symbolic.records.problems import shown, suggestion

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


def read_sdf(path: Path, found: SceneBuilder) -> None:
    """Gather the first world of a file, or its models.

    Raises:
        OutsideError: the file, or one that it includes, cannot be read or names what it lacks.
    """
    _Sdf(found).read(path)


class _Sdf:
    """Reads SDF files, those that are included as well."""

    def __init__(self, found: SceneBuilder) -> None:
        self._found = found
        self._files = 0

    def read(self, path: Path) -> None:
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
            raise OutsideError(f"includes more than {MOST_FILES} files, which is the limit")
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
        path = file_at(address, scope.file)
        if path is None or part.raw("merge") in ("true", "1"):
            why = "merges" if path else "includes"
            reason = "which is not read" if path else f"which is not found; {WHERE}"
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
                    self._found.plane(name, pose @ transform(upwards(normal), np.zeros(3)))
            case "mesh":
                self._mesh(part, file, name, pose)
            case "empty":
                pass
            case other:
                self._found.leave(name, f"is of the kind {shown(other)}, which no body is")

    def _mesh(self, part: Part, file: Path, name: str, pose: Array) -> None:
        address = (part.element.findtext("uri") or "").strip()
        path = file_at(address, file)
        scale = part.child("scale")
        factors = scale.content((ANY,) * 3) if scale else np.ones(3)
        if path is None:
            self._found.leave(name, f"its mesh {shown(address)} is not found; {WHERE}")
        elif part.child("submesh"):
            self._found.leave(name, f"is a part of the mesh {shown(address)}; export it alone")
        else:
            self._found.add(name, Mesh(path, factors), pose)
