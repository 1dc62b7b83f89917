"""The bodies of a cell as python-fcl objects: the judge of collisions.

Two bodies collide if FCL finds an intersection, or, with a positive tolerance, a distance of at
most the tolerance (`symbolic.geometry.pairs.pair_tolerance`).
"""

from __future__ import annotations

import math

import fcl
import numpy as np

from symbolic.array import Array
from symbolic.geometry.bodies import BOX, CollisionBody
from symbolic.geometry.pairs import CellGeometry, pair_tolerance
from symbolic.geometry.pieces import ConvexShape, Hull, Piece, reach, shrunk
from symbolic.records import PAYLOAD, Box, Capsule, Cylinder, Sphere
from symbolic.records.quantities import SMALLEST_SIZE

FCL_RESOLUTION = 1e-5
"""What FCL resolves [m]: intersections and, downwards, distances; ten times its tolerance."""


class Judge:
    """FCL objects of every piece, moved to a sample's placements when a pair needs them.

    A resource: one per thread.

    Attributes:
        calls: FCL queries made so far.
        resting_shapes: the payload's pieces, smaller by the resting tolerance on every side.
        shrunk_payload: index of a body of these.
    """

    def __init__(self, geometry: CellGeometry, resting_tolerance: float) -> None:
        self._geometry = geometry
        self.calls = 0
        self._request = fcl.CollisionRequest()
        self._nearest = fcl.DistanceRequest(enable_nearest_points=True)
        firsts = np.cumsum([0] + [len(body.pieces) for body in geometry.bodies])
        self._bodies = [
            _Objects(body, int(first))
            for body, first in zip(geometry.bodies, firsts[:-1], strict=True)
        ]
        payload = geometry.index(PAYLOAD)
        smaller = tuple(shrunk(p, resting_tolerance) for p in geometry.bodies[payload].pieces)
        self.resting_shapes = tuple(piece.shape for piece in smaller)
        self.shrunk_payload = len(self._bodies)
        self._bodies.append(
            _Objects(CollisionBody("shrunk payload", "payload", BOX, smaller), int(firsts[payload]))
        )
        self._quaternions = self._positions = np.zeros((0, 0, 0))

    def set_placements(self, quaternions: Array, positions: Array) -> None:
        """Take the pieces' poses (n, n_pieces, 4) and (n, n_pieces, 3) of n samples."""
        self._quaternions, self._positions = quaternions, positions
        for body in self._bodies:
            body.sample = -1

    def collides(self, sample: int, i: int, j: int) -> bool:
        """Whether bodies i and j collide in a sample of the placements; see the module."""
        first, second = self._placed(sample, i), self._placed(sample, j)
        bodies = self._geometry.bodies
        tolerance = pair_tolerance(self._geometry.workcell, bodies[i], bodies[j])
        for a in first:
            for b in second:
                self.calls += 1
                if fcl.collide(a, b, self._request):
                    return True
                if tolerance > 0.0:
                    self.calls += 1
                    if fcl.distance(a, b) <= tolerance:
                        return True
        return False

    def intersects(self, sample: int, i: int, j: int) -> bool:
        """Whether bodies i and j intersect, whatever the tolerance."""
        first, second = self._placed(sample, i), self._placed(sample, j)
        self.calls += len(first) * len(second)
        return any(fcl.collide(a, b, self._request) for a in first for b in second)

    def distance(self, sample: int, i: int, j: int) -> float:
        """FCL's distance of bodies i and j; 0 where they intersect [m].

        At most a few micrometres below the truth, but in rare cases some tenths of a millimetre
        above it: `separation` is the proven bound.
        """
        first, second = self._placed(sample, i), self._placed(sample, j)
        self.calls += len(first) * len(second)
        return max(0.0, min(float(fcl.distance(a, b)) for a in first for b in second))

    def separation(self, sample: int, i: int, j: int) -> float:
        """A distance [m] that bodies i and j surely keep, at most their distance; 0 if unknown.

        FCL's distance may stop early, above the truth. Its nearest points only propose a
        direction here; the gap between the bodies along it is computed from their shapes.
        """
        first, second = self._placed(sample, i), self._placed(sample, j)
        self.calls += len(first) * len(second)
        return min(
            self._gap(a, shape_a, b, shape_b)
            for a, shape_a in zip(first, self._bodies[i].shapes, strict=True)
            for b, shape_b in zip(second, self._bodies[j].shapes, strict=True)
        )

    def _gap(
        self,
        a: fcl.CollisionObject,
        shape_a: ConvexShape,
        b: fcl.CollisionObject,
        shape_b: ConvexShape,
    ) -> float:
        result = fcl.DistanceResult()
        distance = fcl.distance(a, b, self._nearest, result)
        if distance <= 0.0:
            return 0.0
        between = np.subtract(result.nearest_points[1], result.nearest_points[0])
        length = math.sqrt(between @ between)
        if length < SMALLEST_SIZE:
            return 0.0
        u = between / length
        near = u @ a.getTranslation() + _reach(shape_a, u @ a.getRotation())
        far = u @ b.getTranslation() - _reach(shape_b, -u @ b.getRotation())
        return max(0.0, float(far - near))

    def _placed(self, sample: int, index: int) -> list[fcl.CollisionObject]:
        body = self._bodies[index]
        if body.moves and body.sample != sample:
            body.sample = sample
            for k, item in enumerate(body.objects, start=body.first_piece):
                item.setQuatRotation(self._quaternions[sample, k].tolist())
                item.setTranslation(self._positions[sample, k])
        return body.objects


def _reach(shape: ConvexShape, u: Array) -> float:
    """`symbolic.geometry.pieces.reach` along one direction (3,); most shapes are boxes, and asked
    for thousands of times."""
    if isinstance(shape, Box):
        (x, y, z), (a, b, c) = u.tolist(), shape.size.tolist()
        return float(abs(x) * a + abs(y) * b + abs(z) * c) / 2.0
    return float(reach(shape, u[None])[0])


class _Objects:
    """One body's FCL objects and the sample that they are placed for."""

    def __init__(self, body: CollisionBody, first_piece: int) -> None:
        self.moves = body.frame.kind != "world"
        self.first_piece = first_piece
        self.sample = -1
        self.objects = [fcl_object(piece) for piece in body.pieces]
        self.shapes = [piece.shape for piece in body.pieces]


def fcl_object(piece: Piece) -> fcl.CollisionObject:
    """A piece at its pose in its body's frame."""
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
