"""The bodies of a cell as python-fcl objects, for collision verdicts.

FCL decides pairs that are closer to contact than its resolution (`hybrid_opt.collision.checker`).
Its distances may exceed the true ones by tenths of a millimetre; distances come from Coal
(`hybrid_opt.collision.distances`).
"""

from __future__ import annotations

from collections.abc import Mapping

import fcl
import numpy as np

from hybrid_opt.collision.distances import BodyDistances
from symbolic.array import Array
from symbolic.geometry.pieces import Hull, Piece
from symbolic.records import Box, Capsule, Cylinder, Sphere

FCL_RESOLUTION = 1e-5
"""What FCL resolves of an intersection [m]; ten times its tolerance."""


class Judge:
    """FCL objects of every piece.

    A resource: one per thread.

    Attributes:
        calls: FCL queries made so far.
    """

    def __init__(self, distances: BodyDistances) -> None:
        """Prepare the objects of the same bodies."""
        self.calls = 0
        self._request = fcl.CollisionRequest()
        self._objects = [[fcl_object(p) for p in body.pieces] for body in distances.bodies]
        self._poses = np.split(distances.poses, distances.first_piece[1:-1])

    def intersects(self, placed: Mapping[str, Array], sample: int, i: int, j: int) -> bool:
        """Return True if FCL finds an intersection of bodies i and j.

        Args:
            placed: outputs of the function `piece_poses`.
            sample: index of a sample of these.
        """
        first, second = (self._placed(placed, sample, body) for body in (i, j))
        self.calls += len(first) * len(second)
        return any(fcl.collide(a, b, self._request) for a in first for b in second)

    def _placed(
        self, placed: Mapping[str, Array], sample: int, body: int
    ) -> list[fcl.CollisionObject]:
        for item, pose in zip(self._objects[body], self._poses[body], strict=True):
            item.setQuatRotation(placed["quaternions"][sample, pose].tolist())
            item.setTranslation(placed["positions"][sample, pose])
        return self._objects[body]


def fcl_object(piece: Piece) -> fcl.CollisionObject:
    """Convert a piece, at its pose in its body's frame."""
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
