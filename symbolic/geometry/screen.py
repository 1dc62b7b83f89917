"""Numbers of all bodies from which bounds of distances and motions are computed.

NumPy computes these numbers once per cell: simple shapes that contain each body, extents of
obstacles, and distances of body points from joint axes. `symbolic.geometry.clearance` builds
expressions from them; they may be arrays or symbols (`symbolic.parameters.CellParameters`). Flags
store which kind of bound each pair gets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.expression import number
from symbolic.geometry.bodies import WORLD, ArmGeometry, CollisionBody, Frame
from symbolic.geometry.covers import chain_cover, close_pairs, slab_cover
from symbolic.geometry.expressions import clean
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import (
    Hull,
    Piece,
    bounding_box,
    edges,
    farthest_from_axis,
    farthest_from_point,
    support,
)
from symbolic.geometry.separation import chain_radius
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.content import CacheKey, ContentRecord
from symbolic.records.numbered import ParameterGroup
from symbolic.records.poses import axes_with_z

SLANTED_LENGTH = 0.25
"""Bodies that are longer than wide by more than this [m] are also compared along their own axes.
Along the world's axes a slanted body seems wider by up to this much."""


@dataclass(frozen=True)
class CoverSolid:
    """A box, sphere, cylinder or capsule in a frame.

    Attributes:
        kind: class of the shape.
        size: half edges (3,) of a box, or radius and half length (2,) of another shape [m].
        centre: centre (3,) of the shape in the frame [m].
        rotation: axes (3, 3) of the shape as columns; None for the axes of the frame.
    """

    kind: type
    size: Array
    centre: Array
    rotation: Array | None


@dataclass(frozen=True)
class ScreenChain:
    """Equal spheres in a row that contain a body.

    Attributes:
        centres: (n, 3) centres of the spheres in the body's frame or in the world [m].
        radius: (1,) radius of each sphere [m].
    """

    centres: Array
    radius: Array


@dataclass(frozen=True)
class Reach:
    """Distances that limit how far the points of a body move when its frame or joints move.

    Attributes:
        centre: (3,) centre of the body's bounding box in the body's frame [m].
        spans: (2,) largest distance of the body's points from `centre`, and from the frame's origin
            [m].
        joints: (k,) for each of the k joints that move the body, an upper bound of the distance of
            the body's points from the joint's axis [m]; 1 for a sliding joint.
    """

    centre: Array
    spans: Array
    joints: Array


@dataclass(frozen=True)
class Obstacle:
    """A fixed convex piece of the environment.

    Attributes:
        kind: class of the shape.
        axes: (3, 3) directions, as rows, along which a box is compared; None for the world's axes.
        extent: (2, 3) least and largest coordinate of the piece along these directions [m].
        cover: a simple shape in the world that contains the piece.
        to_own: (3, 3) rotation from the world to the piece's own axes; None for the identity.
        offset: position (3,) of the world's origin in the piece's frame [m].
    """

    kind: type
    axes: Array | None
    extent: Array
    cover: CoverSolid
    to_own: Array | None
    offset: Array


@dataclass(frozen=True)
class ScreenBody(ContentRecord):
    """The numbers of one body for bounds of distances and motions.

    Attributes:
        group: group of the `CollisionBody`.
        frame: frame to which the body is fixed; 'world' with a robot's index for bodies at the
            robot's base.
        cover: simple shapes that contain the body, in `frame` or, for a body at a base, in the base
            frame; () for an obstacle.
        chain: chain of spheres that contains the body, in `frame`; in the world for a body at a
            base; None for an obstacle.
        extent: (2 n + 2, 3) for a body at a base: least and largest world coordinates of the whole
            body, then of each of its n simple shapes [m]; else None.
        reach: distances that limit the body's motion; None if the body does not move.
        pieces: rotation and centre (3,) [m] of each piece. For a moving body the rotation is a
            matrix (3, 3) in `frame`, or None for the identity; for a fixed body a quaternion (4,),
            w x y z, in the world.
        obstacles: the pieces of a body of the environment; () for other bodies.
        slanted: whether distances to obstacles are also bounded along the body's own axes.
        is_constant: whether the numbers follow from files alone. This holds for links, and for
            moving bodies with meshes.
    """

    group: str
    frame: Frame
    cover: tuple[CoverSolid, ...]
    chain: ScreenChain | None
    extent: Array | None
    reach: Reach | None
    pieces: tuple[tuple[Array | None, Array], ...]
    obstacles: tuple[Obstacle, ...]
    slanted: bool
    is_constant: bool


@dataclass(frozen=True)
class ScreenBase:
    """Pose of an arm's base in the world.

    Attributes:
        rotation: (3, 3) rotation from the base to the world.
        position: (3,) origin of the base in the world [m].
    """

    rotation: Any
    position: Any


