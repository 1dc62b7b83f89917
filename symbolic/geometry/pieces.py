"""Convex pieces: exact support functions, and simple pieces that enclose others, with proof.

A piece is a convex shape at a pose in its body's frame. Everything that collision checking
proves (lower bounds of distances, reach, motion between samples) rests on the functions of
this file, which are exact or err to the safe side; each says which. Lengths in m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.poses import axes_with_z, transform
from symbolic.records.quantities import SMALLEST_SIZE


@dataclass(frozen=True, eq=False)
class Hull:
    """The convex hull of vertices: (n, 3) [m]; faces: (m, 3) triangles, outward."""

    vertices: Array
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class CutMesh:
    """A mesh and its convex pieces.

    Attributes:
        hulls: their union contains it.
        faces, vertices, parts: numbers of its triangles, of their corners and of its connected
            components.
        open_parts: number of the components with holes, each of which is covered by one hull.
    """

    hulls: tuple[Hull, ...]
    faces: int
    vertices: int
    parts: int
    open_parts: int


ConvexShape = Box | Cylinder | Sphere | Capsule | Hull


@dataclass(frozen=True)
class Piece:
    """A convex shape at pose (4, 4) in its body's frame."""

    shape: ConvexShape
    pose: Array

    def __post_init__(self) -> None:
        pose = np.array(self.pose, dtype=float)
        pose.setflags(write=False)
        object.__setattr__(self, "pose", pose)

    @cached_property
    def centre(self) -> Array:
        """(3,) origin of the shape's frame in the body's frame."""
        return self.pose[:3, 3]

    @cached_property
    def rotation(self) -> Array:
        """(3, 3) axes of the shape's frame in the body's frame, as columns."""
        return self.pose[:3, :3]

    def moved(self, T: Array) -> Piece:
        """Return the piece in the frame into which T (4, 4) maps the body's frame."""
        return Piece(self.shape, T @ self.pose)


def check_piece(piece: Piece, owner: str) -> None:
    """Raise CollisionModelError unless the shape has a finite, positive size and pose."""
    shape = piece.shape
    match shape:
        case Box():
            sizes = {f"size[{i}]": float(v) for i, v in enumerate(shape.size)}
        case Cylinder():
            sizes = {"radius": shape.radius, "length": shape.length}
        case Sphere():
            sizes = {"radius": shape.radius}
        case Capsule():
            sizes = {"radius": shape.radius, "length": shape.length}
        case Hull():
            extents = np.ptp(shape.vertices, axis=0)
            sizes = {f"extent[{i}]": float(v) for i, v in enumerate(extents)}
    for name, value in sizes.items():
        if not np.isfinite(value) or value < SMALLEST_SIZE:
            raise CollisionModelError(
                f"{owner}: {type(shape).__name__.lower()} {name} is {value:g} m; "
                f"every extent of a collision shape must be at least {SMALLEST_SIZE:g} m: "
                "correct the size or remove the shape",
                code="extent",
            )
    R = piece.rotation
    if not np.all(np.isfinite(piece.pose)) or not np.allclose(R.T @ R, np.eye(3), atol=1e-9):
        raise CollisionModelError(
            f"{owner}: the pose of a {type(shape).__name__.lower()} is not a rotation and a "
            "finite translation; correct the pose",
            code="pose",
        )


def support(piece: Piece, directions: Array) -> Array:
    """Compute the largest u.x over the piece, exact, for each row u of directions (n, 3);
    returns (n,)."""
    u = np.atleast_2d(directions)
    return np.asarray(u @ piece.centre + reach(piece.shape, u @ piece.rotation), dtype=float)


def reach(shape: ConvexShape, directions: Array) -> Array:
    """Compute the largest u.x over a shape in its own frame, exact, per row u of (n, 3); returns
    (n,)."""
    u = directions
    match shape:
        case Box():
            found = np.abs(u) @ (np.asarray(shape.size) / 2.0)
        case Cylinder():
            axial = np.abs(u[:, 2]) * (shape.length / 2.0)
            found = axial + shape.radius * np.hypot(u[:, 0], u[:, 1])
        case Sphere():
            found = shape.radius * np.linalg.norm(u, axis=1)
        case Capsule():
            axial = np.abs(u[:, 2]) * (shape.length / 2.0)
            found = axial + shape.radius * np.linalg.norm(u, axis=1)
        case Hull():
            found = np.max(u @ shape.vertices.T, axis=1)
    return np.asarray(found, dtype=float)


