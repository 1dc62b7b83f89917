"""Records whose parameters are symbols: formulas take them where a cell's parameters are inputs.

A formula reads `payload.mass` of either kind of record, so that it is written once. A function made
of records with symbols has their groups as its last inputs (`symbolic.expression.sx_parameters`); a
function of plain records has none. A record also holds the numbers that NumPy derives from its own,
so that compiled code sees the same bits as a constant would have.

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
        name: of the input.
        symbols: (n,) of them.
    """

    name: str
    symbols: Any


@dataclass(frozen=True, kw_only=True)
class NumberedRobot(Robot):
    """An arm.

    Attributes:
        T_box_flange: (4, 4) of the arm as it holds the box.
        lever: (3,) from the flange to the contact point, box axes [m].
        given: its numbers.
    """

    T_box_flange: Any = None
    lever: Any = None
    given: ParameterGroup | None = None


@dataclass(frozen=True)
class NumberedPayload(Payload):
    """The payload. given: its parameters, with those of the contacts."""

    given: ParameterGroup | None = None


@dataclass(frozen=True)
class NumberedContact(Contact):
    """A contact. twist, spread: see `symbolic.contact.soft_finger.SoftPatch`. share, opposed: of
    a hand that holds by itself, see `symbolic.contact.elastic.layer_shares` and
    `symbolic.contact.holding_hands.internal_force_needs`."""

    twist: Any = None
    spread: Any = None
    share: Any = None
    opposed: Any = None


@dataclass(frozen=True)
class NumberedWaypoint(Waypoint):
    """A pose of the path; only a fixed one has parameters."""

    fixed: bool = False

    @property
    def is_fixed(self) -> bool:
        """True if the task fixes this pose."""
        return self.fixed


@dataclass(frozen=True)
class NumberedJoint(RedundantJoint):
    """A redundant joint. free: waypoints at which it is a variable; elsewhere `lower` holds its
    parameters."""

    free: tuple[bool, ...] = ()

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(n_waypoints,) True where its value is a decision variable."""
        return np.array(self.free, dtype=np.bool_)


@dataclass(frozen=True, kw_only=True)
class NumberedTask(Task):
    """A task. given: its parameters."""

    given: ParameterGroup | None = None


@dataclass(frozen=True)
class GraspNumbers:
    """Quantities that NumPy derives for grasps by pads with any normals, beside the pads' own
    parameters: n entries of all pads' states; b rows of balance.

    Attributes:
        left: (b,) the dependent ones of the n components.
        squeeze: (n,) internal squeeze to start from.
        spread: (n, 6) the least states that balance a load.
        load_to_left, free_to_left: (b, 6) and (b, n - b), what the load and the free components
            leave to the others, in units of `symbolic.contact.grasp.Grasp.units`.
        to_robots: (6, 6 k) from all pads' wrenches to force and moment of the robot that has the
            pad, see `symbolic.contact.force_closure`.
        shapes: lengths of each pad over its radius, on which its cone depends; () of a disc.
        load_at_rest: (6,) direction of the load at the start.
        rest, rest_slopes: (n,) and (n, 6) states on the central path there, and their slopes.
        reach: size of the patches that the squeeze lies within, over the cell's own.
        given: the group of those that are symbols.
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
    """A cell with the pads' arrangement fixed and its parameters symbolic.

    Attributes:
        facing, opposite, beside: see the properties of `Workcell`.
        grasp: of pads anywhere, else None.
        squeezes: likewise, where either robot's force is commanded.
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
