"""Files in MJCF, MuJoCo's format: robots as URDF (bodies, joints, masses, limits, shapes), and the
fixed bodies of scenes.

MuJoCo's own reader compiles the file, so it handles includes, defaults and angles in degrees. The
content of the compiled model is taken; content of a robot that URDF cannot express is refused.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.read.scene_bodies import SceneBuilder, slab_below
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.poses import inverse, rpy_from_rotation, transform
from symbolic.safe_io import printable

NO_READER = "is a file of MuJoCo, whose reader is not installed: pip install 'dual-arm-carry[sim]'"


def compiled(path: Path) -> Any:
    """Load an MJCF file with MuJoCo; return the module `mujoco`, the file's `MjSpec` and its
    `MjModel`.

    Raises:
        OutsideError: MuJoCo is not installed, or refuses the file.
    """
    try:
        import mujoco
    except ImportError as error:
        raise OutsideError(NO_READER, code="missing-extra") from error
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        return mujoco, spec, spec.compile()
    except ValueError as error:
        raise OutsideError(
            f"MuJoCo does not take it: {printable(str(error))}", code="not-mjcf"
        ) from error


def geom_shape(
    mujoco: Any, model: Any, geom: int
) -> tuple[str, Box | Sphere | Cylinder | Capsule | None]:
    """Return the kind of a geom, such as 'box', and its shape; None in place of the shape for kinds
    other than box, sphere, cylinder and capsule.

    Args:
        mujoco: the module `mujoco`.
        model: the compiled model.
        geom: index of the geom.
    """
    kind = mujoco.mjtGeom(int(model.geom_type[geom])).name[7:].lower()
    size = model.geom_size[geom]
    radius, length = float(size[0]), 2.0 * float(size[1])
    shapes: dict[str, Box | Sphere | Cylinder | Capsule] = {
        "box": Box(2.0 * size),
        "sphere": Sphere(radius),
        "cylinder": Cylinder(radius, length),
        "capsule": Capsule(radius, length),
    }
    return kind, shapes.get(kind)


@lru_cache(maxsize=8)
def mjcf_as_urdf(path: Path, content: bytes) -> bytes:
    """Convert a robot's MJCF to URDF: one link per body and per named site.

    The world is the root link `world`. MJCF has no velocity limits; they are written as zero, and a
    cell has to state them (`velocity_max`). Shapes that collide with nothing (contype and
    conaffinity zero) are left out; planes become slabs. A floating base, or a loose object of a
    scene, is fixed at its pose in the file.

    Args:
        path: the file.
        content: content of the file, the key under which the result is cached. Included files and
            meshes are read once per process.

    Raises:
        OutsideError: MuJoCo refuses the file, or a URDF cannot express its content.
    """
    mujoco, spec, model = compiled(path)
    if any(np.any(mesh.refpos) or abs(mesh.refquat[0]) < 1.0 for mesh in spec.meshes):
        raise OutsideError(
            "moves a mesh by refpos or refquat; move its geom instead", code="moved-mesh"
        )
    return _Writer(mujoco, model).urdf()


class _Writer:
    """Writer of a compiled MuJoCo model as URDF."""

    def __init__(self, mujoco: Any, model: Any) -> None:
        self._mujoco, self._model = mujoco, model
        self._root = ElementTree.Element("robot", {"name": "robot"})
        self._names = [
            "world" if k == 0 else model.body(k).name or f"body_{k}" for k in range(model.nbody)
        ]

    def urdf(self) -> bytes:
        model = self._model
        for body, name in enumerate(self._names):
            link = _add(self._root, "link", name=name)
            if model.body_mass[body] > 0.0:
                self._inertial(link, body)
            for geom in np.flatnonzero(model.geom_bodyid == body):
                self._collision(link, int(geom), name)
            if body:
                self._joints(body, name)
        taken = set(self._names)
        for site in range(model.nsite):
            name = model.site(site).name
            if name and name not in taken:
                _add(self._root, "link", name=name)
                parent = self._names[model.site_bodyid[site]]
                pose = self._pose(model.site_pos[site], model.site_quat[site])
                self._joint(f"{name}_fixed", "fixed", (parent, name), pose)
        return ElementTree.tostring(self._root)

    def _joints(self, body: int, name: str) -> None:
        """Write the joints between a body and its parent as URDF joints.

        In MJCF a body may have several joints, each with an anchor point of its own. They become a
        chain of URDF joints with empty links between them.

        Args:
            body: index of the body.
            name: name of the body's link in the URDF.
        """
        model, kinds = self._model, self._mujoco.mjtJoint
        parent = self._names[model.body_parentid[body]]
        T_parent_body = self._pose(model.body_pos[body], model.body_quat[body])
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for joint in range(first, first + count):
            called = model.joint(joint).name or f"joint_{joint}"
            kind = kinds(int(model.jnt_type[joint]))
            if kind == kinds.mjJNT_FREE:
                continue  # a floating base, or a loose object: it stands where the file has it
            if kind not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
                raise OutsideError(
                    f"joint {called!r} of body {name!r} is a ball; allowed are hinges, slides and "
                    "free joints, which are held where the file has them",
                    code="joint-kind",
                )
            if model.qpos0[model.jnt_qposadr[joint]]:
                raise OutsideError(
                    f"joint {called!r} has a ref; allowed is zero", code="joint-reference"
                )
            at = transform(np.eye(3), model.jnt_pos[joint])
            last = joint == first + count - 1 and not np.any(model.jnt_pos[joint])
            child = name if last else f"{called}_link"
            if not last:
                _add(self._root, "link", name=child)
            slides, limited = kind == kinds.mjJNT_SLIDE, bool(model.jnt_limited[joint])
            word = "prismatic" if slides else "revolute" if limited else "continuous"
            element = self._joint(called, word, (parent, child), T_parent_body @ at)
            _add(element, "axis", xyz=model.jnt_axis[joint])
            lower, upper = model.jnt_range[joint] if limited else (0.0, 0.0)
            effort = self._effort(joint)
            _add(element, "limit", lower=lower, upper=upper, effort=effort, velocity=0.0)
            parent, T_parent_body = child, inverse(at)
        if parent != name:
            self._joint(f"{name}_fixed", "fixed", (parent, name), T_parent_body)

    def _joint(
        self, name: str, kind: str, ends: tuple[str, str], pose: Array
    ) -> ElementTree.Element:
        element = _add(self._root, "joint", pose, name=name, type=kind)
        for tag, link in zip(("parent", "child"), ends, strict=True):
            _add(element, tag, link=link)
        return element

    def _effort(self, joint: int) -> float:
        """Return the largest torque or force of a joint [N m or N].

        This is the joint's own limit if it has one, else the sum of the limits of the actuators
        that drive it; 0 if none is limited.
        """
        model, words = self._model, self._mujoco
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).min())
        # A motor's force is its control times its gain, so bounds of either bound it.
        motor = (model.actuator_gaintype == words.mjtGain.mjGAIN_FIXED) & (
            model.actuator_biastype == words.mjtBias.mjBIAS_NONE
        )
        limited = np.array(
            [model.actuator_forcelimited > 0, motor & (model.actuator_ctrllimited > 0)]
        )
        gains = np.abs(model.actuator_gainprm[:, 0])
        ranges = np.array(
            [
                np.abs(model.actuator_forcerange).min(axis=1),
                np.abs(model.actuator_ctrlrange).min(axis=1) * gains,
            ]
        )
        forces = np.where(limited, ranges, np.inf).min(axis=0)
        moves = model.actuator_trntype == words.mjtTrn.mjTRN_JOINT
        counted = moves & (model.actuator_trnid[:, 0] == joint) & np.isfinite(forces)
        return float(np.sum((forces * np.abs(model.actuator_gear[:, 0]))[counted]))

    def _inertial(self, link: ElementTree.Element, body: int) -> None:
        model = self._model
        pose = self._pose(model.body_ipos[body], model.body_iquat[body])
        element = _add(link, "inertial", pose)
        _add(element, "mass", value=model.body_mass[body])
        xx, yy, zz = model.body_inertia[body]
        _add(element, "inertia", ixx=xx, ixy=0.0, ixz=0.0, iyy=yy, iyz=0.0, izz=zz)

    def _collision(self, link: ElementTree.Element, geom: int, name: str) -> None:
        model = self._model
        if not model.geom_contype[geom] and not model.geom_conaffinity[geom]:
            return
        pose = self._pose(model.geom_pos[geom], model.geom_quat[geom])
        kind, shape = geom_shape(self._mujoco, model, geom)
        mesh = int(model.geom_dataid[geom])
        if kind == "plane":
            kind = "box"
            shape, pose = slab_below(pose)
        if shape is not None:
            said = vars(shape)
        elif kind == "mesh" and model.mesh_pathadr[mesh] >= 0:
            path = bytes(model.paths[int(model.mesh_pathadr[mesh]) :]).split(b"\0", 1)[0]
            said = {"filename": path.decode(), "scale": model.mesh_scale[mesh]}
            # MuJoCo turns a mesh to its principal axes, and the geom with it.
            pose = pose @ inverse(self._pose(model.mesh_pos[mesh], model.mesh_quat[mesh]))
        else:
            raise OutsideError(
                f"body {name!r} has a shape of the kind {kind}; allowed are boxes, cylinders, "
                "spheres, capsules, planes and meshes with a file",
                code="shape-kind",
            )
        _add(_add(_add(link, "collision", pose), "geometry"), kind, **said)

    def _pose(self, place: Array, quaternion: Array) -> Array:
        rotation = np.empty(9)
        self._mujoco.mju_quat2Mat(rotation, quaternion)
        return transform(rotation.reshape(3, 3), place)


def _add(
    parent: ElementTree.Element, tag: str, pose: Array | None = None, **said: Any
) -> ElementTree.Element:
    """Add an inner element to an XML element, and return it.

    Args:
        parent: the XML element.
        tag: tag of the new element.
        pose: (4, 4) origin of the new element; None for none.
        said: attributes, as texts or numbers.
    """
    written = {
        key: value if isinstance(value, str) else " ".join(map(repr, np.ravel(value).tolist()))
        for key, value in said.items()
    }
    element = ElementTree.SubElement(parent, tag, written)
    if pose is not None:
        _add(element, "origin", xyz=pose[:3, 3], rpy=rpy_from_rotation(pose[:3, :3]))
    return element


# --- scenes ---


def read_mjcf(path: Path, found: SceneBuilder) -> None:
    """Add the shapes of an MJCF file's world and of its fixed bodies to a scene, at their poses in
    MuJoCo's initial configuration.

    Args:
        path: the file.
        found: collector of bodies.
    """
    mujoco, _, model = compiled(path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moving = dict[int, int]()
    standing = dict[int, list[str]]()
    for number in range(model.ngeom):
        geom = model.geom(number)
        body = int(geom.bodyid[0])
        name = f"{model.body(body).name or f'body {body}'} {geom.name}" if body else geom.name
        name = name.strip() or f"geom {number}"
        pose = transform(data.geom_xmat[number].reshape(3, 3), data.geom_xpos[number])
        kind, shape = geom_shape(mujoco, model, number)
        root, before = int(model.body_rootid[body]), len(found.bodies)
        if model.body_weldid[body]:
            moving[root] = moving.get(root, 0) + 1
        elif not geom.contype[0] and not geom.conaffinity[0]:
            found.note(name, "is no body, only to be seen: its contype and conaffinity are zero")
        elif shape is not None:
            found.add(name, shape, pose)
        elif kind == "plane":
            found.plane(name, pose)
        elif kind == "mesh":
            mesh = model.mesh(int(geom.dataid[0]))
            corners = slice(int(mesh.vertadr[0]), int(mesh.vertadr[0] + mesh.vertnum[0]))
            faces = slice(int(mesh.faceadr[0]), int(mesh.faceadr[0] + mesh.facenum[0]))
            found.triangles(name, model.mesh_vert[corners], model.mesh_face[faces], pose)
        else:
            found.leave(name, f"is of the kind {kind}, which no body is")
        standing.setdefault(root, []).extend(each.name for each in found.bodies[before:])
    for root, count in moving.items():
        name = model.body(root).name or f"body {root}"
        found.leave(name, f"moves, and has {count} shapes that therefore are no fixed body")
        if standing[root]:
            bodies = ", ".join(standing[root])
            found.note(name, f"remove {bodies} if they are the base of a robot that the cell has")
