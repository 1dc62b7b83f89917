"""Collisions between samples: motion bounds, refinement where they exceed the clearance, proof.

A pair that is c_a and c_b apart at the two ends of an interval keeps a distance of at least

  (c_a + c_b - D) / 2 - K / 8       and of at least       max(c_a, c_b) - D - K / 8

inside it, with D and K the chords and bends of both bodies
(`symbolic.geometry.clearance`). Where neither exceeds the tolerance, the interval is halved;
where the compiled clearance does not suffice, a distance proven along FCL's nearest points takes
its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.collision.checker import CollisionChecker, Separations
from symbolic.array import Array

Status = Literal["free", "collision", "undecided"]

SEARCH_DEPTH = 5
"""Halvings of an interval in a search."""

HALVING_WINS = 0.06
"""Share of the chord that a clearance must exceed for halving to be cheaper than measuring."""

PROOF_DEPTH = 12
"""Halvings of an interval in a proof."""

HOPELESS_DEPTH = 3
"""Halvings of an interval with an end too near for any proof: they only look for collisions."""


@dataclass(frozen=True)
class PassingTouch:
    """A collision between samples, or an interval that could not be decided.

    Attributes:
        interval: index of the sample before it.
        fraction: where in the interval, 0 to 1.
        first, second: names of the bodies.
    """

    interval: int
    fraction: float
    first: str
    second: str


@dataclass(frozen=True)
class MotionVerdict:
    """What is known of the motion between samples.

    Attributes:
        status: 'free' is proven; 'collision' was found by FCL; 'undecided' where a clearance is
            too small for a proof, or to be told at the finest subdivision.
        touch: the earliest collision, else the earliest undecided interval, else None.
        unsafe: (n - 1,) intervals with a collision or undecided, up to the earliest collision.
        intervals: intervals examined, halves included.
        added: configurations added between the samples.
    """

    status: Status
    touch: PassingTouch | None
    unsafe: NDArray[np.bool_]
    intervals: int
    added: int


@dataclass(frozen=True)
class SampledMotions:
    """Several motions on their samples, one after the other.

    Attributes:
        configuration: (n, 6 + all joints) box poses [m, rad] and both arms' joint positions [rad].
        clearance: (n, n_pairs) lower bounds of the pairs' distances [m].
        lengths: samples of each motion, at least two.
        margin: (n_motions,) distance to be kept beyond the tolerance [m].
    """

    configuration: Array
    clearance: Array
    lengths: Sequence[int]
    margin: Array


def check_all_between(
    checker: CollisionChecker, sampled: SampledMotions, depth: int = SEARCH_DEPTH
) -> list[MotionVerdict]:
    """Whether anything collides between samples that are themselves free of collisions.

    Between samples all of them move linearly. After `depth` halvings an interval counts as
    undecided.
    """
    return _Sweep(checker, sampled).run(depth)


class _Sweep:
    """All intervals of all motions, halved together.

    Attributes:
        owner: (n_intervals,) motion that an interval belongs to.
        first: (n_motions,) its first interval.
        required: (n_motions, n_pairs) clearance to be kept [m].
    """

    def __init__(self, checker: CollisionChecker, sampled: SampledMotions) -> None:
        self.checker = checker
        self.sampled = sampled
        intervals = np.asarray(sampled.lengths) - 1
        self.owner = np.repeat(np.arange(len(intervals)), intervals)
        self.first = np.cumsum(intervals) - intervals
        self.required = checker.geometry.tolerance + sampled.margin[:, None]
        self._separations: Separations = {}

    def run(self, depth: int) -> list[MotionVerdict]:
        n, n_motions = len(self.owner), len(self.sampled.lengths)
        unsafe, left = np.zeros(n, dtype=bool), list[PassingTouch]()
        beyond = np.full(n_motions, n)  # a motion's earliest interval with a collision so far
        hits: list[PassingTouch] = []
        examined, added = np.bincount(self.owner, minlength=n_motions), np.zeros(n_motions, int)
        work = self._first_intervals()
        for level in range(depth + 1):
            if level > 0:
                examined += self._per_motion(work)
                work = self._uncleared(work)
            for end, fraction in ((work.a, 0.0), (work.b, 1.0)):
                hit = self._measure(work, end, level == depth)
                for row in np.flatnonzero(hit >= 0).tolist():
                    unsafe[work.index[row]] = True
                    hits.append(self._touch(work, row, int(hit[row]), fraction))
                    np.minimum.at(beyond, self.owner[work.index[row]], work.index[row])
            # Samples after a collision say nothing new.
            work = self._uncleared(work[work.index < beyond[self.owner[work.index]]])
            given_up = self._given_up(work, level, depth)
            unsafe[work.index[given_up]] = True
            left += [
                self._touch(work, row, int(np.flatnonzero(work.pending[row])[0]), 0.5)
                for row in np.flatnonzero(given_up).tolist()
            ]
            work = work[~given_up]
            if not len(work.index):
                break
            added += self._per_motion(work)
            work = self._halves(work)
        return [
            self._verdict(k, unsafe, (hits, left), int(examined[k]), int(added[k]))
            for k in range(n_motions)
        ]

    def _per_motion(self, work: Intervals) -> NDArray[np.intp]:
        """(n_motions,) intervals of each in the work list."""
        return np.bincount(self.owner[work.index], minlength=len(self.sampled.lengths))

    def _verdict(
        self,
        motion: int,
        unsafe: NDArray[np.bool_],
        touches: tuple[list[PassingTouch], list[PassingTouch]],
        examined: int,
        added: int,
    ) -> MotionVerdict:
        """What was found for one motion, its intervals counted from its own first sample."""
        first = int(self.first[motion])
        hits, left = (
            sorted(
                (
                    replace(touch, interval=touch.interval - first)
                    for touch in found
                    if self.owner[touch.interval] == motion
                ),
                key=lambda touch: (touch.interval, touch.fraction),
            )
            for found in touches
        )
        status: Status = "collision" if hits else "undecided" if left else "free"
        earliest = next(iter(hits or left), None)
        return MotionVerdict(status, earliest, unsafe[self.owner == motion], examined, added)

    def _first_intervals(self) -> Intervals:
        """The intervals between the samples that the motion bound does not clear, found motion by
        motion: nearly all are cleared, and arrays over all of them would not stay cached."""
        found = []
        for motion, count in enumerate(self.sampled.lengths):
            first = int(self.first[motion]) + motion
            configuration = self.sampled.configuration[first : first + count]
            clearance = self.sampled.clearance[first : first + count]
            measured = np.zeros(clearance.shape, dtype=bool)
            a, b = (
                End(configuration[part], clearance[part], measured[part])
                for part in (slice(None, -1), slice(1, None))
            )
            index = int(self.first[motion]) + np.arange(count - 1)
            pending = np.ones((count - 1, clearance.shape[1]), dtype=bool)
            every = self._intervals(index, np.zeros(count - 1), 1.0, a, b, pending)
            found.append(self._uncleared(every))
        return joined(found)

    def _intervals(
        self,
        index: NDArray[np.intp],
        start: Array,
        width: float,
        a: End,
        b: End,
        pending: NDArray[np.bool_],
    ) -> Intervals:
        motion = self.checker.motion(
            self.checker.split(a.configuration), self.checker.split(b.configuration)
        )
        return Intervals(index, start, width, a, b, motion.chord, motion.bend, pending)

    def _uncleared(self, work: Intervals) -> Intervals:
        """The intervals with pairs that the motion bound does not clear."""
        c_a, c_b = work.a.clearance, work.b.clearance
        halfway = c_a + c_b
        halfway -= work.chord
        halfway /= 2.0
        kept = np.fmax(c_a, c_b)
        kept -= work.chord
        np.fmax(halfway, kept, out=kept)
        kept -= work.bend / 8.0
        pending: NDArray[np.bool_] = work.pending & ~(kept > self._required(work))
        left: NDArray[np.bool_] = np.any(pending, axis=1)
        return replace(work, pending=pending)[left]

    def _required(self, work: Intervals) -> Array:
        """Clearance to be kept in the intervals, (m, n_pairs), or (1, n_pairs) for all [m]."""
        owners = self.owner[work.index]
        if len(owners) and owners[0] == owners[-1] and (owners == owners[0]).all():
            return self.required[owners[:1]]
        return self.required[owners]

    def _given_up(self, work: Intervals, level: int, depth: int) -> NDArray[np.bool_]:
        """(m,) intervals that stay undecided: those with an end from which no shorter one could be
        proven either, at the last level all."""
        hopeless = np.full(len(work.index), level == depth)
        if HOPELESS_DEPTH <= level < depth:
            required = self.required[self.owner[work.index]]
            for end in (work.a, work.b):
                asked = work.pending & end.measured & ~(end.clearance > required)
                hopeless |= self.checker.too_near(end.configuration, asked, required).any(axis=1)
        return hopeless

    def _measure(self, work: Intervals, end: End, last: bool) -> NDArray[np.intp]:
        """Raise bounds to a proven distance where halving alone would take too long.

        Returns (m,) the first colliding pair of each configuration, or -1.
        """
        beyond = end.clearance - self._required(work)
        hopeless = ~(beyond > HALVING_WINS * work.chord)
        wanted = work.pending & (hopeless | last) & ~end.measured
        end.measured[wanted] = True
        return self.checker.measure(
            *self.checker.split(end.configuration), end.clearance, wanted, self._separations
        )

    def _halves(self, work: Intervals) -> Intervals:
        """Both halves of every interval, the earlier first."""
        middle = (work.a.configuration + work.b.configuration) / 2.0
        clearance = self.checker.bounds(*self.checker.split(middle))
        new = End(middle, clearance, np.zeros(clearance.shape, dtype=bool))
        return self._intervals(
            np.repeat(work.index, 2),
            alternating(work.start, work.start + work.width / 2.0),
            work.width / 2.0,
            alternating_ends(work.a, new),
            alternating_ends(new, work.b),
            np.repeat(work.pending, 2, axis=0),
        )

    def _touch(self, work: Intervals, row: int, pair: int, fraction: float) -> PassingTouch:
        first, second = self.checker.geometry.pair_names[pair]
        place = float(work.start[row]) + work.width * fraction
        return PassingTouch(int(work.index[row]), place, first, second)


@dataclass(frozen=True)
class End:
    """One end of m intervals.

    Attributes:
        configuration: (m, 6 + all joints) pose, q_1, q_2.
        clearance: (m, n_pairs), raised in place where FCL measured [m].
        measured: (m, n_pairs) where it did.
    """

    configuration: Array
    clearance: Array
    measured: NDArray[np.bool_]

    def __getitem__(self, rows: NDArray[np.bool_]) -> End:
        return End(self.configuration[rows], self.clearance[rows], self.measured[rows])


@dataclass(frozen=True)
class Intervals:
    """Work list: intervals of equal width, both ends, and the pairs not yet cleared."""

    index: NDArray[np.intp]
    start: Array
    width: float
    a: End
    b: End
    chord: Array
    bend: Array
    pending: NDArray[np.bool_]

    def __getitem__(self, rows: NDArray[np.bool_]) -> Intervals:
        return Intervals(
            self.index[rows],
            self.start[rows],
            self.width,
            self.a[rows],
            self.b[rows],
            self.chord[rows],
            self.bend[rows],
            self.pending[rows],
        )


def joined(parts: Sequence[Intervals]) -> Intervals:
    """Intervals of one width, one part after the other."""

    def ends(some: Sequence[End]) -> End:
        return End(
            np.concatenate([end.configuration for end in some]),
            np.concatenate([end.clearance for end in some]),
            np.concatenate([end.measured for end in some]),
        )

    return Intervals(
        np.concatenate([part.index for part in parts]),
        np.concatenate([part.start for part in parts]),
        parts[0].width,
        ends([part.a for part in parts]),
        ends([part.b for part in parts]),
        np.concatenate([part.chord for part in parts]),
        np.concatenate([part.bend for part in parts]),
        np.concatenate([part.pending for part in parts]),
    )


def alternating(first: Array, second: Array) -> Array:
    """Rows of two arrays in turn."""
    return np.stack([first, second], axis=1).reshape(-1, *first.shape[1:])


def alternating_ends(first: End, second: End) -> End:
    """Ends of two kinds in turn."""
    return End(
        alternating(first.configuration, second.configuration),
        alternating(first.clearance, second.clearance),
        np.stack([first.measured, second.measured], axis=1).reshape(-1, first.measured.shape[1]),
    )
