"""Contact models: the forces with which pads hold a load, their limits, and commanded forces.

A workcell file names a model and `symbolic.contact.registry` makes it. A new model is a subclass of
`ContactModel` and a line in the registry.

`ContactModel.hold` gives the forces under a load as an expression; planned forces, their limits and
derivatives, worst cases and commanded forces follow from it. The program of
`symbolic.contact.grasp` finds the forces of models without a closed form.
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
    """The load on two contacts; all vectors along the same axes, for example the world's.

    Attributes:
        force, moment: (3,) on the payload, about its centre of mass [N, N m].
        arms: (3,) each, from the centre of mass to the nominal contact points [m].
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
    """The forces of two contacts that balance a load.

    Attributes:
        normal, tangential: (2,) normal forces and magnitudes of the tangential ones [N].
        forces: (3,) each, on the payload [N].
        shifts: (3,) each, of the centres of pressure [m].
        moments: (3,) each, on the payload about the nominal contact points [N m].
        point_residual, residual: (3,) unbalanced moment with the forces at the nominal points, and
            with `moments` as well [N m].
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
        """Force and moment (6,) of each contact."""
        first, second = (ca.vertcat(*pair) for pair in zip(self.forces, self.moments, strict=True))
        return first, second


@dataclass
class ImplicitVariables:
    """Symbols for the results of Newton's method. Outputs depend on the symbols; `replaced` inserts
    the values.

    Attributes:
        steps: Newton steps between a symbol and the outputs. One step makes first derivatives exact
            although the symbol counts as constant; two make second derivatives exact as well.
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
        """All symbols (k,)."""
        return ca.vertcat(ca.SX(0, 1), *[symbol for symbol, _ in self._found])

    @property
    def values(self) -> ca.SX:
        """Values (k,) of the symbols."""
        return ca.vertcat(ca.SX(0, 1), *[value for _, value in self._found])

    def replaced(self, outputs: list[Expression]) -> list[Expression]:
        """Return outputs with the values inserted for the symbols."""
        if not self._found:
            return outputs
        found: list[Expression] = ca.substitute(outputs, [self.symbols], [self.values])
        return list(ca.cse(found))


