"""Simple pieces that enclose others: boxes, balls, chains of spheres, swept cylinders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.pieces import (
    Piece,
    bounding_box,
    farthest_from_axis,
    farthest_from_point,
    support,
)
from symbolic.workcell.records import Box, Cylinder, Sphere


def contains(cover: Piece, piece: Piece, tolerance: float = 1e-12) -> bool:
    """Whether a box or sphere contains a piece. Exact, up to the tolerance [m] for roundoff."""
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
                "cover with boxes and spheres"
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
    """A sphere piece."""
    pose = np.eye(4)
    pose[:3, 3] = centre
    return Piece(Sphere(radius), pose)


def swept_cylinder(pieces: tuple[Piece, ...], point: Array, axis: Array) -> Piece:
    """A cylinder about a line (point, unit axis) that contains the pieces in every rotation.

    The pieces' extent along the axis is exact; the radius errs to the safe side for cylinders.
    """
    radius = max(farthest_from_axis(piece, point, axis) for piece in pieces)
    upper = max(float(support(piece, axis)[0]) for piece in pieces)
    lower = -max(float(support(piece, -np.asarray(axis))[0]) for piece in pieces)
    base = float(np.asarray(axis) @ point)
    pose = np.eye(4)
    pose[:3, :3] = axes_with_z(axis)
    pose[:3, 3] = point + ((upper + lower) / 2.0 - base) * np.asarray(axis)
    return Piece(Cylinder(radius, upper - lower), pose)


def axes_with_z(axis: Array) -> Array:
    """A rotation (3, 3) whose third column is the unit axis."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
