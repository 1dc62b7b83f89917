"""The clearance of two bodies, at least one of them on an arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from symbolic.cell_model import CellBodies
from symbolic.smooth.place import Place, PlaceConstraint


@dataclass(frozen=True, order=True)
class Clearance(PlaceConstraint):
    """Smooth lower bound of the distance of an active pair [m]."""

    pair: int

    scale: ClassVar[float] = 0.01

    @property
    def family(self) -> str:
        """Every pair is its own."""
        return f"clearance_{self.pair}"

    def expression(self, place: Place, numbers: ca.SX) -> ca.SX:
        """The bound of `symbolic.geometry.clearance`, its kinks rounded."""
        bodies = place.model.geometry.active[self.pair]
        return place.scene.bound(bodies.first, bodies.second)

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Those whose links are in the pair."""
        geometry = model.geometry
        bodies = geometry.active[self.pair]
        frames = [geometry.bodies[body].frame for body in (bodies.first, bodies.second)]
        return tuple(sorted({frame.robot for frame in frames if frame.kind == "link"}))
