"""Pieces as shapes of Coal, the collision library that comes with Pinocchio.

Used to sort pairs when a cell is read, and as an independent judge in the tests; the verdict on
candidates is python-fcl's.
"""

from __future__ import annotations

from functools import cache

import coal
import numpy as np

from symbolic.geometry.pieces import Capsule, Hull, Piece
from symbolic.workcell.records import Box, Cylinder, Sphere


def coal_geometry(piece: Piece) -> tuple[coal.CollisionGeometry, coal.Transform3s]:
    """A piece as a Coal shape at its pose in the body's frame."""
    pose = coal.Transform3s(piece.rotation, piece.centre)
    shape = piece.shape
    match shape:
        case Box():
            return coal.Box(np.asarray(shape.size)), pose
        case Cylinder():
            return coal.Cylinder(shape.radius, shape.length), pose
        case Sphere():
            return coal.Sphere(shape.radius), pose
        case Capsule():
            return coal.Capsule(shape.radius, shape.length), pose
        case Hull():
            return _convex(shape), pose


@cache
def _convex(hull: Hull) -> coal.CollisionGeometry:
    points = coal.StdVec_Vec3s()
    points.extend([np.asarray(vertex) for vertex in hull.vertices])
    return coal.Convex.convexHull(points, False, "")


def coal_distance(first: tuple[Piece, ...], second: tuple[Piece, ...]) -> float:
    """Least distance between two sets of pieces in one frame; negative where they overlap."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    left, right = [coal_geometry(p) for p in first], [coal_geometry(p) for p in second]
    distances = []
    for a, T_a in left:
        for b, T_b in right:
            result.clear()
            distances.append(coal.distance(a, T_a, b, T_b, request, result))
    return float(min(distances))
