"""How the payload passes an obstacle: which single direction separates them where along the path.

Between a box and a box, the clearance bound is the largest of a few gaps along single directions.
A row that holds one of these gaps is smooth. Where the largest gap changes from one that falls
to one that rises, the payload passes an edge, and the height of that kink gets a row of its own
(`symbolic.smooth.passage`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.constraints.distances import DistanceKind
from hybrid_opt.polishing.constraints.kind import Surroundings
from hybrid_opt.polishing.grid import lowest
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target
from symbolic.array import Array
from symbolic.smooth.passage import Passing, Separation


class Separations(DistanceKind):
    """Rows of single gaps between the payload and a box, away from kinks."""

    def near(self, carry: PlacedCarry, target: Target) -> Iterable[PlaceRow]:
        """Along every stretch where the payload is near, at a few places each."""
        settings, grid = self.near_settings, self.around.cell.grid
        beside = grid.places(settings.beside_kink)
        stretches = (
            (settings.gap_distance, grid.places(settings.gap_stride)),
            (settings.far_gap_distance, grid.places(settings.far_gap_stride)),
        )
        for pair, gaps in near_gaps(self, carry):
            kinks = [kink for kink, _ in edges(gaps, settings.kink_distance)]
            places = {
                place
                for distance, stride in stretches
                for place in lowest(gaps.height, distance, stride)
                if all(abs(place - kink) >= beside for kink in kinks)
            }
            for place in sorted(places):
                yield separation(pair, gaps, place)

    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PlaceRow]:
        """Around places that are too close and far from every kink of the known candidate, in
        whose directions the rows are."""
        half = self.around.cell.grid.places(self.near_settings.kink_window) // 2
        for pair, gaps, place, near in violated_passages(self, carry, known):
            if not near:
                for k in (place - half, place, place + half):
                    if 0 <= k < known.reached:
                        yield separation(pair, gaps, k)


class Passings(DistanceKind):
    """Rows of the kinks where the payload passes an edge."""

    def __init__(self, around: Surroundings) -> None:
        super().__init__(around)
        self.window = around.cell.grid.places(self.near_settings.kink_window)

    def near(self, carry: PlacedCarry, target: Target) -> Iterable[PlaceRow]:
        """Kinks that are low."""
        for pair, gaps in near_gaps(self, carry):
            for kink, place in edges(gaps, self.near_settings.kink_distance):
                yield passing(pair, gaps, kink, place)

    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PlaceRow]:
        """Kinks of the known candidate near places that are too close."""
        for pair, gaps, _, near in violated_passages(self, carry, known):
            for kink, place in near:
                yield passing(pair, gaps, kink, place)


@dataclass(frozen=True)
class Gaps:
    """A separable pair's gaps along every direction at m places.

    Attributes:
        along: (m, n) [m].
        best: (m,) direction of the largest.
        height: (m,) that one [m].
    """

    along: Array
    best: NDArray[np.intp]
    height: Array

    @classmethod
    def of(cls, along: Array) -> Gaps:
        """Of all gaps."""
        best = along.argmax(axis=1)
        return cls(along, best, along[np.arange(len(best)), best])


def edges(gaps: Gaps, limit: float) -> list[tuple[int, int]]:
    """Kinks lower than a limit [m]: the place before each, and the lower one of both beside it."""
    best, height, along = gaps.best, gaps.height, gaps.along
    return [
        (k, k + int(height[k + 1] < height[k]))
        for k in np.flatnonzero(best[1:] != best[:-1]).tolist()
        if height[k : k + 2].min() < limit
        and along[k + 1, best[k]] < along[k, best[k]]
        and along[k + 1, best[k + 1]] > along[k, best[k + 1]]
    ]


def passing(pair: int, gaps: Gaps, kink: int, place: int) -> PlaceRow:
    """The row of a kink of `edges`."""
    before, after = (int(gaps.best[k]) for k in (kink, kink + 1))
    return PlaceRow(Passing(pair, before, after), place)


def separation(pair: int, gaps: Gaps, place: int) -> PlaceRow:
    """The row of the largest gap at a place."""
    return PlaceRow(Separation(pair, int(gaps.best[place])), place)


def near_gaps(kind: DistanceKind, carry: PlacedCarry) -> Iterable[tuple[int, Gaps]]:
    """Every separable pair that comes near, and its gaps."""
    farthest = kind.near_settings.far_gap_distance
    for pair in np.flatnonzero(carry.clearance.min(axis=0) < farthest).tolist():
        if pair in kind.rows.separable:
            yield pair, gaps_of(kind, carry, pair)


def violated_passages(
    kind: DistanceKind, carry: PlacedCarry, known: PlacedCarry
) -> Iterable[tuple[int, Gaps, int, list[tuple[int, int]]]]:
    """Places that are too close: pair, gaps of the known candidate, place, its kinks nearby."""
    window = kind.around.cell.grid.places(kind.near_settings.kink_window)
    for pair, distance in kind.violations(carry).items():
        if pair not in kind.rows.separable:
            continue
        gaps = gaps_of(kind, known, pair)
        kinks = edges(gaps, kind.near_settings.kink_distance)
        for place in lowest(distance, float(kind.least[pair])):
            yield pair, gaps, place, [k for k in kinks if abs(k[1] - place) <= window]


def gaps_of(kind: DistanceKind, carry: PlacedCarry, pair: int) -> Gaps:
    """Of a separable pair, at the places that are reached."""

    def find() -> Gaps:
        return Gaps.of(carry.gaps(pair))

    return carry.once(("gaps", pair), find)
