"""The collision verdict on a candidate: compiled bounds first, FCL where they leave it open.

One rule on both sides of the tolerance: bodies collide if their distance is at most the
tolerance, as FCL finds it. The bounds may only call a pair free beyond the tolerance by more
than FCL's own resolution, so near the tolerance FCL alone decides, screened or not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.collision.judge import FCL_RESOLUTION, Judge
from hybrid_opt.collision.verdict import Contact, Verdict, sample_durations
from symbolic.collision_pairs import CellGeometry
from symbolic.workcell import Array

RESTING_TOLERANCE = 1e-3
"""How deep the payload may sink into a body that it is allowed to rest on [m]."""


class CollisionChecker:
    """Checks the candidates of one workcell. Not to be shared between threads.

    Attributes:
        geometry: the cell's bodies and pairs.
        judge: FCL's objects, with counters.
        resting_tolerance: see `RESTING_TOLERANCE`.
    """

    def __init__(
        self,
        geometry: CellGeometry,
        functions: Mapping[str, NumericFunction],
        resting_tolerance: float = RESTING_TOLERANCE,
    ) -> None:
        """Prepare FCL's objects.

        Args:
            functions: 'clearance' and 'frames' of `symbolic.clearance.screening_functions`,
                compiled or interpreted.
        """
        self.geometry = geometry
        self.resting_tolerance = resting_tolerance
        self.judge = Judge(geometry, resting_tolerance)
        self._functions = functions
        self._free_beyond = geometry.workcell.collision.tolerance + FCL_RESOLUTION
        self._pairs = [(pair.first, pair.second) for pair in geometry.active]
        self._resting = self._find_resting()

    def bounds(self, pose: Array, q_1: Array, q_2: Array) -> Array:
        """Lower bounds (n, n_pairs) of every active pair's distance [m].

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, 6) joint positions [rad].
        """
        return self._functions["clearance"].batch(pose, q_1, q_2)["clearance"]

    def check(
        self,
        pose: Array,
        q_1: Array,
        q_2: Array,
        time: Array,
        clearance: Array | None = None,
        screened: bool = True,
    ) -> Verdict:
        """The verdict on n samples.

        Args:
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, 6) joint positions [rad].
            time: (n,) [s].
            clearance: (n, n_pairs) bounds if known already, else they are computed.
            screened: False gives every pair of every sample to FCL.
        """
        if clearance is None:
            clearance = self.bounds(pose, q_1, q_2)
        colliding = np.zeros(len(pose), dtype=bool)
        calls = self.judge.calls
        # `not >` keeps a NaN bound open.
        unsure = ~(clearance > self._free_beyond) if screened else np.full(clearance.shape, True)
        rows = np.flatnonzero(unsure.any(axis=1))
        first: tuple[int, int] | None = None
        if len(rows):
            self._place(pose[rows], q_1[rows], q_2[rows])
            for local, sample in enumerate(rows.tolist()):
                pairs = self._suspects(clearance[sample], unsure[sample])
                hit = self._first_hit(local, pairs, self._resting_pairs(pose[sample, :3]))
                if hit >= 0:
                    colliding[sample] = True
                    first = first or (sample, hit)
        durations = sample_durations(time)
        return Verdict(
            colliding=colliding,
            collision_time=float(durations[colliding].sum()),
            first_contact=None if first is None else self._contact(*first, time),
            min_clearance=float(np.min(clearance, initial=np.inf)),
            open_samples=len(rows),
            fcl_calls=self.judge.calls - calls,
        )

    def collision_mask(self, pose: Array, q_1: Array, q_2: Array) -> NDArray[np.bool_]:
        """(n, n_pairs): FCL's answer for every pair of every sample, without any screening."""
        self._place(pose, q_1, q_2)
        return np.array(
            [
                [
                    self._judge_pair(k, pair, pair in self._resting_pairs(pose[k, :3]))
                    for pair in range(len(self._pairs))
                ]
                for k in range(len(pose))
            ],
            dtype=bool,
        ).reshape(len(pose), len(self._pairs))

    def distances(self, pose: Array, q_1: Array, q_2: Array, pairs: NDArray[np.intp]) -> Array:
        """(n,) FCL's distance of one pair per sample [m]; 0 where they intersect."""
        self._place(pose, q_1, q_2)
        return np.array(
            [self.judge.distance(k, *self._pairs[pair]) for k, pair in enumerate(pairs.tolist())]
        )

    def min_distance(
        self, pose: Array, q_1: Array, q_2: Array, clearance: Array | None = None
    ) -> tuple[float, Contact | None]:
        """FCL's least distance [m] over all pairs and samples, and where it occurs.

        Pairs are measured in the order of their bounds, until no bound is lower than the best
        distance. `Contact.time` is NaN.
        """
        if clearance is None:
            clearance = self.bounds(pose, q_1, q_2)
        self._place(pose, q_1, q_2)
        best, where = np.inf, None
        for flat in np.argsort(clearance, axis=None, kind="stable").tolist():
            sample, pair = divmod(flat, len(self._pairs))
            if clearance[sample, pair] > best:
                break
            distance = self.judge.distance(sample, *self._pairs[pair])
            if distance < best:
                best, where = distance, self._contact(sample, pair, None)
        return best, where

    def _place(self, pose: Array, q_1: Array, q_2: Array) -> None:
        frames = self._functions["frames"].batch(pose, q_1, q_2)
        n = len(pose)
        # A (3, 39) CasADi matrix arrives as (39, 3): its columns are the rows here.
        rotations = frames["rotations"].reshape(n, 13, 3, 3).transpose(0, 1, 3, 2)
        self.judge.set_placements(rotations, frames["positions"])

    def _suspects(self, bounds: Array, unsure: NDArray[np.bool_]) -> list[int]:
        """Open pairs, the least bound first; ties in the pairs' order."""
        pairs = np.flatnonzero(unsure)
        if len(pairs) > 1:
            pairs = pairs[np.argsort(bounds[pairs], kind="stable")]
        return list(pairs.tolist())

    def _first_hit(self, local: int, pairs: list[int], resting: frozenset[int]) -> int:
        for pair in pairs:
            if self._judge_pair(local, pair, pair in resting):
                return pair
        return -1

    def _judge_pair(self, local: int, pair: int, resting: bool) -> bool:
        i, j = self._pairs[pair]
        if not resting:
            return self.judge.collides(local, i, j)
        return self.judge.intersects(local, self.judge.shrunk_payload, j)

    def _contact(self, sample: int, pair: int, time: Array | None) -> Contact:
        first, second = self.geometry.pair_names[pair]
        moment = float("nan") if time is None else float(time[sample])
        return Contact(sample, moment, first, second)

    def _resting_pairs(self, centre: Array) -> frozenset[int]:
        """Pairs whose contact is allowed with the box centre here."""
        if not self._resting:
            return frozenset()
        return frozenset(
            pair
            for pair, place, departure in self._resting
            if float(np.linalg.norm(centre - place)) <= departure
        )

    def _find_resting(self) -> list[tuple[int, Array, float]]:
        """Per allowed contact and fixed pose that touches: pair, box centre, departure [m]."""
        task = self.geometry.workcell.task
        names = self.geometry.pair_names
        still = np.zeros((1, 6))
        found = []
        for allowed in task.allowed_contacts:
            pair = next(
                (k for k, (_, second) in enumerate(names)
                 if names[k][0] == "payload" and second == allowed.body),
                None,
            )
            if pair is None:
                continue
            for waypoint in task.waypoints:
                if not waypoint.is_fixed:
                    continue
                self._place(waypoint.lower[None], still, still)
                reach = self.geometry.workcell.collision.tolerance + self.resting_tolerance
                if self.judge.distance(0, *self._pairs[pair]) <= reach:
                    found.append((pair, waypoint.lower[:3], allowed.departure))
        return found
