"""The collision bodies of a workcell: links, tools, payload and environment as convex pieces."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock
from typing import Literal

import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.pieces import CutMesh, Hull, Piece, check_piece
from symbolic.read.arms import ArmLinks, arm_links, arm_model, link_frame, one_machine, robot_urdf
from symbolic.read.descriptions import resolve_mesh
from symbolic.read.urdf import UrdfMesh
from symbolic.records import PAYLOAD_NAME, Capsule, Mesh, Robot, Shape, Workcell
from symbolic.records.content import CacheKey, ContentRecord, digest_of_parts
from symbolic.records.problems import shown

Group = Literal["robot 1", "robot 2", "payload", "environment"]
MOST_CORNERS = 100_000
"""Largest accepted number of corners of all convex pieces of meshes. Sorting the pairs then takes
about 15 s."""


@dataclass(frozen=True)
class Frame:
    """A frame to which bodies are fixed.

    Attributes:
        kind: 'world', 'box', or 'link' for the frame that a joint of a robot moves.
        robot, joint: for a link the indices of the robot and of the joint, from 0; otherwise -1.
    """

    kind: Literal["world", "link", "box"]
    robot: int = -1
    joint: int = -1


WORLD = Frame("world")
BOX = Frame("box")


@dataclass(frozen=True)
class CollisionBody(ContentRecord):
    """A named rigid body.

    Attributes:
        name: name in the workcell file for environment bodies; 'robot/link' for links and tools.
        group: 'robot 1', 'robot 2', 'payload' or 'environment'.
        frame: frame to which the body is fixed.
        pieces: convex pieces of the body, in this frame.
        is_tool: whether the body is part of a robot's tool.
        carries: indices of the arms that are mounted on this link (`symbolic.read.arms.ArmLinks`);
            None if the body is not a link or carries no arm.
        root: for a link that does not move, the index of the robot and the pieces in the robot's
            root frame; else None.
    """

    name: str
    group: Group
    frame: Frame
    pieces: tuple[Piece, ...]
    is_tool: bool = False
    carries: tuple[int, ...] | None = None
    root: tuple[int, tuple[Piece, ...]] | None = None


@dataclass(frozen=True)
class ArmGeometry(ContentRecord):
    """The constant geometry of an arm's n joints.

    Attributes:
        T_world_root: (4, 4) root of the URDF in the world.
        origins: (n, 4, 4) frame of each joint at position zero, in the frame of the joint before
            it; of the first joint in the root.
        axes: (n, 3) unit axis of each joint in the joint's frame.
        turning: (n,) True for joints that turn about their axis, False for joints that slide along
            it.
        T_joint_box: (4, 4) carried box in the last joint's frame.
        lower, upper: (n,) joint limits [rad or m].
    """

    T_world_root: Array
    origins: Array
    axes: Array
    turning: tuple[bool, ...]
    T_joint_box: Array
    lower: Array
    upper: Array

    @cached_property
    def chain(self) -> str:
        """Digest of the joints' frames, axes and limits. It is equal for arms that differ only in
        the pose of their base or in the box that they hold, so results cached under it serve all of
        them."""
        own = self.origins, self.axes, self.turning, self.lower, self.upper
        return digest_of_parts(own)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.axes)

    @property
    def slides(self) -> Array:
        """(n,) largest distance by which each joint slides from position zero [m]; 0 for a joint
        that turns."""
        most = np.maximum(np.abs(self.lower), np.abs(self.upper))
        return np.asarray(np.where(self.turning, 0.0, most))


def collision_bodies(
    workcell: Workcell, meshes: MeshReader | None = None
) -> tuple[CollisionBody, ...]:
    """Return all bodies: robot 1, robot 2, payload, environment, each in the order of its file.

    If a robot is part of a larger machine, the links of the machine that do not move count as
    environment.

    Args:
        workcell: the workcell.
        meshes: reader of the meshes; None for a new one.

    Raises:
        CollisionModelError: a shape or mesh is unusable, or two bodies share a name.
    """
    meshes = meshes or MeshReader()
    links = (arm_links(workcell.robots, 0), arm_links(workcell.robots, 1))
    bodies = [b for i in (0, 1) for b in _robot_bodies(workcell.robots[i], i, links[i], meshes)]
    if one_machine(workcell.robots):  # what a joint of both arms moves belongs to the first
        mount = f"{workcell.robots[0].name}/{links[1].mount}"
        bodies = [replace(b, carries=(1,)) if b.name == mount else b for b in bodies]
    payload = shape_pieces(workcell.payload.solid, np.eye(4), "the payload", meshes)
    bodies.append(CollisionBody(PAYLOAD_NAME, "payload", BOX, payload))
    bodies += [b for i in (0, 1) for b in _standing_bodies(workcell.robots, i, links, meshes)]
    for obstacle in workcell.environment:
        owner = f"environment body {obstacle.name!r}"
        pieces = shape_pieces(obstacle.shape, obstacle.pose, owner, meshes)
        bodies.append(CollisionBody(obstacle.name, "environment", WORLD, pieces))
    for body in bodies:
        _check_body(CacheKey(body, known=body.content))
    _check_effort(bodies, workcell.collision.most_pieces)
    counts = Counter(body.name for body in bodies)
    repeated = sorted(name for name, count in counts.items() if count > 1)
    if repeated:
        raise CollisionModelError(
            f"collision bodies share the name(s) {repeated}; rename them", code="same-name"
        )
    return tuple(bodies)


@lru_cache(maxsize=256)
def _check_body(seen: CacheKey) -> None:
    (body,) = seen.given
    for piece in body.pieces:
        check_piece(piece, f"collision body {body.name!r}")


def arm_geometry(workcell: Workcell, i: int) -> ArmGeometry:
    """Compute frames, axes and limits of the joints of a workcell's arm with index i (0 or 1)."""
    robot, contact = workcell.robots[i], workcell.contacts[i]
    model = arm_model(robot)
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
    joints = range(1, model.njoints)
    motions = np.array([np.asarray(data.joints[j].S).ravel() for j in joints])
    flange = model.frames[link_frame(model, robot.flange)]
    T_flange_box = robot.T_flange_pad @ np.linalg.inv(contact.T_box_pad)
    return ArmGeometry(
        T_world_root=robot.T_world_base,
        origins=np.array([model.jointPlacements[j].homogeneous for j in joints]),
        axes=motions[:, :3] + motions[:, 3:],
        turning=tuple(np.any(motions[:, 3:] != 0.0, axis=1).tolist()),
        T_joint_box=flange.placement.homogeneous @ T_flange_box,
        lower=robot.position_lower,
        upper=robot.position_upper,
    )