@dataclass(frozen=True)
class Screen:
    """The numbers of a cell's bodies and pairs for bounds of distances and motions.

    Attributes:
        bases: pose of each arm's base.
        turning: for each arm, True for each joint that turns, False for one that slides.
        bodies: all bodies, in the order of `CellGeometry.bodies`.
        pairs: indices of the two bodies of each possible pair (`CellGeometry.possible`).
        own: for each pair of bodies of one arm, whether its bound compares the bodies piece by
            piece; None for other pairs.
        payload: bounding box of the payload.
        payload_is_mesh: whether the payload is a mesh.
        between: (3, 3) directions as rows, the first from base 1 to base 2; None for the world's
            axes.
        given: the parameter group that holds the numbers if they are symbols; else None.
    """

    bases: tuple[ScreenBase, ScreenBase]
    turning: tuple[tuple[bool, ...], tuple[bool, ...]]
    bodies: tuple[ScreenBody, ...]
    pairs: tuple[tuple[int, int], ...]
    own: tuple[bool | None, ...]
    payload: CoverSolid
    payload_is_mesh: bool
    between: Array | None
    given: ParameterGroup | None = None


def screen_of(geometry: CellGeometry) -> Screen:
    """Compute the constants that bounds of distances and motions of a cell's bodies need: covers of
    the bodies by simple shapes, their extents and reaches, and for each pair of bodies the kind of
    its bound."""
    bodies, arms = geometry.bodies, geometry.arms
    pairs = tuple((pair.first, pair.second) for pair in geometry.possible)
    close = close_pairs(geometry)
    own = tuple((i, j) in close if bodies[i].group == bodies[j].group else None for i, j in pairs)
    payload = next(body for body in bodies if body.frame.kind == "box")
    box = payload.pieces[0]
    if len(payload.pieces) > 1 or not isinstance(box.shape, Box):
        box = bounding_box(payload.pieces, np.eye(3))
    bases = [ScreenBase(clean(T[:3, :3]), T[:3, 3]) for T in (arm.T_world_root for arm in arms)]
    return Screen(
        (bases[0], bases[1]),
        (arms[0].turning, arms[1].turning),
        tuple(_bounded(_seen(body, arms)) for body in bodies),
        pairs,
        own,
        _solid(box),
        has_hulls(payload),
        _between(bases[0].position, bases[1].position),
    )


def has_hulls(body: CollisionBody) -> bool:
    """Return True if a body has a mesh."""
    return any(isinstance(piece.shape, Hull) for piece in body.pieces)


def _seen(body: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry]) -> CacheKey:
    """Return the cache key of a body's constants. It holds the body and both arms. Keys are equal
    if the bodies are equal and the arms that move them have the same geometry."""
    of: tuple[Any, ...] = (body.content,)
    if body.frame.kind == "link":
        of = (body.content, arms[body.frame.robot].chain)
    elif body.root is not None:
        of = (body.content, arms[body.root[0]].content)
    return CacheKey(body, arms, known=of)


@lru_cache(maxsize=256)
def _bounded(seen: CacheKey) -> ScreenBody:
    body, arms = seen.given
    still = body.frame == WORLD
    pieces = tuple(
        (_quaternion(piece.rotation), piece.centre)
        if still
        else (_rotation(piece), clean(piece.centre))
        for piece in body.pieces
    )
    if body.group == "environment":
        obstacles = tuple(_obstacle(piece) for piece in body.pieces)
        return ScreenBody(
            body.group, body.frame, (), None, None, None, pieces, obstacles, False, False
        )
    frame, is_link = body.frame, body.frame.kind != "box" and not body.is_tool
    if body.root is not None:  # what stands at a base is covered as it is there
        frame = Frame("world", body.root[0])
        body = CollisionBody(body.name, body.group, frame, body.root[1])
    chain = chain_cover(body)
    solids = slab_cover(body)
    centres, extent, reach = chain.centres, None, None
    if still:
        base = arms[frame.robot].T_world_root
        centres = centres @ base[:3, :3].T + base[:3, 3]
        each = np.array([_extent(piece.moved(base), np.eye(3)) for piece in solids])
        whole = np.stack([each[:, 0].min(axis=0), each[:, 1].max(axis=0)])
        extent = np.concatenate([whole[None], each]).reshape(-1, 3)
    else:
        reach = _reach(body, arms)
    spheres = ScreenChain(clean(centres), np.array([chain.radius]))
    cover, constant = tuple(_solid(piece) for piece in solids), is_link or has_hulls(body)
    slanted = _slanted_matters(body)
    return ScreenBody(
        body.group, frame, cover, spheres, extent, reach, pieces, (), slanted, constant
    )


