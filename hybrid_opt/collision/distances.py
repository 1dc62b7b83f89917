"""Proven distances between the bodies of a cell (with Coal), and collision verdicts of FCL.

A lower bound of a distance is the gap between both bodies along a direction that Coal's GJK
algorithm proposes. The bound never exceeds the distance, even if the algorithm does not converge;
if it converges, the bound is within 1e-8 m of the distance. An upper bound below zero is minus the
radius of a ball inside the Minkowski difference, so the bodies intersect at least that deep.

FCL decides pairs that are closer to contact than FCL's resolution
(`hybrid_opt.collision.checker`). The distances of FCL may exceed the true ones by tenths of a
millimetre.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import coal  # loads the library that the compiled module needs
import fcl
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.extension import compiled_module, require_same_minor
from symbolic.geometry.bodies import BOX, CollisionBody
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import ConvexShape, Hull, Piece, shrunk
from symbolic.records import PAYLOAD_NAME, Box, Capsule, Cylinder, Sphere

INTERSECTING, OPEN, APART = -1, 0, 1
"""Verdicts of `BodyDistances.decide`: proven to intersect, not proven, proven to be apart."""

FCL_RESOLUTION = 1e-5
"""Depth of intersection that FCL resolves [m]; ten times its tolerance."""


@cache
def compiled_distances() -> Any:
    """Load the C++ extension module of distances.

    Raises:
        BridgeError: the module is missing, cannot be loaded, or was compiled against another Coal.
    """
    name = "hybrid_opt.collision._distances"
    found = compiled_module(name, "the compiled part of collision checking")
    require_same_minor({"coal": found.COAL_VERSION}, {"coal": coal.__version__})
    return found


class BodyDistances:
    """Distance queries of many pairs of bodies at many poses in one call.

    A query starts from the direction that the previous query of the same pair found, so queries in
    the order of the samples are fastest. Threads may share one object.

    Attributes:
        bodies: bodies of the geometry, then the payload shrunk by the resting tolerance.
        first_piece: (n_bodies + 1,) index of the first piece (convex solid) of each body among all
            pieces.
        poses: (n_pieces,) index of each piece's pose in the output of the function `piece_poses`.
        shrunk_payload: index of the shrunk payload in `bodies`.
        native: the object of the C++ module; C code passes its `address` to `decide_pair`.
    """

    def __init__(self, geometry: CellGeometry, resting_tolerance: float) -> None:
        """Build the shapes of all bodies, and of the payload made smaller, for distance queries.

        Args:
            geometry: bodies of the workcell.
            resting_tolerance: distance by which the shrunk payload is smaller on every side [m].
        """
        payload = geometry.index(PAYLOAD_NAME)
        smaller = tuple(shrunk(p, resting_tolerance) for p in geometry.bodies[payload].pieces)
        resting = CollisionBody("shrunk payload", "payload", BOX, smaller)
        self.bodies = (*geometry.bodies, resting)
        self.shrunk_payload = len(geometry.bodies)
        counts = [len(body.pieces) for body in self.bodies]
        self.first_piece = np.concatenate([[0], np.cumsum(counts)])
        self.poses = np.arange(self.first_piece[-1])
        self.poses[self.first_piece[-2] :] = self.first_piece[payload] + np.arange(len(smaller))
        shapes = [piece.shape for body in self.bodies for piece in body.pieces]
        self.native = compiled_distances().Bodies(
            *shape_table(shapes), self.first_piece, self.poses
        )

    def bounds(
        self,
        placed: Mapping[str, Array],
        rows: NDArray[np.intp],
        first: NDArray[np.intp],
        second: NDArray[np.intp],
    ) -> tuple[Array, Array]:
        """Compute lower and upper bounds of the distances of m pairs of bodies.

        Args:
            placed: outputs of the function `piece_poses` for n samples.
            rows: (m,) index of the sample of each query.
            first, second: (m,) indices of the two bodies of each query in `bodies`.

        Returns:
            Lower and upper bounds (m,) [m]. Both are negative if the bodies intersect. They are
            -inf and inf at a pose that is not finite.
        """
        at = placed["quaternions"], placed["positions"]
        lower, upper = self.native.distances(*at, rows, first, second)
        return lower, upper

    def decide(
        self,
        placed: Mapping[str, Array],
        rows: NDArray[np.intp],
        first: NDArray[np.intp],
        second: NDArray[np.intp],
        apart: Array,
        overlap: Array,
    ) -> NDArray[np.int8]:
        """Try to prove for m pairs of bodies that they are apart, or that they intersect.

        Args:
            placed: outputs of the function `piece_poses` for n samples.
            rows: (m,) index of the sample of each query.
            first, second: (m,) indices of the two bodies of each query in `bodies`.
            apart: (m,) `APART` proves a distance above this value [m].
            overlap: (m,) `INTERSECTING` proves a depth of intersection above this value [m]. If the
                value is negative, it proves a distance below minus the value.

        Returns:
            (m,) `APART`, `INTERSECTING`, or `OPEN` if neither is proven.
        """
        at = placed["quaternions"], placed["positions"]
        found: NDArray[np.int8] = self.native.decide(*at, rows, first, second, apart, overlap)
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


# --- FCL ---


class Judge:
    """FCL objects of every convex solid of the bodies. Each thread needs its own.

    Attributes:
        calls: number of FCL queries so far.
    """

    def __init__(self, distances: BodyDistances) -> None:
        """Create FCL objects of all bodies.

        Args:
            distances: distance queries, which hold the bodies.
        """
        self.calls = 0
        self._request = fcl.CollisionRequest()
        self._objects = [[fcl_object(p) for p in body.pieces] for body in distances.bodies]
        self._poses = np.split(distances.poses, distances.first_piece[1:-1])

    def intersects(self, placed: Mapping[str, Array], sample: int, i: int, j: int) -> bool:
        """Return True if FCL finds that bodies i and j intersect.

        Args:
            placed: outputs of the function `piece_poses`.
            sample: index of the sample in `placed`.
            i, j: indices of the bodies.
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
