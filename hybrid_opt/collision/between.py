"""Collision check of motions between samples, by motion bounds and adaptive subdivision.

A pair of bodies with distances of at least c_a and c_b at the two ends of an interval keeps a
distance of at least

  (c_a + c_b - D) / 2 - K / 8       and of at least       max(c_a, c_b) - D - K / 8

inside the interval. D and K are the sums over both bodies of the chords and bends that
`symbolic.geometry.clearance` defines. If neither bound exceeds the tolerance, the interval is
halved. Where compiled bounds of c_a and c_b are too small, measured distances replace them.
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
"""If the clearance exceeds the required one by this share of the chord, halving is cheaper than
measuring."""

DEPTH = 12
"""Number of halvings after which an interval stays undecided."""

HOPELESS_DEPTH = 3
"""After so many halvings an interval is given up if one of its ends is too near for any proof.
Until then it is halved further, to look for collisions."""


@dataclass(frozen=True)
class MotionVerdict:
    """Result of the check of one motion between its samples.

    Attributes:
        status: 'free' if proven; 'collision' if two bodies collide; 'undecided' if a distance is
            too small for a proof.
        touch: the earliest collision, or the earliest undecided interval if nothing collides; None
            if free.
    """

    status: Status
    touch: CollidingPair | None


@dataclass(frozen=True)
class SampledMotions:
    """Samples of several motions, one motion after the other.

    Attributes:
        configuration: (n, 6 + all joints) box poses [m, rad] and both arms' joint positions [rad].
        clearance: (n, n_pairs) lower bounds of the pairs' distances [m].
        lengths: number of samples of each motion, at least two.
        margin: (n_motions,) distance that bodies have to keep beyond the tolerance [m].
    """

    configuration: Array
    clearance: Array
    lengths: Sequence[int]
    margin: Array


def check_all_between(checker: CollisionChecker, sampled: SampledMotions) -> list[MotionVerdict]:
    """Check motions for collisions between their samples.

    The samples must be free of collisions. Box pose and joints move linearly between them.

    Args:
        checker: collision checker of the workcell.
        sampled: the samples of all motions.

    Returns:
        One verdict per motion.
    """
    return _Sweep(checker, sampled).run()


class _Sweep:
    """Adaptive subdivision of the intervals between samples, for all motions together.

    Attributes:
        owner: (n_intervals,) index of the motion of each interval.
        first: (n_motions,) index of the first interval of each motion.
        required: (n_motions, n_pairs) distance that the pairs have to keep [m].
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
        """Return the verdict on one motion, with samples counted from the motion's first sample.

        Args:
            motion: index of the motion.
            hits: collisions of all motions.
            left: undecided intervals of all motions.
        """
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
        """Return the intervals between samples in which bounds of the bodies' motion do not prove
        freedom from collisions.

        Motions are handled one by one: nearly all intervals are proven free, and arrays over all of
        them would not stay in the processor's cache.
        """
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
        """Return those of the given intervals in which a pair of bodies is not yet proven to keep
        its required distance.

        A proof succeeds if the pair's distances at both ends are large enough for its relative
        motion between them. Pairs with a proof are no longer `pending`.
        """
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
        """Return the distance that each pair has to keep in each of m intervals, (m, n_pairs) [m].

        The shape is (1, n_pairs) if all intervals belong to one motion.
        """
        owners = self.owner[work.index]
        if len(owners) and owners[0] == owners[-1] and (owners == owners[0]).all():
            return self.required[owners[:1]]
        return self.required[owners]

    def _given_up(self, work: Intervals, level: int) -> NDArray[np.bool_]:
        """Return a mask (m,), True for each interval that is not halved further and stays
        undecided.

        These are all intervals at the last level. From the level `HOPELESS_DEPTH` on, these are
        also intervals at one end of which a pair is closer than required, since then no proof can
        succeed.

        Args:
            work: the m intervals.
            level: number of times that the intervals have been halved.
        """
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
        """Measure distances of bodies at the first or the last configuration of m intervals.

        A pair is measured at this configuration if three conditions hold: it has not been measured
        there before, it is not yet proven to be free of collisions in the interval, and its
        distance bound is so small that halving the interval again would cost more than the
        measurement. The measured distances replace the bounds in `end`.

        Args:
            work: the intervals.
            end: configurations and distance bounds at this end of each interval.
            last: True to drop the condition on the bound.

        Returns:
            (m,) index of the first pair that collides at this end of each interval; -1 for none.
        """
        beyond = end.clearance - self._required(work)
        hopeless = ~(beyond > HALVING_WINS * work.chord)
        wanted = work.pending & (hopeless | last) & ~end.measured
        end.measured[wanted] = True
        return self.checker.measure(*self.checker.split(end.configuration), end.clearance, wanted)

    def _halves(self, work: Intervals) -> Intervals:
        """Return the two halves of every given interval, the earlier half first."""
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
    """A record of arrays with one row per item. A field may itself be such a record."""

    def __getitem__(self, rows: NDArray[np.bool_]) -> Self:
        return type(self)(*[values[rows] for values in vars(self).values()])


AnyRows = TypeVar("AnyRows", bound=Rows)


def of_rows(made_of: Callable[[list[Any]], Any], records: Sequence[AnyRows]) -> AnyRows:
    """Combine several records of one type into one record, field by field.

    Args:
        made_of: function that combines a list of arrays, the same field of every record, to one
            array.
        records: the records.
    """
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
        configuration: (m, 6 + all joints) box poses and joints of both arms.
        clearance: (m, n_pairs) lower bounds of the distances [m]; measurements raise them in place.
        measured: (m, n_pairs) True where a distance was measured.
    """

    configuration: Array
    clearance: Array
    measured: NDArray[np.bool_]


@dataclass(frozen=True)
class Intervals(Rows):
    """m intervals that are not yet proven free.

    Attributes:
        index: (m,) index of the pair of successive samples between which the interval lies.
        start, width: (m,) start and width as shares of the way between these two samples, 0 to 1.
        a, b: the two ends.
        chord, bend: (m, n_pairs) bounds of the relative motion of each pair [m].
        pending: (m, n_pairs) True for pairs without a proof.
    """

    index: NDArray[np.intp]
    start: Array
    width: Array
    a: End
    b: End
    chord: Array
    bend: Array
    pending: NDArray[np.bool_]

    def hand_on(self) -> None:
        """Share measured distances between intervals that meet.

        If the end of an interval has the same configuration as the start of the next one, the
        distances measured at the end are copied to this start.
        """
        same = np.all(self.b.configuration[:-1] == self.a.configuration[1:], axis=1)
        before = np.flatnonzero(same)
        after = before + 1
        known = np.fmax(self.a.clearance[after], self.b.clearance[before])
        self.a.clearance[after] = known
        self.a.measured[after] |= self.b.measured[before]


def _alternating(values: list[Array]) -> Array:
    """Interleave the rows of k arrays (m, ...): the first row of each, then the second of each.
    Return (k m, ...).
    """
    return np.stack(values, axis=1).reshape(-1, *values[0].shape[1:])
