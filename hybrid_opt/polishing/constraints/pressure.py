"""Centres of pressure within their patches."""

from __future__ import annotations

from collections.abc import Iterable

from hybrid_opt.polishing.constraints.kind import Kind
from hybrid_opt.polishing.grid import lowest
from hybrid_opt.polishing.layout import PressureRow
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target


class Pressure(Kind[PressureRow]):
    """Rows at the farthest shift of every stretch near the rim of a patch, and beside it."""

    lasting = True

    def near(self, carry: PlacedCarry, target: Target) -> Iterable[PressureRow]:
        """Beyond a share of the patch's radius."""
        return self._beyond(carry, self.near_settings.pressure_share)

    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PressureRow]:
        """At the rim: half of the margin is left to what the solver rounds off."""
        return self._beyond(carry, (1.0 - self.around.settings.margin / 2.0) ** 0.5)

    def _beyond(self, carry: PlacedCarry, share: float) -> Iterable[PressureRow]:
        last = len(carry.shift) - 1
        width = self.around.cell.grid.samples(self.near_settings.beside_pressure)
        for robot in (0, 1):
            for sample in lowest(-carry.shift[:, robot], -share):
                for beside in (-width, -1, 0, 1, width):
                    yield PressureRow(robot, min(max(0, sample + beside), last))
