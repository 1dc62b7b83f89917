"""Collision verdicts on candidates, by compiled bounds and proofs first, and FCL for the other
pairs.

Two bodies collide if FCL finds an intersection, or if their distance is at most the tolerance.
Bounds and proofs decide only pairs whose distance differs from the tolerance by more than FCL's
resolution, so they do not change any verdict. Near contact FCL alone decides.

A lower bound of a distance is the gap between both bodies along a direction that Coal's GJK
algorithm proposes. The bound never exceeds the distance, even if the algorithm does not converge;
if it converges, the bound is within 1e-8 m of the distance. An upper bound below zero is minus the
radius of a ball inside the Minkowski difference, so the bodies intersect at least that deep. The
distances of FCL may exceed the true ones by tenths of a millimetre; they are not used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import fcl
import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.collision.joint_tables import JointTable, joint_tables
from hybrid_opt.collision.solids import compiled_distances, fcl_object, shape_table
from symbolic.array import Array
from symbolic.geometry.bodies import BOX, CollisionBody
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import shrunk
from symbolic.records import PAYLOAD_NAME

INTERSECTING, OPEN, APART = -1, 0, 1
"""Verdicts of `BodyDistances.decide`: proven to intersect, not proven, proven to be apart."""

FCL_RESOLUTION = 1e-5
"""Depth of intersection that FCL resolves [m]; ten times its tolerance."""

RESTING_TOLERANCE = 1e-3
"""Depth to which the payload may penetrate a body that it may rest on [m]."""

PROOF_MARGIN = 5 * FCL_RESOLUTION
"""Distance, or depth of intersection, from which a pair is decided without FCL [m]."""

MEASURED_TOGETHER = 64
"""Number of pairs that `CollisionChecker.min_distance` measures in one step."""


@dataclass(frozen=True)
class CollidingPair:
    """Two bodies that collide, or that are too near for a proof that they do not.

    Attributes:
        sample: index of the sample at which they collide, or of the sample before.
        first, second: names of the bodies.
        fraction: share of the way from this sample (0) to the next one (1).
    """

    sample: int
    first: str
    second: str
    fraction: float = 0.0

    def __str__(self) -> str:
        return f"{self.first} meets {self.second}"


@dataclass(frozen=True)
class Verdict:
    """The collisions of one candidate.

    Attributes:
        colliding: (n,) True for samples in collision.
        first_touch: the earliest collision, or None.
    """

    colliding: NDArray[np.bool_]
    first_touch: CollidingPair | None

    @property
    def is_free(self) -> bool:
        """True if no sample collides."""
        return self.first_touch is None


class CollisionChecker:
    """Collision checker for the candidates of one workcell. Threads must not share one.

    Attributes:
        geometry: the workcell's bodies and pairs.
        distances: distance queries of these bodies.
        judge: FCL objects of these bodies.
        functions: functions by name of `symbolic.geometry.clearance.screening_functions`, compiled
            or interpreted.
        free_beyond: (n_pairs,) distance [m]; a pair of bodies is free if the lower bound of its
            distance exceeds it.
        resting_places: positions at which the payload may rest on a body of the environment, one
            for each allowed contact and fixed pose that touches the body: index of the pair, box
            centre (3,) [m], and departure [m].
    """

    def __init__(self, geometry: CellGeometry, functions: Mapping[str, NumericFunction]) -> None:
        self.geometry, self.functions = geometry, functions
        self.distances = BodyDistances(geometry, RESTING_TOLERANCE)
        self.judge = Judge(self.distances)
        self._place = functions["piece_poses"].batch
        self.free_beyond = geometry.tolerance + FCL_RESOLUTION
        self._pairs = np.array([(p.first, p.second) for p in geometry.active]).reshape(-1, 2)
        self._names, self._parts = geometry.pair_names, (6, 6 + geometry.arms[0].joints)
        self.resting_places = self._find_resting()

    def split(self, configuration: Array) -> tuple[Array, Array, Array]:
        """Split configurations into box poses (n, 6) and the joints (n, joints) of the first and
        the second arm, each contiguous.

        Args:
            configuration: (n, 6 + all joints) configurations.
        """
        parts = np.split(configuration, self._parts, axis=1)
        first, second, third = map(np.ascontiguousarray, parts)
        return first, second, third

    def bounds(self, pose: Array, q_1: Array, q_2: Array) -> Array:
        """Compute a lower bound (n, n_pairs) [m] of the distance of every pair of bodies that is
        checked.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions [rad].
        """
        asked = [self.functions[f"{block}clearance"] for block in self.geometry.asked]
        parts = [function.batch(pose, q_1, q_2)["clearance"] for function in asked]
        found = np.column_stack(parts).take(self.geometry.columns, axis=1)
        for table in self.tables:
            tabulated = table.look_up((q_1, q_2)[table.robot])
            found[:, table.pair] = np.fmax(found[:, table.pair], tabulated)
        return found

    @cached_property
    def tables(self) -> tuple[JointTable, ...]:
        """For some pairs of bodies, a table of lower bounds of their distance over the positions of
        two joints."""
        return joint_tables(self.geometry)

    def check(self, pose: Array, q_1: Array, q_2: Array, clearance: Array | None = None) -> Verdict:
        """Check n samples for collisions.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions [rad].
            clearance: (n, n_pairs) lower bounds of the distances of checked pairs [m]; None to
                compute them.
        """
        if clearance is None:
            clearance = self.bounds(pose, q_1, q_2)
        colliding = np.zeros(len(pose), dtype=bool)
        # `not >` keeps a NaN bound open.
        rows, pairs = np.nonzero(~(clearance > self.free_beyond))
        if not len(rows):
            return Verdict(colliding, None)
        # The pair that is named is the one with the least bound.
        order = np.lexsort((clearance[rows, pairs], rows))
        rows, pairs = rows[order], pairs[order]
        hits = self.collisions(pose, q_1, q_2, rows, pairs)
        colliding[rows[hits]] = True
        first = None
        if hits.any():
            k = int(np.argmax(hits))
            first = CollidingPair(int(rows[k]), *self._names[pairs[k]])
        return Verdict(colliding, first)

    def collisions(
        self,
        pose: Array,
        q_1: Array,
        q_2: Array,
        rows: NDArray[np.intp],
        pairs: NDArray[np.intp],
    ) -> NDArray[np.bool_]:
        """Decide whether pairs of bodies collide, for m queries of one pair at one sample each.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions [rad].
            rows: (m,) index of the sample of each query, increasing.
            pairs: (m,) index of the checked pair of each query.

        Returns:
            (m,) True for pairs that collide.
        """
        samples, rows = np.unique(rows, return_inverse=True)
        pose = pose[samples]
        placed = self._place(pose, q_1[samples], q_2[samples])
        return self._decide(placed, rows, pairs, self._resting(pose, rows, pairs))

    def penetrates(self, pose: Array, pair: int) -> bool:
        """Return True if the box penetrates a body of the environment deeper than
        `RESTING_TOLERANCE`.

        Args:
            pose: (6,) box pose [m, rad].
            pair: index of the checked pair of payload and body.
        """
        placed = self._place(pose[None], *self._still())
        zero = np.zeros(1, dtype=np.intp)
        return bool(self._decide(placed, zero, zero + pair, np.ones(1, dtype=bool))[0])

    def motion(
        self, start: tuple[Array, Array, Array], end: tuple[Array, Array, Array]
    ) -> tuple[Array, Array]:
        """Compute bounds of the relative motion of the two bodies of every pair between two
        configurations.

        Args:
            start, end: each a box pose (n, 6) [m, rad] and joint positions q_1 and q_2 (n, joints)
                [rad].

        Returns:
            Chord and bend (n, n_pairs) [m] of n motions that are linear in box pose and joints over
            s from 0 (start) to 1 (end). The chord bounds the distance between the relative
            positions at s = 0 and s = 1. The bend bounds the second derivative of the relative
            position with respect to s (`symbolic.geometry.clearance`).
        """
        asked = [self.functions[f"{block}motion"] for block in self.geometry.asked]
        found = [function.batch(*start, *end) for function in asked]
        chord, bend = (
            np.column_stack([part[name] for part in found]).take(self.geometry.columns, axis=1)
            for name in ("chord", "bend")
        )
        return chord, bend

    def measure(
        self, pose: Array, q_1: Array, q_2: Array, clearance: Array, wanted: NDArray[np.bool_]
    ) -> NDArray[np.intp]:
        """Replace lower bounds of chosen pairs by measured distances, in place.

        A bound that is larger than the measured distance stays. If the payload may rest on the
        other body of a pair, the measurement uses the payload shrunk by the resting tolerance, and
        the cell's collision tolerance for the pair is added to the distance.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions [rad].
            clearance: (n, n_pairs) lower bounds [m], raised in place.
            wanted: (n, n_pairs) True for the pairs to be measured.

        Returns:
            (n,) index of the first chosen pair that collides at each sample, or -1. The bound of a
            colliding pair stays.
        """
        hits = np.full(len(pose), -1)
        rows, pairs = np.nonzero(wanted)
        if not len(rows):
            return hits
        samples, local = np.unique(rows, return_inverse=True)
        placed = self._place(pose[samples], q_1[samples], q_2[samples])
        resting = self._resting(pose[samples], local, pairs)
        lower, _ = self.distances.bounds(placed, local, *self._bodies(pairs, resting))
        apart = np.maximum(lower, 0.0) + np.where(resting, self.geometry.tolerance[pairs], 0.0)
        near = apart <= self.free_beyond[pairs]
        hit = np.zeros(len(rows), dtype=bool)
        if near.any():
            hit[near] = self._decide(placed, local[near], pairs[near], resting[near])
        hits[rows[hit][::-1]] = pairs[hit][::-1]
        free = ~hit
        rows, pairs = rows[free], pairs[free]
        clearance[rows, pairs] = np.fmax(clearance[rows, pairs], apart[free])
        return hits

    def violates_clearance(
        self, configuration: Array, wanted: NDArray[np.bool_], required: Array
    ) -> NDArray[np.bool_]:
        """Find pairs that are provably closer than required.

        Args:
            configuration: (n, 6 + all joints) box poses and joints of both arms.
            wanted: (n, n_pairs) True for the pairs to be tested.
            required: (n, n_pairs) required distances [m].

        Returns:
            (n, n_pairs) True for tested pairs that are closer. False where the payload may rest on
            the body.
        """
        found = np.zeros(wanted.shape, dtype=bool)
        rows, pairs = np.nonzero(wanted)
        if len(rows):
            samples, local = np.unique(rows, return_inverse=True)
            pose, q_1, q_2 = self.split(configuration[samples])
            _, upper = self._bounds_of_pairs(self._place(pose, q_1, q_2), local, pairs)
            near = upper <= required[rows, pairs] - FCL_RESOLUTION
            found[rows, pairs] = near & ~self._resting(pose, local, pairs)
        return found

    def min_distance(self, pose: Array, q_1: Array, q_2: Array, clearance: Array) -> float:
        """Find the least distance over all pairs and samples [m]; 0 if bodies intersect.

        Pairs are measured in the order of their lower bounds, until no bound is below the least
        distance found.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions [rad].
            clearance: (n, n_pairs) lower bounds [m].
        """
        placed = self._place(pose, q_1, q_2)
        order = np.argsort(clearance, axis=None, kind="stable")
        best = np.inf
        for start in range(0, len(order), MEASURED_TOGETHER):
            some = order[start : start + MEASURED_TOGETHER]
            if clearance.flat[some[0]] > best:
                break
            _, upper = self._bounds_of_pairs(placed, *np.divmod(some, len(self._pairs)))
            best = min(best, float(upper.min()))
        return max(best, 0.0)

    def _still(self) -> tuple[Array, Array]:
        """Return placeholder joint positions (1, joints) of both arms, for computations that depend
        on the box alone.
        """
        first, second = (np.zeros((1, arm.joints)) for arm in self.geometry.arms)
        return first, second

    def _bodies(
        self, pairs: NDArray[np.intp], resting: NDArray[np.bool_]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the indices (m,) of the first and of the second body of each pair of bodies.

        Args:
            pairs: (m,) indices of checked pairs.
            resting: (m,) True where the shrunk payload replaces the payload.
        """
        first, second = self._pairs[pairs].T
        return np.where(resting, self.distances.shrunk_payload, first), second

    def _bounds_of_pairs(
        self, placed: Mapping[str, Array], rows: NDArray[np.intp], pairs: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        return self.distances.bounds(placed, rows, *self._pairs[pairs].T)

    def _decide(
        self,
        placed: Mapping[str, Array],
        rows: NDArray[np.intp],
        pairs: NDArray[np.intp],
        resting: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Decide for m queries, each of one pair of bodies at one sample, whether the pair
        collides.

        Bounds of the distance decide where they suffice, else the library FCL.

        Args:
            placed: outputs of the function `piece_poses`, the poses of all convex solids.
            rows: (m,) index of the sample of each query.
            pairs: (m,) index of the checked pair of each query.
            resting: (m,) True where the payload may rest on the body.

        Returns:
            (m,) True for pairs that collide.
        """
        first, second = self._bodies(pairs, resting)
        # A resting payload may come nearer than the tolerance; it only must not intersect.
        tolerance = np.where(resting, 0.0, self.geometry.tolerance[pairs])
        verdicts = self.distances.decide(
            placed, rows, first, second, PROOF_MARGIN + tolerance, PROOF_MARGIN - tolerance
        )
        hits: NDArray[np.bool_] = verdicts == INTERSECTING
        left = np.flatnonzero(verdicts == OPEN)
        if not len(left):
            return hits
        _, upper = self.distances.bounds(placed, rows[left], first[left], second[left])
        for k, distance in zip(left.tolist(), upper.tolist(), strict=True):
            hits[k] = tolerance[k] > 0.0 and distance <= tolerance[k]
            hits[k] |= self.judge.intersects(placed, int(rows[k]), int(first[k]), int(second[k]))
        return hits

    def _resting(
        self, pose: Array, rows: NDArray[np.intp], pairs: NDArray[np.intp]
    ) -> NDArray[np.bool_]:
        """Find the queries, each for one pair of bodies at one sample, in which the box may rest on
        the other body of the pair.

        Args:
            pose: (n, 6) box poses [m, rad].
            rows: (m,) index of the sample of each query.
            pairs: (m,) index of the checked pair of each query.

        Returns:
            (m,) True for these queries.
        """
        found = np.zeros(len(pairs), dtype=bool)
        for pair, place, departure in self.resting_places:
            near = np.linalg.norm(pose[:, :3] - place, axis=1) <= departure
            found |= (pairs == pair) & near[rows]
        return found

    def _find_resting(self) -> list[tuple[int, Array, float]]:
        """Find the box positions at which the payload may rest on a body.

        Returns:
            For each position, as in `resting_places`: index of the pair of payload and body, box
            centre (3,) [m] in the world, and departure [m] (distance from this centre within which
            the payload may touch the body).
        """
        task = self.geometry.workcell.task
        pairs = {names: k for k, names in enumerate(self._names)}
        found = []
        zero = np.zeros(1, dtype=np.intp)
        for allowed in task.allowed_contacts:
            pair = pairs.get((PAYLOAD_NAME, allowed.body))
            if pair is None:
                continue
            for waypoint in task.waypoints:
                if not waypoint.is_fixed:
                    continue
                placed = self._place(waypoint.lower[None], *self._still())
                _, upper = self._bounds_of_pairs(placed, zero, zero + pair)
                if upper[0] <= self.geometry.tolerance[pair] + RESTING_TOLERANCE:
                    found.append((pair, waypoint.lower[:3], allowed.departure))
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
            apart: (m,) least distance that counts as apart [m].
            overlap: (m,) least depth of intersection that counts as intersecting [m]. With a
                negative value bodies count as intersecting if they are closer than its magnitude.

        Returns:
            (m,) `APART` or `INTERSECTING` if that is proven, else `OPEN`.
        """
        at = placed["quaternions"], placed["positions"]
        found: NDArray[np.int8] = self.native.decide(*at, rows, first, second, apart, overlap)
        return found


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