def _check_effort(bodies: list[CollisionBody], most_pieces: int) -> None:
    """Check that collision checks of the bodies finish within seconds: that the bodies have at most
    `most_pieces` convex pieces and `MOST_CORNERS` corners.

    Raises:
        CollisionModelError: the bodies have more pieces or corners.
    """
    pieces = sum(len(body.pieces) for body in bodies)
    largest = max(bodies, key=lambda body: len(body.pieces))
    if pieces > most_pieces:
        raise CollisionModelError(
            f"the cell's bodies have {pieces} convex pieces, {len(largest.pieces)} of them "
            f"{largest.name!r}; allowed are {most_pieces}: simplify the meshes, or raise "
            "collision.most_pieces in the workcell file and wait",
            code="too-many-pieces",
        )
    corners = {body.name: sum(map(_corners, body.pieces)) for body in bodies}
    if sum(corners.values()) > MOST_CORNERS:
        name = max(corners, key=lambda name: corners[name])
        raise CollisionModelError(
            f"the convex pieces of the cell's meshes have {sum(corners.values())} corners, "
            f"{corners[name]} of them {name!r}; allowed are {MOST_CORNERS}: simplify the meshes "
            "for collision checking",
            code="too-many-corners",
        )


def _corners(piece: Piece) -> int:
    return len(piece.shape.vertices) if isinstance(piece.shape, Hull) else 0


