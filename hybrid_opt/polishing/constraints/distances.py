"""Rows of distances: of the arms, and of the payload that passes an obstacle.

The smooth bound of a clearance may be a centimetre below the true distance. So a row requires the
wanted distance minus this error, measured at the current candidate. If the error changes on the way
to the solution, the next iteration corrects it.

Between two boxes the bound is the largest of a few gaps along single directions. A row with one of
these gaps is smooth. Where the largest gap changes from a falling to a rising one, the payload
passes an edge, and the height of this kink gets a row of its own (`symbolic.smooth.passage`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.cell import PlacedCarry, SmoothCell, local_minima_below
from hybrid_opt.polishing.rows import (
    PATCH_MARGIN,
    ConstraintKind,
    MinimisedForces,
    PathRow,
    smooth_values,
)
from symbolic.array import Array
from symbolic.smooth.passage import AxisSwitchGap, SeparatingAxisGap
from symbolic.smooth.path_points import Clearance

BODY_DISTANCE = 0.03
"""A pair with an arm's body gets rows at its minima below this distance [m]."""

MEASURED_BELOW = 0.02
"""Lower bounds below this are replaced by measured distances [m]."""

BESIDE_CLEARANCE = 0.015
"""Distance along the path of further rows on both sides of a violated clearance."""

GAP_DISTANCE, GAP_STRIDE = 0.03, 0.02
"""Every stretch with a gap of the payload below this distance [m] gets rows at this stride. These
rows are cheap, because they need no joints, and they decide the path."""

FAR_GAP_DISTANCE, FAR_GAP_STRIDE = 0.08, 0.04
"""The same for larger gaps, with fewer rows."""

KINK_DISTANCE = 0.06
"""Kinks of the payload's clearance below this height get a row [m]."""

BESIDE_KINK = 0.03
"""Distance along the path from a kink within which gaps get no rows: they would hold the kink in
its point."""

KINK_WINDOW = 0.04
"""Distance along the path from a kink within which its height is measured."""


class DistanceConstraintKind(ConstraintKind[PathRow]):
    """Kind of constraint on the distance of a pair of bodies.

    Attributes:
        window: number of points on both sides of a row's point over which the least distance is
            measured.
        wanted: (n_pairs,) distance that programs require of each pair [m].
        least: (n_pairs,) distance below which a pair violates the constraint [m].
        separable: indices of the pairs of the payload and an obstacle that is a single box, for
            which gaps along single directions are computed.
    """

    window: int = 0

    def __init__(self, cell: SmoothCell) -> None:
        super().__init__(cell)
        tolerance = cell.evaluator.checker.geometry.tolerance
        self.wanted = tolerance + cell.clearance
        # Half of what is wanted beyond the tolerance is left to what solver and FCL round off.
        self.least = tolerance + cell.clearance / 2.0
        self.separable = cell.functions.separable
        self._columns = cell.evaluator.checker.geometry.columns.tolist()

    def required_values(
        self, carry: PlacedCarry, rows: Sequence[PathRow], is_relaxed: bool = False
    ) -> list[float]:
        """Return the bound [m] that the smooth model of the distance has to exceed in each row
        (scalar inequality): the wanted distance minus the model's error.

        The error is the measured least distance minus the value of the smooth model at the row's
        point. The distance is measured at this point and at up to `window` points on each side. A
        row at a point that an arm does not reach gets the small value `PATCH_MARGIN`.

        Args:
            carry: the candidate, evaluated at points of the path.
            rows: the rows.
            is_relaxed: True to require no larger distance than the candidate has, if its distance
                is positive.
        """
        values = np.full(len(rows), PATCH_MARGIN)
        chosen = [k for k, row in enumerate(rows) if row.point < carry.reached]
        if not chosen:
            return values.tolist()
        # The least distance in the window of each row.
        pairs, window = [pair_of(rows[k]) for k in chosen], self.window
        at = [slice(max(0, rows[k].point - window), rows[k].point + window + 1) for k in chosen]
        stretches = list(zip(at, pairs, strict=True))
        truth = np.array(carry.distances.least(stretches, MEASURED_BELOW))
        wanted = self.wanted[pairs]
        if is_relaxed:
            wanted = np.where(truth > 0.0, np.minimum(wanted, truth), wanted)
        smooth = smooth_values(self.cell, carry, [rows[k] for k in chosen])
        values[chosen] = wanted - (truth - smooth)
        return values.tolist()


