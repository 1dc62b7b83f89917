"""Records whose parameters are symbols, for functions that take a cell's parameters as inputs.

A formula reads `payload.mass` from either kind of record, so it is written once. A function of
records with symbols has their parameter groups as its last inputs
(`symbolic.expression.sx_parameters`); a function of plain records has no such inputs. A record also
holds quantities that NumPy derives from its parameters, so that compiled code sees the same bits as
a constant would have.

Everything else in a record is topology (`symbolic.parameters.CellParameters`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symbolic.records.cell import Contact, Payload, Robot, Workcell
from symbolic.records.task import RedundantJoint, Task, Waypoint


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that functions take as one vector.

    Attributes:
        name: name of the input.
        symbols: (n,) symbols of the parameters.
    """

    name: str
    symbols: Any


@dataclass(frozen=True, kw_only=True)
class NumberedRobot(Robot):
    """An arm whose numbers are symbols.

    Attributes:
        T_box_flange: (4, 4) flange in the box frame while the arm holds the box.
        lever: (3,) from the flange to the contact point, box axes [m].
        given: the arm's numbers as one group.
    """

    T_box_flange: Any = None
    lever: Any = None
    given: ParameterGroup | None = None


@dataclass(frozen=True)
class NumberedPayload(Payload):
    """The payload with symbols as parameters.

    Attributes:
        given: parameters of payload and contacts as one group.
    """

    given: ParameterGroup | None = None


@dataclass(frozen=True)
class NumberedContact(Contact):
    """A contact with symbols as parameters.

    Attributes:
        twist, spread: lengths of the patch (`symbolic.contact.soft_finger.SoftPatch`).
        share: for a hand, its matrix of `symbolic.contact.elastic.layer_shares`.
        opposed: for a hand, its row of `symbolic.contact.holding_hands.internal_force_needs`.
        weaker: for a hand, the least holding force of all hands over its own.
    """

    twist: Any = None
    spread: Any = None
    share: Any = None
    opposed: Any = None
    weaker: Any = None


@dataclass(frozen=True)
class NumberedWaypoint(Waypoint):
    """A pose of the path. Only a fixed pose has parameters."""

    fixed: bool = False

    @property
    def is_fixed(self) -> bool:
        """True if the task fixes this pose."""
        return self.fixed


@dataclass(frozen=True)
class NumberedJoint(RedundantJoint):
    """A redundant joint with symbols as parameters.

    Attributes:
        free: True for waypoints at which the joint is a variable; at the others `lower` is a
            parameter.
    """

    free: tuple[bool, ...] = ()

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(n_waypoints,) True for waypoints at which the value is a decision variable."""
        return np.array(self.free, dtype=np.bool_)


@dataclass(frozen=True, kw_only=True)
class NumberedTask(Task):
    """A task with symbols as parameters.

    Attributes:
        given: the task's parameters as one group.
    """

    given: ParameterGroup | None = None


@dataclass(frozen=True)
class GraspNumbers:
    """Constants that NumPy derives for grasps by pads with any normals. The states of all pads have
    n entries; the balance has b rows.

    Attributes:
        left: (b,) indices of the dependent components among the n.
        squeeze: (n,) initial internal squeeze.
        spread: (n, 6) matrix from a load to the least-norm states that balance it.
        load_to_left, free_to_left: (b, 6) and (b, n - b) matrices from the load and from the free
            components to the dependent components, in units of
            `symbolic.contact.grasp.Grasp.units`.
        to_robots: (6, 6 k) matrix from all pads' wrenches to the first robot's force and moment,
            from `symbolic.contact.force_closure.robot_wrenches`.
        shapes: lengths of each pad over its radius, on which its cone depends; () for a disc.
        load_at_rest: (6,) direction of the load at rest at the start.
        rest, rest_slopes: (n,) states on the central path under this load, and (n, 6) their
            derivatives by the load.
        reach: size of the patches within which the squeeze lies, over the cell's own size.
        given: the constants that are symbols, as one group.
    """

    left: tuple[int, ...]
    squeeze: Any
    spread: Any
    load_to_left: Any
    free_to_left: Any
    to_robots: Any
    shapes: tuple[Any, ...]
    load_at_rest: Any
    rest: Any
    rest_slopes: Any
    reach: Any
    given: ParameterGroup | None = None


@dataclass(frozen=True)
class NumberedWorkcell(Workcell):
    """A cell with a fixed arrangement of pads and symbols as parameters.

    Attributes:
        facing, opposite, beside: values of `has_facing_pads`, `has_opposite_pads` and
            `has_offset_pads`.
        grasp: constants of a grasp by pads with any normals, else None.
        squeezes: constants of its programs of commanded forces, for either robot; else None.
    """

    facing: bool = False
    opposite: bool = False
    beside: bool = False
    grasp: GraspNumbers | None = None
    squeezes: tuple[GraspNumbers, ...] = ()

    @property
    def has_facing_pads(self) -> bool:
        """True if two round pads with opposite normals hold the payload."""
        return self.facing

    @property
    def has_opposite_pads(self) -> bool:
        """True if two pads with opposite normals hold the payload."""
        return self.opposite

    @property
    def has_offset_pads(self) -> bool:
        """True if the contacts are offset laterally."""
        return self.beside