def shrunk(piece: Piece, by: float) -> Piece:
    """Shrink a piece by a length on every side, a hull by at least that; a thin piece keeps a
    minimum size."""
    shape = piece.shape
    left = SMALLEST_SIZE
    match shape:
        case Box():
            smaller: ConvexShape = Box(np.maximum(np.asarray(shape.size) - 2.0 * by, left))
        case Cylinder():
            length = max(shape.length - 2.0 * by, left)
            smaller = Cylinder(max(shape.radius - by, left), length)
        case Sphere():
            smaller = Sphere(max(shape.radius - by, left))
        case Capsule():
            smaller = Capsule(max(shape.radius - by, left), shape.length)
        case Hull():
            # Towards a point of the inside every face moves by its distance from there, in share.
            centre = shape.vertices.mean(axis=0)
            corners = shape.vertices[shape.faces]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            areas = np.linalg.norm(normals, axis=1)
            flat = areas < SMALLEST_SIZE**2
            rooms = np.einsum("nd,nd->n", corners[:, 0] - centre, normals)[~flat] / areas[~flat]
            share = max(1.0 - by / float(rooms.min()), 1e-3)
            smaller = Hull(centre + share * (shape.vertices - centre), shape.faces)
    return Piece(smaller, piece.pose)


def box_corners(size: Array) -> Array:
    """Return the corners (8, 3) of a cuboid of the given edge lengths, centred at its frame."""
    return np.array(list(product((-0.5, 0.5), repeat=3))) * np.asarray(size)


def skeleton(piece: Piece) -> tuple[Array, float]:
    """Return points (n, 3) in the body's frame and a radius, whose thickened hull contains the
    piece.

    Exact for boxes, spheres, capsules and hulls. A cylinder is represented by its two end
    centres and its radius, which adds the end caps.
    """
    shape = piece.shape
    radius = 0.0
    match shape:
        case Box():
            points = box_corners(shape.size)
        case Cylinder() | Capsule():
            points = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]]) * shape.length
            radius = shape.radius
        case Sphere():
            points, radius = np.zeros((1, 3)), shape.radius
        case Hull():
            points = shape.vertices
    return points @ piece.rotation.T + piece.centre, radius


def farthest_from_point(piece: Piece, point: Array) -> float:
    """Compute the largest distance of the piece's points from a point of the body's frame,
    exact."""
    if isinstance(piece.shape, Cylinder):
        local = np.abs(piece.rotation.T @ (np.asarray(point) - piece.centre))
        radial = np.hypot(local[0], local[1]) + piece.shape.radius
        return float(np.hypot(radial, local[2] + piece.shape.length / 2.0))
    points, radius = skeleton(piece)
    return float(np.max(np.linalg.norm(points - point, axis=1))) + radius


def farthest_from_axis(piece: Piece, point: Array, axis: Array) -> float:
    """Bound the distance of the piece's points from a line (point, unit axis)."""
    points, radius = skeleton(piece)
    arms = points - point
    across = arms - np.outer(arms @ axis, axis)
    return float(np.max(np.linalg.norm(across, axis=1))) + radius


def bounding_box(pieces: tuple[Piece, ...], rotation: Array) -> Piece:
    """Compute the smallest box with the given axes (3, 3, columns) that contains all pieces,
    exact."""
    axes = np.asarray(rotation).T
    upper = np.max([support(piece, axes) for piece in pieces], axis=0)
    lower = -np.max([support(piece, -axes) for piece in pieces], axis=0)
    return Piece(Box(upper - lower), transform(rotation, rotation @ ((upper + lower) / 2.0)))