def _robot_bodies(robot: Robot, i: int, links: ArmLinks, meshes: MeshReader) -> list[CollisionBody]:
    """Return the links and the tool of the arm with index i, as collision bodies.

    Args:
        robot: description of the arm.
        i: index of the arm.
        links: links that are modelled with the arm.
        meshes: reader of the meshes.
    """
    group: Group = "robot 1" if i == 0 else "robot 2"
    model = arm_model(robot)
    own = links.moved if robot.chain_root else (*links.still, *links.moved)
    bodies = []
    for link, pieces in _link_pieces(robot, own, meshes).items():
        frame, T = _attachment(model, link, robot, i)
        moved, root = tuple(piece.moved(T) for piece in pieces), None
        if frame == WORLD:
            placed = model.frames[link_frame(model, link)].placement.homogeneous
            root = i, tuple(piece.moved(placed) for piece in pieces)
        bodies.append(CollisionBody(f"{robot.name}/{link}", group, frame, moved, root=root))
    if robot.chain_root:  # a machine's file may list its links in any order
        bodies.sort(key=lambda body: body.frame.joint)
    frame, T = _attachment(model, robot.flange, robot, i)
    for tool in robot.tool:
        owner = f"tool {tool.name!r} of robot {robot.name!r}"
        pieces = shape_pieces(tool.shape, tool.pose, owner, meshes)
        moved = tuple(piece.moved(T) for piece in pieces)
        bodies.append(CollisionBody(f"{robot.name}/{tool.name}", group, frame, moved, True))
    return bodies


def _standing_bodies(
    robots: tuple[Robot, Robot], i: int, links: tuple[ArmLinks, ArmLinks], meshes: MeshReader
) -> list[CollisionBody]:
    """Return the links of an arm's machine that no joint moves, as collision bodies. The list is
    empty if the description consists of the arm only.

    Args:
        robots: descriptions of both arms.
        i: index of the arm.
        links: for each arm the links that are modelled with it.
        meshes: reader of the meshes.
    """
    robot, bodies = robots[i], []
    if not robot.chain_root:
        return []
    model = arm_model(robot)
    arms = (0, 1) if one_machine(robots) else (i,)
    for link, pieces in _link_pieces(robot, links[i].still, meshes).items():
        _, T = _attachment(model, link, robot, i)
        moved = tuple(piece.moved(T) for piece in pieces)
        carries = tuple(arm for arm in arms if links[arm].mount == link)
        name = f"{robot.name}/{link}"
        bodies.append(CollisionBody(name, "environment", WORLD, moved, carries=carries))
    return bodies


def _attachment(model: pin.Model, link: str, robot: Robot, i: int) -> tuple[Frame, Array]:
    """Return the frame to which a link is fixed, and the link's pose (4, 4) in this frame. The
    frame is that of a joint, or the world for a link that no joint moves.

    Args:
        model: Pinocchio's model of the arm.
        link: name of the link.
        robot: description of the robot.
        i: index of the arm.
    """
    frame = model.frames[link_frame(model, link)]
    placement: Array = frame.placement.homogeneous
    if frame.parentJoint == 0:
        return WORLD, robot.T_world_base @ placement
    return Frame("link", i, frame.parentJoint - 1), placement


def _link_pieces(
    robot: Robot, links: Collection[str], meshes: MeshReader
) -> dict[str, tuple[Piece, ...]]:
    """Return the convex pieces of some links of a robot's URDF, by link in the order of the file.

    Args:
        robot: the robot.
        links: names of the links.
        meshes: reader of the meshes.

    Returns:
        Pieces by the link's name, in the link's frame.
    """
    found_pieces = {}
    for link, collisions in robot_urdf(robot).collisions.items():
        if link not in links:
            continue
        owner = f"link {link!r} of {robot.urdf.name}"
        pieces: list[Piece] = []
        for collision in collisions:
            shape = collision.shape
            found = _located(shape, robot, owner) if isinstance(shape, UrdfMesh) else shape
            pieces += shape_pieces(found, collision.pose, owner, meshes)
        found_pieces[link] = tuple(pieces)
    return found_pieces


