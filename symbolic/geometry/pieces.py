"""Convex pieces of bodies, their support functions, and simple shapes that provably enclose them.

A piece is a convex shape at a pose in its body's frame. All proofs of collision checking (lower
bounds of distances, upper bounds of motions) rest on the functions of this file. Each function
states whether it is exact or a bound. Lengths are in m.
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
    """A convex hull.

    Attributes:
        vertices: (n, 3) corners [m].
        faces: (m, 3) indices of the corners of each triangle, oriented outwards.
    """

    vertices: Array
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class CutMesh:
    """A mesh that was decomposed into convex hulls.

    Attributes:
        hulls: convex hulls whose union contains the mesh.
        faces, vertices: numbers of the mesh's triangles and vertices.
        parts: number of the mesh's connected components.
        open_parts: number of components with holes; one hull covers each of them.
    """

    hulls: tuple[Hull, ...]
    faces: int
    vertices: int
    parts: int
    open_parts: int


ConvexShape = Box | Cylinder | Sphere | Capsule | Hull


@dataclass(frozen=True)
class Piece:
    """A convex shape at a pose in its body's frame.

    Attributes:
        shape: the shape.
        pose: (4, 4) from the shape's frame to the body's frame.
    """

    shape: ConvexShape
    pose: Array

    def __post_init__(self) -> None:
        pose = np.array(self.pose, dtype=float)
        pose.setflags(write=False)
        object.__setattr__(self, "pose", pose)

    @cached_property
    def centre(self) -> Array:
        """(3,) origin of the shape's frame in the body's frame [m]."""
        return self.pose[:3, 3]

    @cached_property
    def rotation(self) -> Array:
        """(3, 3) axes of the shape's frame in the body's frame, as columns."""
        return self.pose[:3, :3]

    def moved(self, T: Array) -> Piece:
        """Return the piece in another frame.

        Args:
            T: (4, 4) from the body's frame to the other frame.
        """
        return Piece(self.shape, T @ self.pose)


def check_piece(piece: Piece, owner: str) -> None:
    """Check that a piece has a finite size, at least `SMALLEST_SIZE`, and a valid pose.

    Args:
        piece: the piece.
        owner: name of its body, for messages.

    Raises:
        CollisionModelError: the size or pose is not valid.
    """
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
    """Compute how far a piece extends along directions u: the largest u . x of its points x [m],
    exact.

    Args:
        piece: the piece.
        directions: (n, 3) directions u in the body's frame.

    Returns:
        (n,) one value per direction.
    """
    u = np.atleast_2d(directions)
    return np.asarray(u @ piece.centre + reach(piece.shape, u @ piece.rotation), dtype=float)


def reach(shape: ConvexShape, directions: Array) -> Array:
    """Compute how far a shape extends along directions u: the largest u . x of its points x [m],
    exact.

    Args:
        shape: the shape.
        directions: (n, 3) directions u in the shape's own frame.

    Returns:
        (n,) one value per direction.
    """
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
    """Return a piece made smaller by a length on every side, but not below a minimum size.

    The faces of a hull move inwards by at least this length.

    Args:
        piece: the piece.
        by: the length [m].
    """
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
    """Return the corners (8, 3) of a box about the origin with edge lengths `size` (3,) [m]."""
    return np.array(list(product((-0.5, 0.5), repeat=3))) * np.asarray(size)


def skeleton(piece: Piece) -> tuple[Array, float]:
    """Describe a piece by points (n, 3) in the body's frame and a radius [m]. The points' convex
    hull, thickened by the radius, contains the piece; it equals the piece except for cylinders,
    which get caps like a capsule."""
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
    """Compute the largest distance [m] of a piece's points from a point (3,) in the body's frame;
    exact.
    """
    if isinstance(piece.shape, Cylinder):
        local = np.abs(piece.rotation.T @ (np.asarray(point) - piece.centre))
        radial = np.hypot(local[0], local[1]) + piece.shape.radius
        return float(np.hypot(radial, local[2] + piece.shape.length / 2.0))
    points, radius = skeleton(piece)
    return float(np.max(np.linalg.norm(points - point, axis=1))) + radius


def farthest_from_axis(piece: Piece, point: Array, axis: Array) -> float:
    """Compute an upper bound of the distance of a piece's points from a line [m].

    Args:
        piece: the piece.
        point: (3,) a point of the line in the body's frame [m].
        axis: (3,) unit vector along the line.
    """
    points, radius = skeleton(piece)
    arms = points - point
    across = arms - np.outer(arms @ axis, axis)
    return float(np.max(np.linalg.norm(across, axis=1))) + radius


def bounding_box(pieces: tuple[Piece, ...], rotation: Array) -> Piece:
    """Compute the smallest box with given axes that contains all pieces; exact.

    Args:
        pieces: pieces in one frame.
        rotation: (3, 3) axes of the box in this frame, as columns.
    """
    axes = np.asarray(rotation).T
    upper = np.max([support(piece, axes) for piece in pieces], axis=0)
    lower = -np.max([support(piece, -axes) for piece in pieces], axis=0)
    return Piece(Box(upper - lower), transform(rotation, rotation @ ((upper + lower) / 2.0)))


def edges(pieces: tuple[Piece, ...]) -> Array:
    """Compute the edge lengths (3,) of the bounding box of pieces along their common frame's axes,
    in ascending order [m]."""
    box = bounding_box(pieces, np.eye(3))
    assert isinstance(box.shape, Box)
    return np.asarray(np.sort(box.shape.size))


# --- enclosing pieces ---


def contains(cover: Piece, piece: Piece, tolerance: float = 1e-12) -> bool:
    """Return True if a box or sphere contains a piece; exact.

    Args:
        cover: the box or sphere.
        piece: the piece, in the same frame.
        tolerance: allowance for roundoff [m].

    Raises:
        CollisionModelError: the cover is neither a box nor a sphere.
    """
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
    """Equal spheres in a row that contain the pieces of a body.

    The bounding box of the pieces is cut into equal slabs across its longest side. Each sphere
    passes through the corners of one slab, so it contains the slab. `sphere_chain` checks that the
    box contains the pieces and each sphere its slab.

    Attributes:
        centres: (n, 3) centres of the spheres in the body's frame [m].
        radius: radius of every sphere [m].
        slabs: the n slabs of the bounding box.
    """

    centres: Array
    radius: float
    slabs: tuple[Piece, ...]


def sphere_chain(pieces: tuple[Piece, ...], rotation: Array, slenderness: float) -> SphereChain:
    """Cover pieces by a row of equal spheres along the longest side of their bounding box. The box
    is cut into slabs across this side, and each sphere contains one slab.

    Args:
        pieces: pieces in one frame.
        rotation: (3, 3) axes of the bounding box in this frame, as columns.
        slenderness: approximate ratio of a slab's length along the row to the larger of its other
            two sides.

    Raises:
        CollisionModelError: a slab is not inside its sphere, or a piece not inside the box.
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
    """Return a sphere as a piece, with its centre (3,) and radius [m] in the body's frame."""
    return Piece(Sphere(radius), transform(np.eye(3), centre))


def swept_cylinder(pieces: tuple[Piece, ...], point: Array, axis: Array) -> Piece:
    """Compute a cylinder about a line that contains the pieces at every rotation about the line.

    The length of the cylinder is exact. The radius is exact too, except for cylinders among the
    pieces, for which it is an upper bound.

    Args:
        pieces: pieces in one frame.
        point: (3,) a point of the line [m].
        axis: (3,) unit vector along the line.
    """
    radius = max(farthest_from_axis(piece, point, axis) for piece in pieces)
    upper = max(float(support(piece, axis)[0]) for piece in pieces)
    lower = -max(float(support(piece, -np.asarray(axis))[0]) for piece in pieces)
    base = float(np.asarray(axis) @ point)
    middle = point + ((upper + lower) / 2.0 - base) * np.asarray(axis)
    return Piece(Cylinder(radius, upper - lower), transform(axes_with_z(axis), middle))
