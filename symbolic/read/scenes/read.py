"""Any scene, by what is in its file; those of MuJoCo (MJCF), which its own reader reads."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from symbolic import outside
from symbolic.errors import OutsideError, SceneError
from symbolic.read.mjcf import compiled
from symbolic.read.scenes.bodies import Scene, SceneBuilder
from symbolic.read.scenes.moveit import read_moveit, read_moveit_text
from symbolic.read.scenes.sdf import read_sdf
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.poses import transform


def read_scene(path: Path) -> Scene:
    """The obstacles of SDF (a world or a model), of MJCF, or of a planning scene of MoveIt (its
    message in YAML, or its own text, .scene).

    Raises:
        SceneError: the file cannot be read, is no scene, or is wrong; every problem with its
            place.
    """
    found = SceneBuilder()
    try:
        _reader(path)(path, found)
    except OutsideError as error:
        raise SceneError(f"{path.name}: {error}") from error
    if found.problems.found:
        told = "".join(f"\n  - {problem}" for problem in found.problems.messages())
        raise SceneError(f"{path.name}: cannot be read as a scene{told}")
    if not found.bodies and not found.left_out:
        raise SceneError(f"{path.name}: holds no obstacle")
    return Scene(tuple(found.bodies), tuple(found.left_out), tuple(found.notes), found.files)


def _reader(path: Path) -> Callable[[Path, SceneBuilder], None]:
    """What reads a file, by what is in it."""
    text = outside.text(outside.read_bytes(path, outside.URDF_BYTES))
    head = re.match(r"\s*+(?:(?><\?.*?\?>|<!--.*?-->)\s*+)*+<([A-Za-z]\w*)", text, re.DOTALL)
    by_root = {"sdf": read_sdf, "mujoco": _read_mjcf}
    if head and head[1] in by_root:
        return by_root[head[1]]
    by_name = {".yaml": read_moveit, ".yml": read_moveit, ".scene": read_moveit_text}
    if not head and path.suffix.lower() in by_name:
        return by_name[path.suffix.lower()]
    raise OutsideError(
        "is no scene that is read; allowed are SDF (<sdf>), MJCF (<mujoco>) and planning scenes of "
        "MoveIt (.yaml, .scene)"
    )


# --- MJCF ---


def _read_mjcf(path: Path, found: SceneBuilder) -> None:
    """Gather the shapes of the world and of bodies that are fixed in it, as MuJoCo places them."""
    mujoco, _, model = compiled(path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moving, kinds = dict[int, int](), mujoco.mjtGeom
    for number in range(model.ngeom):
        geom = model.geom(number)
        body = int(geom.bodyid[0])
        name = f"{model.body(body).name or f'body {body}'} {geom.name}" if body else geom.name
        name = name.strip() or f"geom {number}"
        pose = transform(data.geom_xmat[number].reshape(3, 3), data.geom_xpos[number])
        size = geom.size
        if model.body_weldid[body]:
            root = int(model.body_rootid[body])
            moving[root] = moving.get(root, 0) + 1
            continue
        if not geom.contype[0] and not geom.conaffinity[0]:
            found.leave(name, "is only to be seen: its contype and conaffinity are zero")
            continue
        match kinds(int(geom.type[0])):
            case kinds.mjGEOM_BOX:
                found.add(name, Box(2.0 * size), pose)
            case kinds.mjGEOM_SPHERE:
                found.add(name, Sphere(float(size[0])), pose)
            case kinds.mjGEOM_CYLINDER:
                found.add(name, Cylinder(float(size[0]), 2.0 * float(size[1])), pose)
            case kinds.mjGEOM_CAPSULE:
                found.capsule(name, Capsule(float(size[0]), 2.0 * float(size[1])), pose)
            case kinds.mjGEOM_PLANE:
                found.plane(name, pose)
            case kinds.mjGEOM_MESH:
                mesh = model.mesh(int(geom.dataid[0]))
                corners = slice(int(mesh.vertadr[0]), int(mesh.vertadr[0] + mesh.vertnum[0]))
                faces = slice(int(mesh.faceadr[0]), int(mesh.faceadr[0] + mesh.facenum[0]))
                found.triangles(name, model.mesh_vert[corners], model.mesh_face[faces], pose)
            case other:
                found.leave(name, f"is of the kind {other.name[7:].lower()}, which no body is")
    for root, count in moving.items():
        name = model.body(root).name or f"body {root}"
        found.leave(name, f"moves, and has {count} shapes that therefore are no fixed body")
