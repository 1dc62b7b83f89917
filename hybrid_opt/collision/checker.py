"""The collision verdict on a candidate: compiled bounds first, FCL where they leave it open.

One rule on both sides of the tolerance: bodies collide if their distance is at most the
tolerance, as FCL finds it. The bounds may only call a pair free beyond the tolerance by more
than FCL's own resolution, so near the tolerance FCL alone decides, screened or not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.collision.judge import FCL_RESOLUTION, Judge
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry
from symbolic.records import PAYLOAD


@dataclass(frozen=True)
class Touch:
    """Two bodies in collision, or that come too near to prove that they are not.

    Attributes:
        sample: index of the sample, or of the one before.
        first, second: names of the bodies.
        fraction: how far from the sample to the next, 0 to 1.
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
        colliding: (n,) samples in collision.
        first_touch: the earliest collision, or None.
    """

    colliding: NDArray[np.bool_]
    first_touch: Touch | None

    @property
    def is_free(self) -> bool:
        """Whether no sample collides."""
        return self.first_touch is None


Separations = dict[tuple[bytes, int], float | None]
"""Distance that a pair surely keeps in a configuration [m], None where it collides."""


def by_sample(bounds: Array, unsure: NDArray[np.bool_]) -> dict[int, list[int]]:
    """The pairs of each sample that has open ones: least bound first, ties in order."""
    # Flat indices: much faster to find than those of two axes.
    open_pairs = np.flatnonzero(unsure)
    samples, pairs = np.divmod(open_pairs, unsure.shape[1])
    order = np.lexsort((bounds.ravel()[open_pairs], samples))
    found: dict[int, list[int]] = {}
    for sample, pair in zip(samples[order].tolist(), pairs[order].tolist(), strict=True):
        found.setdefault(sample, []).append(pair)
    return found


RESTING_TOLERANCE = 1e-3
"""How deep the payload may sink into a body that it is allowed to rest on [m]."""


class CollisionChecker:
    """Checks the candidates of one workcell. Not to be shared between threads.

    Attributes:
        geometry: the cell's bodies and pairs.
        judge: FCL's objects.
        functions: those of `symbolic.geometry.clearance.screening_functions`, compiled or
            interpreted.
        free_beyond: (n_pairs,) bounds above these call a pair free [m].
        resting_places: per allowed contact and fixed pose that touches: pair, box centre (3,),
            departure [m].
    """

    def __init__(self, geometry: CellGeometry, functions: Mapping[str, NumericFunction]) -> None:
        self.geometry, self.functions = geometry, functions
        self.judge = Judge(geometry, RESTING_TOLERANCE)
        self.free_beyond = geometry.tolerance + FCL_RESOLUTION
        self._pairs = [(pair.first, pair.second) for pair in geometry.active]
        self._names = geometry.pair_names
        self.resting_places = self._find_resting()

    def split(self, configuration: Array) -> tuple[Array, Array, Array]:
        """Box poses (n, 6) and both arms' joints (n, joints) from configurations (n, 6 + all
        joints), each contiguous."""
        at = 6 + self.geometry.arms[0].joints
        parts = (configuration[:, :6], configuration[:, 6:at], configuration[:, at:])
        first, second, third = map(np.ascontiguousarray, parts)
        return first, second, third

    def bounds(self, pose: Array, q_1: Array, q_2: Array) -> Array:
        """Lower bounds (n, n_pairs) of every active pair's distance [m].

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions [rad].
        """
        asked = [self.functions[f"{block}clearance"] for block in self.geometry.asked]
        return self.geometry.of_active([f.batch(pose, q_1, q_2)["clearance"] for f in asked])

    def check(self, pose: Array, q_1: Array, q_2: Array, clearance: Array | None = None) -> Verdict:
        """The verdict on n samples.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions [rad].
            clearance: (n, n_pairs) bounds if known already, else they are computed.
        """
        if clearance is None:
            clearance = self.bounds(pose, q_1, q_2)
        colliding = np.zeros(len(pose), dtype=bool)
        # `not >` keeps a NaN bound open.
        suspects = by_sample(clearance, ~(clearance > self.free_beyond))
        first: Touch | None = None
        if suspects:
            rows = list(suspects)
            self._place(pose[rows], q_1[rows], q_2[rows])
            for local, (sample, pairs) in enumerate(suspects.items()):
                resting = self._resting_pairs(pose[sample, :3])
                hits = (p for p in pairs if self._judge_pair(local, p, p in resting))
                hit = next(hits, None)
                if hit is not None:
                    colliding[sample] = True
                    first = first or Touch(sample, *self._names[hit])
        return Verdict(colliding, first)

    def collisions(
        self,
        pose: Array,
        q_1: Array,
        q_2: Array,
        rows: Sequence[int],
        pairs: Sequence[int],
    ) -> list[bool]:
        """FCL's answer for single pairs of n configurations.

        Args:
            rows: the configuration of each query, those of one side by side.
            pairs: its pair.
        """
        self._place(pose, q_1, q_2)
        resting = [self._resting_pairs(centre) for centre in pose[:, :3]]
        return [
            self._judge_pair(row, pair, pair in resting[row])
            for row, pair in zip(rows, pairs, strict=True)
        ]

    def enters(self, pose: Array, pair: int) -> bool:
        """Whether the box at (6,) enters a body of the environment deeper than one that rests may.

        Args:
            pair: of payload and body.
        """
        still = [np.zeros((1, arm.joints)) for arm in self.geometry.arms]
        self._place(pose[None], *still)
        return self._judge_pair(0, pair, resting=True)

    def motion(
        self, start: tuple[Array, Array, Array], end: tuple[Array, Array, Array]
    ) -> tuple[Array, Array]:
        """Chord and bend (n, n_pairs) [m] of every pair between configurations (pose, q_1, q_2),
        each (n, 6), see `symbolic.geometry.clearance`."""
        asked = [self.functions[f"{block}motion"] for block in self.geometry.asked]
        found = [function.batch(*start, *end) for function in asked]
        chord, bend = (
            self.geometry.of_active([part[name] for part in found]) for name in ("chord", "bend")
        )
        return chord, bend

    def measure(
        self,
        pose: Array,
        q_1: Array,
        q_2: Array,
        clearance: Array,
        wanted: NDArray[np.bool_],
        known: Separations | None = None,
    ) -> NDArray[np.intp]:
        """Raise the bounds (n, n_pairs) of wanted pairs, in place, to a proven distance [m].

        See `Judge.separation`; a bound that is higher already stays. For a payload that
        may rest on a body, the distance of the payload smaller by the resting tolerance counts, and
        the pair's own tolerance beside it: it may come nearer than that.

        Args:
            known: what was measured before, to be looked up and added to: a place where two
                intervals meet is an end of both.

        Returns:
            (n,) the first wanted pair of each sample that collides, or -1.
        """
        hits = np.full(len(pose), -1)
        known = {} if known is None else known
        queries: dict[int, list[int]] = {}
        for k, pair in np.argwhere(wanted).tolist():
            queries.setdefault(k, []).append(pair)
        places = {k: np.hstack([pose[k], q_1[k], q_2[k]]).tobytes() for k in queries}
        new = [k for k, pairs in queries.items() if any((places[k], p) not in known for p in pairs)]
        if new:
            self._place(pose[new], q_1[new], q_2[new])
        at = {k: local for local, k in enumerate(new)}
        for k, pairs in queries.items():
            resting_pairs = self._resting_pairs(pose[k, :3])
            for pair in pairs:
                name = places[k], pair
                if name not in known:
                    known[name] = self._separation(at[k], pair, pair in resting_pairs)
                apart = known[name]
                if apart is None:
                    hits[k] = pair
                    break
                clearance[k, pair] = np.fmax(clearance[k, pair], apart)
        return hits

    def _separation(self, local: int, pair: int, resting: bool) -> float | None:
        """A distance that a pair surely keeps, or None where it collides."""
        i, j = self._pairs[pair]
        first = self.judge.shrunk_payload if resting else i
        nearer = float(self.geometry.tolerance[pair]) if resting else 0.0
        apart = self.judge.separation(local, first, j) + nearer
        if apart <= self.free_beyond[pair] and self._judge_pair(local, pair, resting):
            return None
        return apart

    def too_near(
        self, configuration: Array, wanted: NDArray[np.bool_], required: Array
    ) -> NDArray[np.bool_]:
        """Which wanted pairs of n configurations nothing can prove to be farther apart than
        required: FCL's distance, never more than micrometres below the truth, is not either.

        Args:
            configuration: (n, 6 + all joints).
            wanted, required: (n, n_pairs), distances in metres. Of a payload that may rest on a
                body nothing is said.
        """
        found = np.zeros(wanted.shape, dtype=bool)
        rows = np.flatnonzero(wanted.any(axis=1))
        if len(rows):
            self._place(*self.split(configuration[rows]))
        for local, row in enumerate(rows.tolist()):
            resting = self._resting_pairs(configuration[row, :3])
            for pair in set(np.flatnonzero(wanted[row]).tolist()) - resting:
                apart = self.judge.distance(local, *self._pairs[pair])
                found[row, pair] = apart <= required[row, pair] - FCL_RESOLUTION
        return found

    def min_distance(self, pose: Array, q_1: Array, q_2: Array, clearance: Array) -> float:
        """FCL's least distance over all pairs and samples [m].

        Pairs are measured in the order of their bounds (n, n_pairs), until none is lower than the
        best distance.
        """
        self._place(pose, q_1, q_2)
        best = np.inf
        for flat in np.argsort(clearance, axis=None, kind="stable").tolist():
            sample, pair = divmod(flat, len(self._pairs))
            if clearance[sample, pair] > best:
                break
            best = min(best, self.judge.distance(sample, *self._pairs[pair]))
        return best

    def _place(self, pose: Array, q_1: Array, q_2: Array) -> None:
        poses = self.functions["piece_poses"].batch(pose, q_1, q_2)
        self.judge.set_placements(poses["quaternions"], poses["positions"])

    def _judge_pair(self, local: int, pair: int, resting: bool) -> bool:
        i, j = self._pairs[pair]
        if not resting:
            return self.judge.collides(local, i, j)
        return self.judge.intersects(local, self.judge.shrunk_payload, j)

    def _resting_pairs(self, centre: Array) -> frozenset[int]:
        """Pairs whose contact is allowed with the box centre here."""
        if not self.resting_places:
            return frozenset()
        return frozenset(
            pair
            for pair, place, departure in self.resting_places
            if float(np.linalg.norm(centre - place)) <= departure
        )

    def _find_resting(self) -> list[tuple[int, Array, float]]:
        """See `resting_places`."""
        task = self.geometry.workcell.task
        pairs = {names: k for k, names in enumerate(self._names)}
        still = [np.zeros((1, arm.joints)) for arm in self.geometry.arms]
        found = []
        for allowed in task.allowed_contacts:
            pair = pairs.get((PAYLOAD, allowed.body))
            if pair is None:
                continue
            for waypoint in task.waypoints:
                if not waypoint.is_fixed:
                    continue
                self._place(waypoint.lower[None], *still)
                reach = self.geometry.tolerance[pair] + RESTING_TOLERANCE
                if self.judge.distance(0, *self._pairs[pair]) <= reach:
                    found.append((pair, waypoint.lower[:3], allowed.departure))
        return found
