"""What clearances of all kinds require: a measured distance, told in the smooth bound's terms.

The smooth bound may be lower than the true distance by a centimetre. So a row asks for the wanted
distance less what FCL, or the sharp bound, measures beyond the smooth one at the current
candidate; where the solution moves on and that was too much, the next round asks again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybrid_opt.polishing.constraints.kind import Kind, Surroundings
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.place_values import row_numbers
from hybrid_opt.polishing.placed_carry import PlacedCarry
from symbolic.array import Array
from symbolic.smooth.clearance import Clearance
from symbolic.smooth.passage import Passing, Separation


class DistanceKind(Kind[PlaceRow]):
    """A kind whose values are distances of a pair; `window` is where a row's is measured.

    Attributes:
        wanted, least: (n_pairs,) distance to be asked of each pair, and below which it is
            violated [m].
    """

    window: int = 0

    def __init__(self, around: Surroundings) -> None:
        super().__init__(around)
        tolerance = around.evaluator.checker.geometry.tolerance
        self.wanted = tolerance + around.settings.clearance
        # Half of what is wanted beyond the tolerance is left to what solver and FCL round off.
        self.least = tolerance + around.settings.clearance / 2.0
        self.rows = around.cell.functions.rows

    def required(
        self, carry: PlacedCarry, rows: Sequence[PlaceRow], lenient: bool = False
    ) -> list[float]:
        """See the module; the margin where no arm gets to."""
        values = np.full(len(rows), self.around.settings.margin)
        chosen = [k for k, row in enumerate(rows) if row.place < carry.reached]
        if not chosen:
            return values.tolist()
        truth = self._measured(carry, [rows[k] for k in chosen])
        wanted = self.wanted[[pair_of(rows[k]) for k in chosen]]
        if lenient:
            wanted = np.where(truth > 0.0, np.minimum(wanted, truth), wanted)
        smooth = smooth_values(self.around, carry, [rows[k] for k in chosen])
        values[chosen] = wanted - (truth - smooth)
        return values.tolist()

    def violations(self, carry: PlacedCarry) -> dict[int, Array]:
        """(reached,) distances of every pair that comes too close [m], by pair."""
        return carry.once("violations", lambda: self._violations(carry))

    def _violations(self, carry: PlacedCarry) -> dict[int, Array]:
        close = carry.lowered < self.least
        pairs = np.flatnonzero(close.any(axis=0)).tolist()
        if not pairs:
            return {}
        truth = carry.distance(close)
        return {pair: truth[:, pair].copy() for pair in pairs}

    def _measured(self, carry: PlacedCarry, rows: Sequence[PlaceRow]) -> Array:
        """Least distance in the window of each row."""
        stretches = [
            (slice(max(0, row.place - self.window), row.place + self.window + 1), pair_of(row))
            for row in rows
        ]
        return np.array(carry.least(stretches, self.near_settings.measured_below))


def pair_of(row: PlaceRow) -> int:
    """The active pair of a row whose value is a distance."""
    assert isinstance(row.constraint, Clearance | Separation | Passing)
    return row.constraint.pair


def smooth_values(around: Surroundings, carry: PlacedCarry, rows: Sequence[PlaceRow]) -> Array:
    """The rows' values as the smooth problem sees them."""
    values = np.empty(len(rows))
    groups: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        groups.setdefault(row.constraint.family, []).append(k)
    for members in groups.values():
        at = [rows[k].place for k in members]
        functions, kinds = around.cell.functions.rows, [rows[k].constraint for k in members]
        inputs = [array[at] for array in (carry.pose, carry.rate, *carry.q)]
        inputs += row_numbers(kinds, functions)
        function = functions.of(kinds[0], "first")
        values[members] = function.batch(*inputs)["value"]
    return values
