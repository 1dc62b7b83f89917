"""Clearances of the arms, and of the payload from what is no box."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hybrid_opt.polishing.constraints.distances import DistanceKind
from hybrid_opt.polishing.grid import lowest
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target
from symbolic.smooth.clearance import Clearance


class Clearances(DistanceKind):
    """Rows at the lowest places of every pair that comes near."""

    lasting = True

    def near(self, carry: PlacedCarry, target: Target) -> Iterable[PlaceRow]:
        """Pairs whose bound is small."""
        limit = self.near_settings.body_distance
        for pair in np.flatnonzero(carry.clearance.min(axis=0) < limit).tolist():
            if pair not in self.rows.separable:
                for place in lowest(carry.clearance[:, pair], limit):
                    yield PlaceRow(Clearance(pair), place)

    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PlaceRow]:
        """Pairs that come too close: at the lowest place and around it; a dip counts at two
        neighbours."""
        width = self.around.cell.grid.places(self.near_settings.beside_clearance)
        for pair, distance in self.violations(carry).items():
            if pair in self.rows.separable:
                continue
            lows = lowest(distance, float(self.least[pair]))
            for place in sorted({k + beside for k in lows for beside in (0, 1, -width, width)}):
                if place < carry.reached:
                    yield PlaceRow(Clearance(pair), place)