def _located(mesh: UrdfMesh, robot: Robot, owner: str) -> Mesh:
    path = resolve_mesh(mesh.address, robot.urdf, robot.package_dirs)
    if path is None:
        looked = ", ".join(map(str, robot.package_dirs)) or "none given"
        raise CollisionModelError(
            f"{owner}: mesh {shown(mesh.address)} not found; package folders looked in: {looked}",
            code="mesh-not-found",
        )
    return Mesh(path, mesh.scale)


# --- pieces of shapes ---


class MeshReader:
    """Reader of a cell's meshes. Each mesh is read and decomposed once.

    All meshes together may have at most `MOST_CELL_FACES` triangles.

    Attributes:
        known: decomposed meshes by file and scale.
    """

    def __init__(self) -> None:
        self.known: dict[tuple[Path, tuple[float, ...]], CutMesh] = {}

    def hulls(self, mesh: Mesh) -> tuple[Hull, ...]:
        """Return the convex pieces of a mesh in the mesh's frame. A mesh that was read before is
        not read again.

        Raises:
            CollisionModelError: the mesh cannot be read or decomposed, or all meshes read so far
                have too many triangles together.
        """
        # Not imported at the top: trimesh takes long to start, and most cells have no meshes.
        from symbolic.read.meshes import MOST_CELL_FACES

        key = (mesh.path, tuple(mesh.scale))
        if key not in self.known:
            with _CUTTING:
                found = _cut_file(*key, _state(mesh.path))
            faces = found.faces + sum(known.faces for known in self.known.values())
            if faces > MOST_CELL_FACES:
                raise CollisionModelError(
                    f"{mesh.path}: with its {found.faces} triangles the cell's meshes have "
                    f"{faces}; allowed are {MOST_CELL_FACES} together: simplify the largest",
                    code="too-many-triangles",
                )
            self.known[key] = found
        return self.known[key].hulls


def _state(path: Path) -> tuple[int, int]:
    """Return a file's modification time [ns] and size [bytes], by which a changed file is
    recognised. Both are zero for a missing file; the attempt to read it then raises the error."""
    try:
        found = path.stat()
    except OSError:
        return (0, 0)
    return (found.st_mtime_ns, found.st_size)


_CUTTING = Lock()
"""Threads that need the same mesh at once shall not all decompose it."""


@lru_cache(maxsize=64)
def _cut_file(path: Path, scale: tuple[float, ...], state: tuple[int, int]) -> CutMesh:
    """Compute the convex pieces of a mesh file.

    The result is cached beyond one cell: a process that tries many variants of a cell reads its
    robots several times.

    Args:
        path: path of the mesh.
        scale: factors along the mesh's axes.
        state: modification time and size of the file, so that a changed file is read again.
    """
    from symbolic.geometry.hulls import cut
    from symbolic.read.meshes import read_mesh

    return cut(read_mesh(path, np.array(scale)), path)


def shape_pieces(
    shape: Shape | Capsule, pose: Array, owner: str, meshes: MeshReader
) -> tuple[Piece, ...]:
    """Return the convex pieces of a shape, in the frame of its body.

    Args:
        shape: the shape.
        pose: (4, 4) of the shape in its body's frame.
        owner: name of the body, for messages.
        meshes: reader of the meshes.
    """
    if not isinstance(shape, Mesh):
        return (Piece(shape, pose),)
    try:
        return tuple(Piece(hull, pose) for hull in meshes.hulls(shape))
    except CollisionModelError as error:
        raise CollisionModelError(f"{owner}: {error}") from error