def edges(pieces: tuple[Piece, ...]) -> Array:
    """Compute the edge lengths (3,), ascending, of the pieces' bounding box along the frame's
    axes [m]."""
    box = bounding_box(pieces, np.eye(3))
    assert isinstance(box.shape, Box)
    return np.asarray(np.sort(box.shape.size))


# --- enclosing pieces ---


def contains(cover: Piece, piece: Piece, tolerance: float = 1e-12) -> bool:
    """Return True if a box or sphere contains a piece, exact up to the tolerance [m] for
    roundoff."""
    match cover.shape:
        case Box():
            axes = cover.rotation.T
            half = np.asarray(cover.shape.size) / 2.0 + tolerance
            middle = axes @ cover.centre
            ahead = support(piece, axes) - middle
            behind = support(piece, -axes) + middle
            return bool(np.all(ahead <= half) and np.all(behind <= half))
        case Sphere():
            return farthest_from_point(piece, cover.centre) <= cover.shape.radius + tolerance
        case _:
            raise CollisionModelError(
                f"containment in a {type(cover.shape).__name__.lower()} cannot be proven; "
                "cover with boxes and spheres",
                code="containment",
            )


@dataclass(frozen=True)
class SphereChain:
    """Equal spheres along the longest side of a bounding box.

    The box contains the pieces and is cut into equal slabs across its longest side; each sphere
    passes through the corners of its slab. So every point of the pieces lies in a slab, and
    every slab in a sphere: that is the proof of containment, which the constructor
    `sphere_chain` checks with exact functions.

    Attributes:
        centres: (n, 3) in the body's frame [m].
        radius: of every sphere [m].
        slabs: the boxes between the bounding box and the spheres.
    """

    centres: Array
    radius: float
    slabs: tuple[Piece, ...]


def sphere_chain(pieces: tuple[Piece, ...], rotation: Array, slenderness: float) -> SphereChain:
    """Cover pieces by a chain of equal spheres.

    Args:
        rotation: (3, 3) axes of the bounding box.
        slenderness: slabs are about this many times as long as the box is wide.

    Raises:
        CollisionModelError: a slab is not inside its sphere or a piece not inside the box.
    """
    box = bounding_box(pieces, rotation)
    assert isinstance(box.shape, Box)
    size = np.asarray(box.shape.size)
    along = int(np.argmax(size))
    width = float(np.max(np.delete(size, along)))
    count = max(1, round(size[along] / (slenderness * width)))
    slab_size = size.copy()
    slab_size[along] /= count
    radius = float(np.linalg.norm(slab_size)) / 2.0
    slabs = []
    for k in range(count):
        offset = np.zeros(3)
        offset[along] = (k + 0.5) * slab_size[along] - size[along] / 2.0
        pose = box.pose.copy()
        pose[:3, 3] += box.rotation @ offset
        slabs.append(Piece(Box(slab_size), pose))
    centres = np.array([slab.centre for slab in slabs])
    spheres = [ball(centre, radius) for centre in centres]
    proven = all(contains(box, piece) for piece in pieces) and all(
        contains(sphere, slab) for sphere, slab in zip(spheres, slabs, strict=True)
    )
    if not proven:
        raise CollisionModelError("a chain of spheres does not contain its pieces")
    return SphereChain(centres, radius, tuple(slabs))


def ball(centre: Array, radius: float) -> Piece:
    """Return a sphere piece."""
    return Piece(Sphere(radius), transform(np.eye(3), centre))


def swept_cylinder(pieces: tuple[Piece, ...], point: Array, axis: Array) -> Piece:
    """Compute a cylinder about a line (point, unit axis) that contains the pieces in every
    rotation.

    The pieces' extent along the axis is exact; the radius errs to the safe side for cylinders.
    """
    radius = max(farthest_from_axis(piece, point, axis) for piece in pieces)
    upper = max(float(support(piece, axis)[0]) for piece in pieces)
    lower = -max(float(support(piece, -np.asarray(axis))[0]) for piece in pieces)
    base = float(np.asarray(axis) @ point)
    middle = point + ((upper + lower) / 2.0 - base) * np.asarray(axis)
    return Piece(Cylinder(radius, upper - lower), transform(axes_with_z(axis), middle))