def pair_of(row: PathRow) -> int:
    """Return the index of the pair of bodies whose distance a row (scalar inequality) limits."""
    assert isinstance(row.constraint, Clearance | SeparatingAxisGap | AxisSwitchGap)
    return row.constraint.pair


class Clearances(DistanceConstraintKind):
    """Rows (scalar inequalities) on the distances of pairs of bodies that include a body of an arm,
    at the points of least distance.
    """

    persists = True

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) for the pairs of bodies that come closer than
        `BODY_DISTANCE`, at the local minima of a lower bound of their distance along the path.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: not used.
        """
        for pair in np.flatnonzero(carry.distances.bounds.min(axis=0) < BODY_DISTANCE).tolist():
            if pair not in self.separable:
                for point in local_minima_below(carry.distances.bounds[:, pair], BODY_DISTANCE):
                    yield PathRow(Clearance(pair, self._columns[pair]), point)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) for pairs of bodies that are too close.

        Around each local minimum of a distance below its limit, rows lie at the minimum, at the
        next point, and `BESIDE_CLEARANCE` before and after it along the path.

        Args:
            carry: candidate after the step.
            known: candidate before the step; not used.
        """
        width = self.grid.points(BESIDE_CLEARANCE)
        for pair, distance in carry.distances.closer_than(self.least).items():
            if pair in self.separable:
                continue
            lows = local_minima_below(distance, float(self.least[pair]))
            for point in sorted({k + beside for k in lows for beside in (0, 1, -width, width)}):
                if point < carry.reached:
                    yield PathRow(Clearance(pair, self._columns[pair]), point)


class SeparatingAxisGaps(DistanceConstraintKind):
    """Rows (scalar inequalities) on the gap between payload and an obstacle box along one
    direction.

    They lie away from kinks, the points at which the direction of the largest gap changes.
    """

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) at regular distances along every part of the path on
        which the payload is near an obstacle box.

        No row lies closer than `BESIDE_KINK` to a kink, a point at which the direction of the
        largest gap changes.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: not used.
        """
        grid = self.grid
        beside = grid.points(BESIDE_KINK)
        stretches = (
            (GAP_DISTANCE, grid.points(GAP_STRIDE)),
            (FAR_GAP_DISTANCE, grid.points(FAR_GAP_STRIDE)),
        )
        for pair, gaps in near_gaps(self, carry):
            kinks = [kink for kink, _ in edges(gaps, KINK_DISTANCE)]
            points = {
                point
                for distance, stride in stretches
                for point in local_minima_below(gaps.height, distance, stride)
                if all(abs(point - kink) >= beside for kink in kinks)
            }
            for point in sorted(points):
                yield separation(pair, gaps, point)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) where the payload comes too close to an obstacle box
        after a step: at the point of the least distance, and half of `KINK_WINDOW` before and after
        it along the path.

        Each row limits the gap along the direction in which the gap was largest before the step.
        Points near a kink, where this direction changes, are left to `AxisSwitchGaps`.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
        """
        half = self.grid.points(KINK_WINDOW) // 2
        for pair, gaps, point, near in violated_passages(self, carry, known):
            if not near:
                for k in (point - half, point, point + half):
                    if 0 <= k < known.reached:
                        yield separation(pair, gaps, k)


class AxisSwitchGaps(DistanceConstraintKind):
    """Rows (scalar inequalities) on the gap at a kink, the point at which the payload passes an
    edge of a box.
    """

    def __init__(self, cell: SmoothCell) -> None:
        super().__init__(cell)
        self.window = cell.grid.points(KINK_WINDOW)

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PathRow]:
        """Return a row (scalar inequality) for each kink whose gap is below `KINK_DISTANCE`.

        A kink is a point of the path at which the payload passes an edge of an obstacle box.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: not used.
        """
        for pair, gaps in near_gaps(self, carry):
            for kink, point in edges(gaps, KINK_DISTANCE):
                yield passing(pair, gaps, kink, point)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PathRow]:
        """Return a row (scalar inequality) for each kink that lies near a point of the path where
        the payload comes too close to an obstacle box after a step.

        A kink is a point at which the payload passes an edge of the obstacle. The kinks of the
        candidate before the step are used.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
        """
        for pair, gaps, _, near in violated_passages(self, carry, known):
            for kink, point in near:
                yield passing(pair, gaps, kink, point)


