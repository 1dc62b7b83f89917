"""Collisions between samples: motion bounds, refinement where they exceed the clearance, proof.

A pair that is c_a and c_b apart at the two ends of an interval keeps a distance of at least

  (c_a + c_b - D) / 2 - K / 8       and of at least       max(c_a, c_b) - D - K / 8

inside it, with D and K the chords and bends of both bodies
(`symbolic.geometry.clearance`). Where neither exceeds the tolerance, the interval is halved;
where the compiled clearance does not suffice, a measured distance takes its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.collision.checker import CollidingPair, CollisionChecker
from symbolic.array import Array

Status = Literal["free", "collision", "undecided"]

HALVING_WINS = 0.06
"""Share of the chord that a clearance must exceed for halving to be cheaper than measuring."""

DEPTH = 12
"""Halvings of an interval after which it stays undecided."""

HOPELESS_DEPTH = 3
"""Halvings of an interval with an end too near for any proof: they only look for collisions."""


@dataclass(frozen=True)
class MotionVerdict:
    """What is known of the motion between samples.

    Attributes:
        status: 'free' is proven; 'collision' was found by FCL; 'undecided' where a clearance is
            too small for a proof, or to be told at the finest subdivision.
        touch: the earliest collision, else the earliest undecided interval, else None.
    """

    status: Status
    touch: CollidingPair | None


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


def check_all_between(checker: CollisionChecker, sampled: SampledMotions) -> list[MotionVerdict]:
    """Check motions between samples that are themselves free of collisions, moving linearly
    between them."""
    return _Sweep(checker, sampled).run()


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

    def run(self) -> list[MotionVerdict]:
        n_motions = len(self.sampled.lengths)
        # A motion's earliest interval with a collision so far.
        beyond = np.full(n_motions, len(self.owner))
        hits, left = list[CollidingPair](), list[CollidingPair]()
        work = self._first_intervals()
        for level in range(DEPTH + 1):
            if level > 0:
                work = self._uncleared(work)
            for end, fraction in ((work.b, 1.0), (work.a, 0.0)):
                hit = self._measure(work, end, level == DEPTH)
                for row in np.flatnonzero(hit >= 0).tolist():
                    hits.append(self._touch(work, row, int(hit[row]), fraction))
                    np.minimum.at(beyond, self.owner[work.index[row]], work.index[row])
                if end is work.b:
                    work.hand_on()
            # Samples after a collision say nothing new.
            work = self._uncleared(work[work.index < beyond[self.owner[work.index]]])
            given_up = self._given_up(work, level)
            left += [
                self._touch(work, row, int(np.flatnonzero(work.pending[row])[0]), 0.5)
                for row in np.flatnonzero(given_up).tolist()
            ]
            work = work[~given_up]
            if not len(work.index):
                break
            work = self._halves(work)
        return [self._verdict(motion, hits, left) for motion in range(n_motions)]

    def _verdict(
        self, motion: int, hits: list[CollidingPair], left: list[CollidingPair]
    ) -> MotionVerdict:
        """Return the verdict on one motion, its intervals counted from its own first sample."""
        kinds: tuple[tuple[Status, list[CollidingPair]], ...] = (
            ("collision", hits),
            ("undecided", left),
        )
        for status, found in kinds:
            own = [touch for touch in found if self.owner[touch.sample] == motion]
            if own:
                earliest = min(own, key=lambda touch: (touch.sample, touch.fraction))
                sample = earliest.sample - int(self.first[motion])
                return MotionVerdict(status, replace(earliest, sample=sample))
        return MotionVerdict("free", None)

    def _first_intervals(self) -> Intervals:
        """Return the intervals between the samples that the motion bound does not clear, motion by
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
            whole = np.zeros(count - 1), np.ones(count - 1)
            found.append(self._uncleared(self._intervals(index, *whole, a, b, pending)))
        return of_rows(np.concatenate, found)

    def _intervals(
        self,
        index: NDArray[np.intp],
        start: Array,
        width: Array,
        a: End,
        b: End,
        pending: NDArray[np.bool_],
    ) -> Intervals:
        ends = self.checker.split(a.configuration), self.checker.split(b.configuration)
        return Intervals(index, start, width, a, b, *self.checker.motion(*ends), pending)

    def _uncleared(self, work: Intervals) -> Intervals:
        """Return the intervals with pairs that the motion bound does not clear."""
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
        """Return the clearance to be kept in the intervals, (m, n_pairs), or (1, n_pairs) for
        all [m]."""
        owners = self.owner[work.index]
        if len(owners) and owners[0] == owners[-1] and (owners == owners[0]).all():
            return self.required[owners[:1]]
        return self.required[owners]

    def _given_up(self, work: Intervals, level: int) -> NDArray[np.bool_]:
        """Return (m,) True for intervals that stay undecided: those with an end from which no
        shorter one could be proven either, at the last level all."""
        hopeless = np.full(len(work.index), level == DEPTH)
        if HOPELESS_DEPTH <= level < DEPTH:
            required = self.required[self.owner[work.index]]
            for end in (work.a, work.b):
                asked = work.pending & end.measured & ~(end.clearance > required)
                hopeless |= self.checker.violates_clearance(end.configuration, asked, required).any(
                    axis=1
                )
        return hopeless

    def _measure(self, work: Intervals, end: End, last: bool) -> NDArray[np.intp]:
        """Raise bounds to a proven distance where halving alone would take too long.

        Returns (m,) the first colliding pair of each configuration, or -1.
        """
        beyond = end.clearance - self._required(work)
        hopeless = ~(beyond > HALVING_WINS * work.chord)
        wanted = work.pending & (hopeless | last) & ~end.measured
        end.measured[wanted] = True
        return self.checker.measure(*self.checker.split(end.configuration), end.clearance, wanted)

    def _halves(self, work: Intervals) -> Intervals:
        """Return both halves of every interval, the earlier first."""
        middle = (work.a.configuration + work.b.configuration) / 2.0
        clearance = self.checker.bounds(*self.checker.split(middle))
        new = End(middle, clearance, np.zeros(clearance.shape, dtype=bool))
        half = work.width / 2.0
        return self._intervals(
            np.repeat(work.index, 2),
            _alternating([work.start, work.start + half]),
            np.repeat(half, 2),
            of_rows(_alternating, [work.a, new]),
            of_rows(_alternating, [new, work.b]),
            np.repeat(work.pending, 2, axis=0),
        )

    def _touch(self, work: Intervals, row: int, pair: int, fraction: float) -> CollidingPair:
        place = float(work.start[row] + work.width[row] * fraction)
        names = self.checker.geometry.pair_names[pair]
        return CollidingPair(int(work.index[row]), *names, fraction=place)


