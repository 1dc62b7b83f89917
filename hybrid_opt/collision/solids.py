"""Convex solids of collision bodies as objects of the libraries that measure them: Coal, for
proven distances, and FCL, for verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import coal  # loads the library that the compiled module needs
import fcl
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.extension import compiled_module, require_same_minor
from symbolic.geometry.pieces import ConvexShape, Hull, Piece
from symbolic.records import Box, Capsule, Cylinder, Sphere


@cache
def compiled_distances() -> Any:
    """Load the C++ extension module of distances.

    Raises:
        BridgeError: the module is missing, cannot be loaded, or was compiled with another version
            of the library Coal.
    """
    name = "hybrid_opt.collision._distances"
    found = compiled_module(name, "the compiled part of collision checking")
    require_same_minor({"coal": found.COAL_VERSION}, {"coal": coal.__version__})
    return found


def shape_table(
    shapes: Sequence[ConvexShape],
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array]:
    """Convert n shapes to the first four arguments of the C++ class `Bodies`.

    These are kinds (n,), sizes (n, 3) [m], numbers of corners (n,), and the corners (m, 3) of all
    hulls [m]; `distances.cpp` defines kinds and sizes.
    """
    kinds, sizes = zip(*(_measures(shape) for shape in shapes), strict=True)
    corners = [s.vertices if isinstance(s, Hull) else np.zeros((0, 3)) for s in shapes]
    counts = np.array([len(each) for each in corners])
    return np.array(kinds), np.array(sizes), counts, np.concatenate(corners)


def _measures(shape: ConvexShape) -> tuple[int, tuple[float, float, float]]:
    """Return the kind and the sizes of a convex shape in the form that `distances.cpp` takes.

    Returns:
        Number of the kind of shape: 0 for a box, 1 cylinder, 2 sphere, 3 capsule, 4 convex hull;
        then three sizes [m]: half lengths of a box; radius and half length of a cylinder or
        capsule; radius of a sphere. Sizes that a shape does not have are 0.
    """
    match shape:
        case Box():
            x, y, z = (float(length) / 2.0 for length in shape.size)
            return 0, (x, y, z)
        case Cylinder():
            return 1, (shape.radius, shape.length / 2.0, 0.0)
        case Sphere():
            return 2, (shape.radius, 0.0, 0.0)
        case Capsule():
            return 3, (shape.radius, shape.length / 2.0, 0.0)
        case Hull():
            return 4, (0.0, 0.0, 0.0)


def fcl_object(piece: Piece) -> fcl.CollisionObject:
    """Convert a convex solid of a body to an FCL object at its pose in the frame of the body."""
    shape = piece.shape
    match shape:
        case Box():
            solid = fcl.Box(*shape.size.tolist())
        case Cylinder():
            solid = fcl.Cylinder(shape.radius, shape.length)
        case Sphere():
            solid = fcl.Sphere(shape.radius)
        case Capsule():
            solid = fcl.Capsule(shape.radius, shape.length)
        case Hull():
            counted = np.column_stack([np.full(len(shape.faces), 3), shape.faces])
            solid = fcl.Convex(np.array(shape.vertices), len(shape.faces), counted.ravel())
    pose = fcl.Transform(np.array(piece.rotation), np.array(piece.centre))
    return fcl.CollisionObject(solid, pose)
