"""How far an arm is from its singularities, and with them from the edge of its reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from symbolic.cell_model import CellBodies
from symbolic.robot.arm import following_columns, manipulability
from symbolic.smooth.place import Place, PlaceConstraint


@dataclass(frozen=True, order=True)
class Reach(PlaceConstraint):
    """(|det J| / least)^2 - 1 of an arm.

    The square matters: at the edge of the reach the determinant falls like a root of the
    distance, its square evenly.
    """

    arm: int

    scale: ClassVar[float] = 1.0

    @property
    def family(self) -> str:
        """Every arm is its own."""
        return f"reach_{self.arm + 1}"

    def expression(self, place: Place, numbers: ca.SX) -> ca.SX:
        """Zero at the least manipulability that the workcell allows."""
        least = place.model.workcell.robots[self.arm].min_manipulability
        model = place.model.robots[self.arm]
        jacobian = following_columns(model, model.jacobian(place.q[self.arm]))
        return (manipulability(jacobian) / least) ** 2 - 1.0

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """The one."""
        return (self.arm,)
