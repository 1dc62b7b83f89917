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
    """Parameters that functions take as one input vector.

    Attributes:
        name: name of the input.
        symbols: (n,) CasADi symbols of the parameters.
    """

    name: str
    symbols: Any


@dataclass(frozen=True, kw_only=True)
class NumberedRobot(Robot):
    """An arm with symbols as parameters.

    Attributes:
        T_box_flange: (4, 4) flange frame in the box frame while the arm holds the box.
        lever: (3,) vector from the flange to the nominal contact point, box axes [m].
        given: the arm's parameters as one group.
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
        twist, spread: lengths of the patch (`symbolic.contact.soft_finger.SoftPatch`) [m].
        share: for a hand, its matrix (6, 6) of `symbolic.contact.elastic.layer_shares`.
        opposed: for a hand, its row (4,) of `symbolic.contact.holding_hands.internal_force_needs`.
        weaker: for a hand, the least holding force of all hands over its own.
    """

    twist: Any = None
    spread: Any = None
    share: Any = None
    opposed: Any = None
    weaker: Any = None


@dataclass(frozen=True)
class NumberedWaypoint(Waypoint):
    """A pose of the path with symbols as parameters. Only a fixed pose has parameters.

    Attributes:
        fixed: True if the task fixes the pose.
    """

    fixed: bool = False

    @property
    def is_fixed(self) -> bool:
        """True if the task fixes this pose."""
        return self.fixed


@dataclass(frozen=True)
class NumberedJoint(RedundantJoint):
    """A redundant joint with symbols as parameters.

    Attributes:
        free: for each waypoint True if the joint position is a decision variable there; at the
            other waypoints `lower` is a parameter.
    """

    free: tuple[bool, ...] = ()

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(n_waypoints,) True where the joint position is a decision variable, False where it is
        fixed."""
        return np.array(self.free, dtype=np.bool_)


@dataclass(frozen=True, kw_only=True, eq=False)
class NumberedTask(Task):
    """A task with symbols as parameters.

    Attributes:
        given: the task's parameters as one group.
    """

    given: ParameterGroup | None = None


@dataclass(frozen=True)
class GraspNumbers:
    """Constants of a grasp by k pads with any normals, derived with NumPy. The scaled states of all
    pads have n = 4 k entries, of which b are dependent: they follow from the load and the others.

    Attributes:
        left: (b,) indices of the dependent entries among the n.
        squeeze: (n,) internal squeeze, as states of all pads.
        spread: (n, 6) matrix from a load to the least-norm states that balance it.
        load_to_left: (b, 6) matrix from the load to the dependent entries, in newtons and newton
            metres (`symbolic.contact.grasp.Grasp.units`).
        free_to_left: (b, n - b) matrix from the other entries to the dependent ones, in these
            units; its product is subtracted.
        to_robots: (6, 6 k) matrix from the wrenches of all pads to each robot's force and moment
            (`symbolic.contact.force_closure.robot_wrenches`).
        shapes: for each pad its lengths over its radius, on which its cone depends; empty for a
            disc.
        load_at_rest: (6,) load of the payload at rest at the start, divided by its size.
        rest: (n,) states on the central path under `load_at_rest`.
        rest_slopes: (n, 6) derivatives of `rest` by the load.
        reach: size of the patches within which `squeeze` lies, over the cell's own size.
        given: the constants that are symbols, as one group; None without symbols.
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


@dataclass(frozen=True, eq=False)
class NumberedWorkcell(Workcell):
    """A cell with symbols as parameters and a known arrangement of its pads.

    Attributes:
        facing, opposite, beside: values of `has_facing_pads`, `has_opposite_pads` and
            `has_offset_pads`.
        grasp: constants of the grasp if its pads have any normals, else None.
        squeezes: constants of the two programs of commanded forces, entry i with robot i commanded;
            empty if the grasp needs no such program.
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
        """True if the contacts are offset perpendicular to the normal of contact 1."""
        return self.beside
