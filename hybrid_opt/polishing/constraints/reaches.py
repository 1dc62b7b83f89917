"""Arms away from their singularities, and so within their reach."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from hybrid_opt.polishing.constraints.distances import smooth_values
from hybrid_opt.polishing.constraints.kind import Kind
from hybrid_opt.polishing.grid import lowest
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target
from symbolic.smooth.reach import Reach


class Reaches(Kind[PlaceRow]):
    """Rows where |det J| is low: beyond the edge of the reach nothing else is defined."""

    lasting = True

    def near(self, carry: PlacedCarry, target: Target) -> Iterable[PlaceRow]:
        """Below a share of the median along the path, every few places; more densely where there is
        little left, so that the least does not move between two rows."""
        settings, places = self.near_settings, self.around.cell.grid.places
        for arm in (0, 1):
            measure = carry.manipulability[:, arm]
            least = max(1.0, settings.reach_share * float(np.median(measure)))
            chosen = {*lowest(measure, least, places(settings.reach_stride))}
            chosen |= {*lowest(measure, settings.edge, places(settings.edge_stride))}
            for place in sorted(chosen):
                yield PlaceRow(Reach(arm), place)

    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PlaceRow]:
        """Below the least value and half of what is kept beyond it; and where an arm loses the path
        and after it: at the edge of its reach it is stretched, and so singular."""
        least = (1.0 + self.around.settings.between / 2.0) ** 0.5
        for arm in (0, 1):
            for place in lowest(carry.manipulability[:, arm], least):
                yield PlaceRow(Reach(arm), place)
        for arm in carry.stranded:
            width = self.around.cell.grid.places(self.near_settings.lost)
            for later in (0, width, 2 * width):
                yield PlaceRow(Reach(arm), carry.reached + later)

    def required(
        self, carry: PlacedCarry, rows: Sequence[PlaceRow], lenient: bool = False
    ) -> list[float]:
        """What lets the measure hold between places as well."""
        return [self.around.settings.between] * len(rows)

    def demanded(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Sequence[PlaceRow], before: list[float]
    ) -> list[float]:
        """Where an arm lost the path: half way to what the known candidate has there."""
        if not carry.stranded:
            return self.required(carry, rows)
        has = smooth_values(self.around, known, rows)
        return [(old + new) / 2.0 for old, new in zip(before, has.tolist(), strict=True)]
