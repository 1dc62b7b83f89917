"""Joints within their limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from hybrid_opt.polishing.constraints.kind import Kind
from hybrid_opt.polishing.grid import lowest
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target
from symbolic.array import Array
from symbolic.smooth.joint_limit import JointLimit, Side


class JointLimits(Kind[PlaceRow]):
    """Rows at the tightest places of every joint that comes near a limit."""

    lasting = True

    def near(self, carry: PlacedCarry, target: Target) -> Iterable[PlaceRow]:
        """Joints near a limit."""
        return self._below(carry, self.near_settings.joint_distance)

    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PlaceRow]:
        """Joints beyond a limit, or nearer than half of what is kept from it."""
        return self._below(carry, self.around.settings.between / 2.0)

    def required(
        self, carry: PlacedCarry, rows: Sequence[PlaceRow], lenient: bool = False
    ) -> list[float]:
        """What lets a limit hold between places as well."""
        return [self.around.settings.between] * len(rows)

    def _below(self, carry: PlacedCarry, limit: float) -> Iterable[PlaceRow]:
        for arm, robot in enumerate(self.around.workcell.robots):
            q = carry.q[arm][: carry.reached]
            margins: tuple[tuple[Side, Array], ...] = (
                ("lower", q - robot.position_lower),
                ("upper", robot.position_upper - q),
            )
            for side, margin in margins:
                for joint in range(q.shape[1]):
                    for place in lowest(margin[:, joint], limit):
                        yield PlaceRow(JointLimit(arm, joint, side), place)