class Rows:
    """A record of arrays, and of such records, whose rows belong together."""

    def __getitem__(self, rows: NDArray[np.bool_]) -> Self:
        return of_rows(lambda values: values[0][rows], [self])


AnyRows = TypeVar("AnyRows", bound=Rows)


def of_rows(made_of: Callable[[list[Any]], Any], records: Sequence[AnyRows]) -> AnyRows:
    """Build a record like the given ones, each of its arrays made of theirs."""
    parts = zip(*(vars(record).values() for record in records), strict=True)
    values = [
        of_rows(made_of, part) if isinstance(part[0], Rows) else made_of(list(part))
        for part in parts
    ]
    return type(records[0])(*values)


@dataclass(frozen=True)
class End(Rows):
    """One end of m intervals.

    Attributes:
        configuration: (m, 6 + all joints) pose, q_1, q_2.
        clearance: (m, n_pairs), raised in place where FCL measured [m].
        measured: (m, n_pairs) where it did.
    """

    configuration: Array
    clearance: Array
    measured: NDArray[np.bool_]


@dataclass(frozen=True)
class Intervals(Rows):
    """Work list: intervals, both ends, and the pairs not yet cleared."""

    index: NDArray[np.intp]
    start: Array
    width: Array
    a: End
    b: End
    chord: Array
    bend: Array
    pending: NDArray[np.bool_]

    def hand_on(self) -> None:
        """Copy what was measured at the end of an interval to the start of the next one, where both
        are one place."""
        same = np.all(self.b.configuration[:-1] == self.a.configuration[1:], axis=1)
        before = np.flatnonzero(same)
        after = before + 1
        known = np.fmax(self.a.clearance[after], self.b.clearance[before])
        self.a.clearance[after] = known
        self.a.measured[after] |= self.b.measured[before]


def _alternating(values: list[Array]) -> Array:
    """Interleave the rows of arrays."""
    return np.stack(values, axis=1).reshape(-1, *values[0].shape[1:])