def _solid(piece: Piece) -> CoverSolid:
    shape = piece.shape
    if isinstance(shape, Box):
        size = np.asarray(shape.size) / 2.0
    elif isinstance(shape, Sphere):
        size = np.array([shape.radius, 0.0])
    else:
        assert isinstance(shape, Cylinder | Capsule), "a cover has no hulls"
        size = np.array([shape.radius, shape.length / 2.0])
    return CoverSolid(type(shape), size, clean(piece.centre), _rotation(piece))


def _rotation(piece: Piece) -> Array | None:
    found = clean(piece.rotation)
    return None if np.array_equal(found, np.eye(3)) else found


def _quaternion(rotation: Array) -> Array:
    x, y, z, w = pin.Quaternion(clean(rotation)).coeffs()
    return np.array([w, x, y, z])


def _obstacle(piece: Piece) -> Obstacle:
    R = clean(piece.rotation)
    along_world = np.allclose(np.abs(R).max(axis=0), 1.0)
    box = piece.shape if isinstance(piece.shape, Box) else None
    axes = None if box is None or along_world else R.T
    A = np.eye(3) if axes is None else axes
    extent = _extent(piece, A)
    if box is not None and along_world:
        half = np.abs(R) @ (np.asarray(box.size) / 2.0)
        cover = CoverSolid(Box, half, clean(piece.centre), None)
    else:
        (found,) = slab_cover(CollisionBody("", "environment", WORLD, (piece,)))
        cover = _solid(found)
    T = clean(np.asarray(np.linalg.inv(piece.pose), dtype=float))
    to_own = None if np.array_equal(T[:3, :3], np.eye(3)) else T[:3, :3]
    return Obstacle(type(piece.shape), axes, extent, cover, to_own, T[:3, 3])


def _extent(piece: Piece, A: Array) -> Array:
    """Compute the least and largest coordinate of a piece along three directions [m].

    Args:
        piece: the piece.
        A: (3, 3) unit vectors of the directions as rows, in the body's frame.

    Returns:
        (2, 3) least coordinates, then largest coordinates.
    """
    return np.stack([-support(piece, -A), support(piece, A)])


def _reach(body: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry]) -> Reach:
    centre = bounding_box(body.pieces, np.eye(3)).centre
    spans = [
        max(farthest_from_point(piece, point) for piece in body.pieces)
        for point in (centre, np.zeros(3))
    ]
    joints = np.zeros(0)
    if body.frame.kind == "link":
        joints = reach_about_joints(body, arms[body.frame.robot])[: body.frame.joint + 1]
    return Reach(clean(centre), np.array(spans), joints)


def reach_about_joints(body: CollisionBody, arm: ArmGeometry) -> Array:
    """Compute for each joint of an arm how far a link's points move at most per unit of the joint's
    motion: for a turning joint an upper bound of their distance from the joint's axis [m].

    For the link's own joint the bound follows from the shape. For earlier joints the chain of links
    in between is assumed stretched.

    Args:
        body: the link.
        arm: geometry of its arm with n joints.

    Returns:
        (n,) bounds; 1 for a prismatic joint, 0 for a joint that does not move the link.
    """
    reach = np.zeros(arm.joints)
    last = body.frame.joint
    for j in range(last + 1):
        if not arm.turning[j]:
            reach[j] = 1.0
        elif j == last:
            reach[j] = max(farthest_from_axis(p, np.zeros(3), arm.axes[j]) for p in body.pieces)
        else:
            offset = arm.origins[j + 1][:3, 3]
            across = offset - (offset @ arm.axes[j]) * arm.axes[j]
            reach[j] = float(np.linalg.norm(across)) + chain_radius(body, arm, j + 1)
            reach[j] += float(arm.slides[j + 1])
    return reach


def _slanted_matters(body: CollisionBody) -> bool:
    """Return True if the distances of a body to obstacles have to be bounded along the body's own
    axes too. This holds for the payload, and for a body whose longest edge exceeds the next by more
    than `SLANTED_LENGTH`."""
    _, width, length = edges(body.pieces)
    return body.frame.kind == "box" or bool(length - width > SLANTED_LENGTH)


def _between(first: Array, second: Array) -> Array | None:
    along = second - first
    distance = float(np.linalg.norm(along))
    if distance < 1e-6 or np.max(np.abs(along)) > 0.99 * distance:
        return None
    return clean(axes_with_z(along / distance)[:, [2, 0, 1]].T)


# --- as expressions ---


def turned(rotation: Any) -> ca.SX:
    """Return a rotation (3, 3), a matrix of numbers or symbols, as an expression; the identity if
    it is None."""
    return ca.SX.eye(3) if rotation is None else ca.SX(number(rotation))


def columns(values: Any) -> Sequence[ca.SX]:
    """Return the n rows of an array (n, 3) as column vectors (3,)."""
    whole = ca.SX(number(values))
    return [whole[k, :].T for k in range(whole.shape[0])]
