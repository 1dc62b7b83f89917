"""The contact model of a workcell: how its pads bear a load, what limits that, what is commanded.

A workcell file names a model, `symbolic.contact.registry` makes it, and all rooms ask it. A new
model is a subclass of `ContactModel` and a line in the registry.

`ContactModel.hold` gives the forces of a load as an expression; planned forces, their limits and
derivatives, worst cases and commanded forces follow from it. Where a model has no closed form, the
program of `symbolic.contact.grasp` finds the forces.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import Expression
from symbolic.records.cell import Uncertainty, Workcell
from symbolic.records.quantities import GRAVITY

Problem = tuple[str, str]
"""Key of the workcell file, and a message."""

Both = tuple[Expression, Expression]
"""One value per contact."""


@dataclass(frozen=True)
class ContactLoad:
    """The load that two contacts bear; all vectors along the same axes, the world's for instance.

    Attributes:
        force, moment: (3,) on the payload, about its centre of mass [N, N m].
        arms: (3,) each, from there to the nominal contact points [m].
        axes: (3, 3) tangents and normal of contact 1 as columns.
        friction: (2,) Coulomb coefficients.
    """

    force: Expression
    moment: Expression
    arms: Both
    axes: Expression
    friction: Expression


@dataclass(frozen=True)
class HeldLoad:
    """The forces with which two contacts bear a load.

    Attributes:
        normal, tangential: (2,) normal forces and magnitudes of the tangential ones [N].
        forces: (3,) each, on the payload [N].
        shifts: (3,) each, of the centres of pressure [m].
        moments: (3,) each, on the payload about the nominal contact points [N m].
        point_residual, residual: (3,) moment missing with the forces at the nominal points, and
            with the moments [N m].
    """

    normal: Expression
    tangential: Expression
    forces: Both
    shifts: Both
    moments: Both
    point_residual: Expression
    residual: Expression

    @property
    def wrenches(self) -> Both:
        """(6,) each, force and moment."""
        first, second = (ca.vertcat(*pair) for pair in zip(self.forces, self.moments, strict=True))
        return first, second


@dataclass
class ImplicitVariables:
    """Symbols for values that Newton's method found. Results then depend on the symbols; `replaced`
    puts the values back.

    Attributes:
        steps: of Newton's method from the symbol to what the results depend on. With one, first
            derivatives are exact although they take the symbol for a constant; with two, second
            derivatives as well. None for results without derivatives.
    """

    steps: int = 2
    _found: list[tuple[ca.SX, ca.SX]] = field(default_factory=list)

    def detach(self, value: ca.SX) -> ca.SX:
        """Return a symbol for a value."""
        symbol = ca.SX.sym("solved")
        self._found.append((symbol, value))
        return symbol

    @property
    def symbols(self) -> ca.SX:
        """(k,) all symbols."""
        return ca.vertcat(ca.SX(0, 1), *[symbol for symbol, _ in self._found])

    @property
    def values(self) -> ca.SX:
        """(k,) values of the symbols."""
        return ca.vertcat(ca.SX(0, 1), *[value for _, value in self._found])

    def replaced(self, outputs: list[Expression]) -> list[Expression]:
        """Return outputs with the values in the symbols' place."""
        if not self._found:
            return outputs
        found: list[Expression] = ca.substitute(outputs, [self.symbols], [self.values])
        return list(ca.cse(found))


