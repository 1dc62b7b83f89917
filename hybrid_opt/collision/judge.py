"""The bodies of a cell as python-fcl objects: the judge of collisions.

Two bodies collide if FCL finds an intersection, or, with a positive tolerance, a distance of at
most the tolerance.
"""

from __future__ import annotations

from collections.abc import Sequence

import fcl
import numpy as np
from scipy.spatial.transform import Rotation

from symbolic.collision_bodies import CollisionBody, Frame
from symbolic.collision_pairs import CellGeometry
from symbolic.geometry import Capsule, Hull, Piece
from symbolic.workcell import Array, Box, Cylinder, Sphere

FCL_RESOLUTION = 1e-5
"""What FCL resolves [m]: its iterative solvers stop within 1e-6 of the truth; ten times that."""


class Judge:
    """FCL objects of every piece, moved to a sample's placements when a pair needs them.

    A resource: one per thread.

    Attributes:
        calls: FCL queries made so far.
        updates: placements of pieces handed to FCL so far.
    """

    def __init__(self, geometry: CellGeometry, resting_tolerance: float) -> None:
        self.tolerance = geometry.workcell.collision.tolerance
        self.calls = 0
        self.updates = 0
        self._request = fcl.CollisionRequest()
        self._bodies = [_Objects(body) for body in geometry.bodies]
        payload = next(body for body in geometry.bodies if body.group == "payload")
        size = np.asarray(geometry.workcell.payload.size) - 2.0 * resting_tolerance
        shrunk = (Piece(Box(np.maximum(size, 1e-6)), np.eye(4)),)
        self.shrunk_payload = len(self._bodies)
        """Index of the payload made smaller by the resting tolerance on every side."""
        self._bodies.append(
            _Objects(CollisionBody("shrunk payload", "payload", payload.frame, shrunk))
        )

    def set_placements(self, rotations: Array, positions: Array) -> None:
        """Take the moving frames (n, 13, 3, 3) and (n, 13, 3) of n samples."""
        self._positions = positions
        self._rotations = rotations
        for body in self._bodies:
            body.forget()

    def collides(self, sample: int, i: int, j: int) -> bool:
        """Whether bodies i and j collide in a sample of the placements; see the module."""
        first, second = self._placed(sample, i), self._placed(sample, j)
        for a in first:
            for b in second:
                self.calls += 1
                if fcl.collide(a, b, self._request):
                    return True
                if self.tolerance > 0.0:
                    self.calls += 1
                    if fcl.distance(a, b) <= self.tolerance:
                        return True
        return False

    def intersects(self, sample: int, i: int, j: int) -> bool:
        """Whether bodies i and j intersect, whatever the tolerance."""
        first, second = self._placed(sample, i), self._placed(sample, j)
        self.calls += len(first) * len(second)
        return any(fcl.collide(a, b, self._request) for a in first for b in second)

    def distance(self, sample: int, i: int, j: int) -> float:
        """Distance of bodies i and j; 0 where they intersect [m]."""
        first, second = self._placed(sample, i), self._placed(sample, j)
        self.calls += len(first) * len(second)
        return max(0.0, min(fcl.distance(a, b) for a in first for b in second))

    def _placed(self, sample: int, index: int) -> Sequence[fcl.CollisionObject]:
        body = self._bodies[index]
        if body.slot >= 0 and body.sample != sample:
            if body.quaternions is None:
                body.carry(self._rotations[:, body.slot], self._positions[:, body.slot])
            self.updates += len(body.objects)
            body.move(sample)
        return body.objects


class _Objects:
    """One body's FCL objects and, once asked for, their poses in every sample."""

    def __init__(self, body: CollisionBody) -> None:
        self.slot = frame_slot(body.frame)
        self.sample = -1
        self.pieces = body.pieces
        self.objects = [fcl_object(piece) for piece in body.pieces]
        self.quaternions: list[list[list[float]]] | None = None
        self.translations: list[list[Array]] = []

    def forget(self) -> None:
        self.sample, self.quaternions = -1, None

    def carry(self, rotations: Array, positions: Array) -> None:
        """Poses of the pieces in all samples, from the frame's (n, 3, 3) and (n, 3)."""
        quaternions, self.translations = [], []
        for piece in self.pieces:
            turned = Rotation.from_matrix(rotations @ piece.rotation).as_quat()
            quaternions.append(turned[:, [3, 0, 1, 2]].tolist())
            self.translations.append(list(positions + rotations @ piece.centre))
        self.quaternions = quaternions

    def move(self, sample: int) -> None:
        assert self.quaternions is not None
        self.sample = sample
        for item, turned, shifted in zip(
            self.objects, self.quaternions, self.translations, strict=True
        ):
            item.setQuatRotation(turned[sample])
            item.setTranslation(shifted[sample])


def frame_slot(frame: Frame) -> int:
    """Index of a frame among the moving frames of `screening_functions`; -1 for the world."""
    match frame.kind:
        case "world":
            return -1
        case "box":
            return 0
        case "link":
            return 1 + 6 * frame.robot + frame.joint


def fcl_object(piece: Piece) -> fcl.CollisionObject:
    """A piece at its pose in its body's frame."""
    shape = piece.shape
    match shape:
        case Box():
            solid = fcl.Box(*(float(length) for length in shape.size))
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