@dataclass(frozen=True)
class Gaps:
    """Gaps between the payload and an obstacle box along n directions, at m points of the path.

    Attributes:
        along: (m, n) gap between payload and obstacle along each direction [m].
        best: (m,) index of the direction with the largest gap.
        height: (m,) largest gap [m], a lower bound of the distance.
    """

    along: Array
    best: NDArray[np.intp]
    height: Array

    @classmethod
    def from_values(cls, along: Array) -> Gaps:
        """Build the record from the gaps (m, n) [m] at m points along n directions."""
        best = along.argmax(axis=1)
        return cls(along, best, along[np.arange(len(best)), best])


def edges(gaps: Gaps, limit: float) -> list[tuple[int, int]]:
    """Find the kinks of the largest gap along a path.

    A kink lies between two successive points at which different directions have the largest gap.
    The gap along the first of these directions falls from point to point, that along the second one
    rises.

    Args:
        gaps: gaps between payload and one obstacle box along the path.
        limit: kinks are left out if the largest gap reaches this limit [m] at both points.

    Returns:
        Two indices for each kink: that of the point before it, and that of the point, before or
        after it, at which the largest gap is smaller.
    """
    best, height, along = gaps.best, gaps.height, gaps.along
    return [
        (k, k + int(height[k + 1] < height[k]))
        for k in np.flatnonzero(best[1:] != best[:-1]).tolist()
        if height[k : k + 2].min() < limit
        and along[k + 1, best[k]] < along[k, best[k]]
        and along[k + 1, best[k + 1]] > along[k, best[k + 1]]
    ]


def passing(pair: int, gaps: Gaps, kink: int, point: int) -> PathRow:
    """Return the row (scalar inequality) for a kink: the payload passes an edge of an obstacle box,
    and the direction of the largest gap changes.

    Args:
        pair: index of the pair of payload and obstacle.
        gaps: gaps of the pair along the path.
        kink: index of the point before the kink.
        point: index of the point at which the row applies.
    """
    before, after = (int(gaps.best[k]) for k in (kink, kink + 1))
    return PathRow(AxisSwitchGap(pair, before, after), point)


def separation(pair: int, gaps: Gaps, point: int) -> PathRow:
    """Return the row (scalar inequality) for the largest gap between payload and obstacle at a
    point.

    Args:
        pair: index of the pair of payload and obstacle.
        gaps: gaps of the pair along the path.
        point: index of the point of the row.
    """
    return PathRow(SeparatingAxisGap(pair, int(gaps.best[point])), point)


def near_gaps(kind: DistanceConstraintKind, carry: PlacedCarry) -> Iterable[tuple[int, Gaps]]:
    """Yield the gaps of every separable pair that comes nearer than `FAR_GAP_DISTANCE`. A separable
    pair is the payload and an obstacle that is a single box.

    Args:
        kind: kind of constraint, which knows the separable pairs.
        carry: the candidate, evaluated at points of the path.

    Yields:
        Index of the pair, and its gaps.
    """
    for pair in np.flatnonzero(carry.distances.bounds.min(axis=0) < FAR_GAP_DISTANCE).tolist():
        if pair in kind.separable:
            yield pair, Gaps.from_values(carry.gaps(pair))


def violated_passages(
    kind: DistanceConstraintKind, carry: PlacedCarry, known: PlacedCarry
) -> Iterable[tuple[int, Gaps, int, list[tuple[int, int]]]]:
    """Find the points at which the payload comes too close to a box-shaped obstacle after a step.

    Args:
        kind: kind of constraint, which knows the pairs of payload and obstacle box and their least
            distances.
        carry: candidate after the step.
        known: candidate before the step.

    Yields:
        - Index of the pair.
        - Gaps of the pair before the step.
        - Index of a point at which the distance has a local minimum below its limit.
        - Kinks within `KINK_WINDOW` of this point before the step, as `edges` returns them.
    """
    window = kind.grid.points(KINK_WINDOW)
    for pair, distance in carry.distances.closer_than(kind.least).items():
        if pair not in kind.separable:
            continue
        gaps = Gaps.from_values(known.gaps(pair))
        kinks = edges(gaps, KINK_DISTANCE)
        for point in local_minima_below(distance, float(kind.least[pair])):
            yield pair, gaps, point, [k for k in kinks if abs(k[1] - point) <= window]