class ContactModel(ABC):
    """The pads of one workcell as a model takes them. Two pads with opposite normals, unless a
    subclass says otherwise.

    Attributes:
        workcell: the cell; its numbers may be symbols.
        assumption: the pads that planned forces are of, in words.
        has_pressure_limit: whether the shift of the pressure within a patch is a limit of its own,
            because forces do not grow with the moments.
        has_elastic_layers: whether pads are layers that `symbolic.contact.elastic` describes.
        has_closed_form: whether `hold` gives the forces; else a program finds them.
        is_squeeze: whether the arms hold the payload by pressing it between them, so that forces
            are commanded, and reference forces limit the whole force of a robot as well.
        holders: what commanded forces hold the payload with, in words.
        order: what a force asks of them, as in 'press with 80 N'.
    """

    assumption: ClassVar[str]
    has_pressure_limit: ClassVar[bool] = False
    has_elastic_layers: ClassVar[bool] = False
    has_closed_form: ClassVar[bool] = True
    is_squeeze: ClassVar[bool] = True
    holders: ClassVar[str] = "pads that press evenly"
    order: ClassVar[str] = "press with"

    def __init__(self, workcell: Workcell) -> None:
        self.workcell = workcell

    @property
    def has_scalar_squeeze(self) -> bool:
        """Whether the force of one pad decides that of the other, so that the least squeeze says
        all of a case."""
        return self.has_closed_form

    @property
    def command_model(self) -> ContactModel:
        """The model of commanded forces, and so of worst cases."""
        return self

    @property
    @abstractmethod
    def problem(self) -> Problem | None:
        """Key and message if the pads do not hold the payload under every motion, else None."""

    @property
    def level_force(self) -> float:
        """Normal force that holds the payload level and still between upright contacts [N]."""
        weight = -self.workcell.payload.mass * GRAVITY[2]
        return float(weight / sum(contact.friction for contact in self.workcell.contacts))

    @abstractmethod
    def hold(
        self,
        load: ContactLoad,
        implicit: ImplicitVariables | None = None,
        displaced: bool = False,
    ) -> HeldLoad:
        """Return the least contact forces that bear a load.

        Args:
            load: on both contacts.
            implicit: receives what Newton's method finds, for derivatives.
            displaced: whether the arms of the load may place the pads beside one another.
        """

    # --- what the polish differentiates ---

    @property
    def force_branches(self) -> Array:
        """(2, branches, 2) coefficients of both `force_quantities` in the branches of each normal
        force, which is the largest of them."""
        return np.eye(2)[:, None]

    def force_quantities(self, load: ContactLoad, held: HeldLoad) -> Expression:
        """Return two smooth quantities (2,) that normal forces are made of [N]."""
        return held.normal

    def planned_quantities(self, found: Mapping[str, Array]) -> Array:
        """Return these quantities (n, 2) from outputs of n samples, `LOAD_OUTPUTS` of
        `symbolic.contact.load` [N]."""
        return found["normal_force"]

    # --- worst cases ---

    def least_friction(self, uncertainty: Uncertainty) -> Array:
        """Return (2,) coefficients of friction that stand for the worst of a set, zero or less for
        none.

        A pad tilted by t has the coefficient tan(atan mu - t). Pads displaced apart by 2 e turn the
        squeeze into a moment, which a coefficient lower by 2 e / L stands for, L being their
        distance.
        """
        friction = np.array([contact.friction for contact in self.workcell.contacts])
        left = np.tan(np.arctan(friction * (1.0 - uncertainty.friction)) - uncertainty.turned)
        apart = np.array(2.0 * uncertainty.pad_position + uncertainty.apart)
        return np.asarray(left - self.friction_lost(apart))

    def friction_lost(self, apart: Array) -> Array:
        """Return the coefficients that stand for pads displaced apart by distances [m]."""
        return apart / self.workcell.pad_distance

    def worst_displacements(self, uncertainty: Uncertainty) -> tuple[Array, Array]:
        """Return half the widths (3,) of the range of the centre of mass, and the displacements
        (k, 4) of both pads along their tangents that stand for a set's worst [m].

        Pads that are displaced alike leave the centre of mass as much beside them.
        """
        normal = self.workcell.contacts[0].T_box_pad[:3, 2]
        across = np.sqrt(np.maximum(1.0 - normal**2, 0.0))
        centre = uncertainty.centre_of_mass + uncertainty.pad_position * across
        return centre, np.zeros((1, 4))

    def commanded_forces(
        self, normal: Expression, friction: Expression, tracking: Expression, opposed: Expression
    ) -> Expression:
        """Return the normal forces (2,) to command where the least ones (2,) hold [N]: both press
        as much more, because the motion decides the difference of both.

        Args:
            normal: (2,) least normal forces [N].
            friction: (2,) Coulomb coefficients.
            tracking: (2,) share of its force that either robot lacks.
            opposed: tangential force with which the arms work against one another [N].
        """
        share, held = tracking / (1.0 - tracking), opposed / ca.fmin(friction[0], friction[1])
        # Entry by entry: CasADi 3.8 loses the derivative of a product of vectors here.
        more = held + sum(share[i] * (normal[i] + held) for i in (0, 1))
        return ca.vertcat(normal[0] + more, normal[1] + more)

    @property
    def leading_share(self) -> Array:
        """Rise (2,) of the force of either robot as the leading one, per newton more that is
        commanded of the other."""
        return np.ones(2)

    def leading_excess(self, load: ContactLoad, opposed: Expression) -> Expression:
        """Return what robot 1 presses with beyond its `leading_share` of the force that is
        commanded of robot 2 [N].

        Args:
            load: on both contacts.
            opposed: tangential force with which the arms work against one another [N].
        """
        return ca.dot(load.force, load.axes[:, 2])

    def pressed_together(self, leader: int) -> Array:
        """Return what both robots (2,) press with for each newton that is commanded beyond the
        plan."""
        return np.ones(2)

    def room_for_displacements(self, uncertainty: Uncertainty) -> float:
        """Return what displacements leave of the room in which forces are looked for [m]; more than
        zero if they leave any."""
        return np.inf
