"""One place of the path, and what every kind of row at a place has in common.

A row holds one value above a required one. The value depends on the box pose, where the payload
passes an edge also on the pose's rate along the path, and on the joints that hold the box there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.cell_model import CellBodies
from symbolic.geometry.clearance import Scene
from symbolic.geometry.expressions import EXACT, Softness
from symbolic.path.rotation import rotation_matrix
from symbolic.records import PAYLOAD
from symbolic.smooth.keys import Order, RowKey

WIDTH = 2e-4
"""Width of the smoothed kinks of clearances [m]; what the smooth bounds fall short is made up for
by measured distances (`hybrid_opt.polishing.constraints`)."""


TURN = 3e-3
"""Width of the kinks where a face of a box becomes parallel to another [1]: the best carries lie
in these kinks, and a solver that sees them sharp creeps along."""


class Place:
    """The symbols of one place and what is built from them once.

    Attributes:
        model: of the cell's arms and bodies.
        pose: (6,) of the box [m, rad].
        rate: (6,) change of the pose with the path parameter.
        q: both arms' joints, (n,) each [rad].
    """

    def __init__(self, model: CellBodies) -> None:
        self.model = model
        self.pose, self.rate = ca.SX.sym("pose", 6), ca.SX.sym("rate", 6)
        first, second = (arm.joints for arm in model.geometry.arms)
        self.q = ca.SX.sym("q_1", first), ca.SX.sym("q_2", second)

    @cached_property
    def rotation(self) -> ca.SX:
        """(3, 3) of the box in the world."""
        return rotation_matrix(self.model.workcell.task.orientation, self.pose[3:])

    @cached_property
    def scene(self) -> Scene:
        """The bodies, with the kinks of their distances rounded."""
        return self._scene(Softness(WIDTH, TURN))

    @cached_property
    def sharp_scene(self) -> Scene:
        """The bodies as they are."""
        return self._scene(EXACT)

    def _scene(self, softness: Softness) -> Scene:
        placed = [self.model.robots[arm].joint_placements(self.q[arm]) for arm in (0, 1)]
        geometry = self.model.geometry
        return Scene(geometry, self.rotation, self.pose[:3], (placed[0], placed[1]), softness)

    @property
    def payload(self) -> int:
        """The payload among the bodies."""
        return [body.name for body in self.model.geometry.bodies].index(PAYLOAD)

    def obstacle(self, pair: int) -> Array:
        """The numbers of the box of a separable pair."""
        return self.scene.box_numbers(self.model.geometry.active[pair].second)

    def separable(self) -> tuple[int, ...]:
        """The active pairs of the payload and an obstacle of one box."""
        active = self.model.geometry.active
        return tuple(k for k, p in enumerate(active) if self.scene.separable(p.first, p.second))


@dataclass(frozen=True)
class PlaceConstraint(ABC):
    """One kind of row at a place.

    Constraints of one family share their functions and differ by the numbers handed to them.

    Attributes:
        scale: what the value is divided by, so that 1 matters [m, rad, 1]: a solver that sees
            metres takes a centimetre for a trifle.
        moving: whether the value depends on the rate.
    """

    scale: ClassVar[float]
    moving: ClassVar[bool] = False

    @property
    @abstractmethod
    def family(self) -> str:
        """Name of those that share their functions."""

    @abstractmethod
    def expression(self, place: Place, numbers: ca.SX) -> ca.SX:
        """The value, by the numbers (n,) of a member of the family."""

    def count(self, place: Place) -> int:
        """How many numbers the family's functions take."""
        return 0

    def numbers(self, place: Place) -> Array:
        """(count,) what tells this one from others of its family."""
        return np.zeros(0)

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """The arms whose joints the value depends on."""
        return ()


def row_function(place: Place, constraint: PlaceConstraint, order: Order) -> ca.Function:
    """The value and gradient, or the Hessian, of a constraint's family by what it depends on.

    With y = pose, then the rate where it is `moving`, then the joints of its `arms`:

    first: pose, rate, q_1, q_2, numbers -> value, gradient (n_y,).
    second: pose, rate, q_1, q_2, numbers, weight -> weight times the Hessian (n_y, n_y).

    Where the family has one member, there are no numbers.
    """
    numbers = ca.SX.sym("numbers", constraint.count(place))
    value = constraint.expression(place, numbers)
    arms = constraint.arms(place.model)
    rate = [place.rate] if constraint.moving else []
    y = ca.vertcat(place.pose, *rate, *[place.q[arm] for arm in arms])
    inputs, names = [place.pose, place.rate, *place.q], ["pose", "rate", "q_1", "q_2"]
    if numbers.numel():
        inputs, names = [*inputs, numbers], [*names, "numbers"]
    name = RowKey(constraint.family, order).name
    if order == "first":
        results = ca.cse([value, ca.densify(ca.gradient(value, y))])
        return ca.Function(name, inputs, results, names, ["value", "gradient"])
    weight = ca.SX.sym("weight")
    curvature = ca.cse([ca.densify(weight * ca.hessian(value, y)[0])])
    return ca.Function(name, [*inputs, weight], curvature, [*names, "weight"], ["hessian"])