class ContactModel(ABC):
    """A model of one workcell's pads: two pads with opposite normals, unless a subclass says
    otherwise.

    Attributes:
        workcell: the cell; its numbers may be symbols.
        assumption: the pads that planned forces assume, for messages.
        has_pressure_limit: the shift of the pressure within a patch is a limit of its own, because
            forces do not grow with the moments.
        has_elastic_layers: pads are elastic layers (`symbolic.contact.elastic`).
        has_closed_form: `hold` gives the forces; else a program finds them.
        is_squeeze: the arms press the payload between them: forces are commanded, and reference
            forces limit the whole force of a robot as well.
        holders: the pads or hands that commanded forces assume, for messages.
        order: the command to them, as in 'press with 80 N'.
        closing, opening: phases of a job in which standing arms take hold of the payload, and let
            go of it.
    """

    assumption: ClassVar[str]
    has_pressure_limit: ClassVar[bool] = False
    has_elastic_layers: ClassVar[bool] = False
    has_closed_form: ClassVar[bool] = True
    is_squeeze: ClassVar[bool] = True
    holders: ClassVar[str] = "pads that press evenly"
    order: ClassVar[str] = "press with"
    closing: ClassVar[tuple[str, ...]] = ("press",)
    opening: ClassVar[tuple[str, ...]] = ("release",)

    def __init__(self, workcell: Workcell) -> None:
        self.workcell = workcell

    @property
    def has_scalar_squeeze(self) -> bool:
        """True if the force of one pad determines that of the other, so that one number, the least
        squeeze, describes a case."""
        return self.has_closed_form

    @property
    def command_model(self) -> ContactModel:
        """The contact model of commanded forces and worst cases."""
        return self

    @property
    @abstractmethod
    def problem(self) -> Problem | None:
        """Key and message if the pads cannot hold the payload under every motion, else None."""

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
        """Return the least contact forces that balance a load.

        Args:
            load: on both contacts.
            implicit: collects results of Newton's method, for derivatives.
            displaced: the pads may be laterally offset from each other by the arms of the load.
        """

    # --- smooth quantities for the polish ---

    @property
    def force_branches(self) -> Array:
        """Coefficients (2, branches, 2) of the branches of each normal force by both
        `force_quantities`; the largest branch is the force."""
        return np.eye(2)[:, None]

    def force_quantities(self, load: ContactLoad, held: HeldLoad) -> Expression:
        """Return two smooth quantities (2,) of which the branches of the normal forces are linear
        functions [N]."""
        return held.normal

    def planned_quantities(self, found: Mapping[str, Array]) -> Array:
        """Return `force_quantities` (n, 2) of n samples from their `LOAD_OUTPUTS` [N]."""
        return found["normal_force"]

    # --- worst cases ---

    def least_friction(self, uncertainty: Uncertainty) -> Array:
        """Compute the coefficients of friction (2,) that cover the worst case of a set; zero or
        less if none is left.

        A pad tilted by t has the coefficient tan(atan mu - t). Pads displaced in opposite
        directions by 2 e turn the squeeze into a moment, which is covered by a coefficient lower by
        2 e / L, L being their distance.
        """
        friction = np.array([contact.friction for contact in self.workcell.contacts])
        left = np.tan(np.arctan(friction * (1.0 - uncertainty.friction)) - uncertainty.turned)
        apart = np.array(2.0 * uncertainty.pad_position + uncertainty.apart)
        return np.asarray(left - self.friction_lost(apart))

    def friction_lost(self, apart: Array) -> Array:
        """Return the reduction of the coefficients that covers relative displacements of the pads
        [m]."""
        return apart / self.workcell.pad_distance

    def worst_displacements(self, uncertainty: Uncertainty) -> tuple[Array, Array]:
        """Return half-widths (3,) of the range of the centre of mass, and displacements (k, 4) of
        both pads along their tangents, that cover a set's displacements [m].

        A common displacement of both pads shifts the centre of mass relative to them.
        """
        normal = self.workcell.contacts[0].T_box_pad[:3, 2]
        across = np.sqrt(np.maximum(1.0 - normal**2, 0.0))
        centre = uncertainty.centre_of_mass + uncertainty.pad_position * across
        return centre, np.zeros((1, 4))

    def commanded_forces(
        self, normal: Expression, friction: Expression, tracking: Expression, opposed: Expression
    ) -> Expression:
        """Return the normal forces (2,) to command for least normal forces (2,) [N]. Both rise by
        the same amount, because the motion fixes their difference.

        Args:
            normal: (2,) least normal forces [N].
            friction: (2,) Coulomb coefficients.
            tracking: (2,) missing share of each robot's force.
            opposed: tangential force of the arms against each other [N].
        """
        share, held = tracking / (1.0 - tracking), opposed / ca.fmin(friction[0], friction[1])
        # Entry by entry: CasADi 3.8 loses the derivative of a product of vectors here.
        more = held + sum(share[i] * (normal[i] + held) for i in (0, 1))
        return ca.vertcat(normal[0] + more, normal[1] + more)

    @property
    def leading_share(self) -> Array:
        """Rise (2,) of each robot's force, as the leading one, per newton of the other's commanded
        force."""
        return np.ones(2)

    def leading_excess(self, load: ContactLoad, opposed: Expression) -> Expression:
        """Return the force of robot 1 beyond `leading_share` times the commanded force of robot 2
        [N].

        Args:
            load: on both contacts.
            opposed: tangential force of the arms against each other [N].
        """
        return ca.dot(load.force, load.axes[:, 2])

    def internal_force_ratio(self, leader: int) -> Array:
        """Return the rise (2,) of both robots' forces per newton that is commanded beyond the
        plan."""
        return np.ones(2)

    def displacement_margin(self, uncertainty: Uncertainty) -> float:
        """Return the remaining range of displacements in which forces can be computed [m]; zero or
        less if the set's displacements exceed it."""
        return np.inf

    # --- jobs ---

    def approach(self, arm: int) -> Array:
        """Return the direction (3,) in which an arm's pad comes to the payload, box frame."""
        return self.workcell.contacts[arm].T_box_pad[:3, 2]

    def held_with(self, commanded: Array) -> Array:
        """Return the normal forces (n, 2) that hold where these are commanded [N]."""
        return commanded

    def pulled_apart(self, along: Array, across: Array, stiffness: float) -> tuple[Array, Array]:
        """Return the changes (n,) of the normal forces and of the least ones where the arms, in
        series, are displaced against one another [N].

        Args:
            along, across: displacements (n,) of one pad, along the normal and across it [m].
            stiffness: of each arm at its pad [N/m].
        """
        friction = min(contact.friction for contact in self.workcell.contacts)
        return stiffness / 2.0 * along, stiffness / 2.0 * across / friction
