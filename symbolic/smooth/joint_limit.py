"""The distance of a joint to one of its limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.cell_model import CellBodies
from symbolic.smooth.place import Place, PlaceConstraint

Side = Literal["lower", "upper"]


@dataclass(frozen=True, order=True)
class JointLimit(PlaceConstraint):
    """Distance of a joint to its lower or upper limit [rad]."""

    arm: int
    joint: int
    side: Side

    scale: ClassVar[float] = 0.1

    @property
    def family(self) -> str:
        """All limits of one arm."""
        return f"joint_limit_{self.arm + 1}"

    def expression(self, place: Place, numbers: ca.SX) -> ca.SX:
        """The margin, negative beyond the limit."""
        return numbers[0] + ca.dot(numbers[1:], place.q[self.arm])

    def count(self, place: Place) -> int:
        """A margin and a slope per joint."""
        return 1 + int(place.q[self.arm].numel())

    def numbers(self, place: Place) -> Array:
        """The margin at zero joints, and its gradient."""
        robot = place.model.workcell.robots[self.arm]
        slope = np.zeros(len(robot.position_lower))
        slope[self.joint] = 1.0 if self.side == "lower" else -1.0
        limit = robot.position_lower if self.side == "lower" else robot.position_upper
        return np.concatenate([[-slope[self.joint] * limit[self.joint]], slope])

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """The joint's own."""
        return (self.arm,)
