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
from typing import Any, ClassVar

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
    """The load on two contacts. All vectors are along the same axes, for example the world's.

    Attributes:
        force, moment: (3,) force and moment that the contacts have to exert on the payload, about
            its centre of mass [N, N m].
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
        normal, tangential: (2,) normal forces and magnitudes of the tangential forces [N].
        forces: (3,) each, contact forces on the payload [N].
        shifts: (3,) each, shifts of the centres of pressure [m].
        moments: (3,) each, contact moments on the payload about the nominal contact points [N m].
        point_residual, residual: (3,) unbalanced moment with the forces at the nominal points
            alone, and with `moments` added [N m].
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
    """Symbols that stand for results of Newton's method. Outputs are built from the symbols;
    `replaced` inserts the values.

    Attributes:
        steps: number of Newton steps between a symbol and the outputs. One step makes first
            derivatives exact although the symbol counts as constant; two steps make second
            derivatives exact too.
    """

    steps: int = 2
    _found: list[tuple[ca.SX, ca.SX]] = field(default_factory=list)

    def detach(self, value: ca.SX) -> ca.SX:
        """Return a new symbol that stands for a value."""
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
        """Return the outputs with the values inserted for the symbols."""
        if not self._found:
            return outputs
        found: list[Expression] = ca.substitute(outputs, [self.symbols], [self.values])
        return list(ca.cse(found))


class ContactModel(ABC):
    """A contact model of one workcell. Methods assume two pads with opposite normals, unless a
    subclass overrides them.

    Attributes:
        workcell: the workcell; its numbers may be symbols.
        assumption: description of the pads that planned forces assume, for messages.
        has_pressure_limit: True if the shift of the pressure within a patch is a limit of its own,
            because forces do not grow with the moments.
        has_elastic_layers: True if pads are elastic layers (`symbolic.contact.elastic`).
        has_closed_form: True if `hold` gives the forces, False if a program computes them.
        is_squeeze: True if the arms press the payload between them. Forces are then commanded, and
            reference forces also limit the whole force of a robot.
        holders: description of the pads or hands that commanded forces assume, for messages.
        order: words of the command, as in 'press with 80 N'.
        closing, opening: names of the phases of a job in which arms at rest take hold of the
            payload, and let go of it.
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
        """True if the force of one pad determines that of the other. One number, the least squeeze,
        then describes a case."""
        return self.has_closed_form

    @property
    def command_model(self) -> ContactModel:
        """The contact model of commanded forces and worst cases."""
        return self

    @property
    def pad_parameters(self) -> list[dict[str, Any]]:
        """Derived quantities of each pad that formulas read, by field of `NumberedContact`."""
        return [{} for _ in self.workcell.pads]

    @property
    @abstractmethod
    def problem(self) -> Problem | None:
        """Key of the workcell file and message if the pads cannot hold the payload under every
        motion, else None."""

    @property
    def level_force(self) -> float:
        """Normal force that holds the payload level and at rest between upright contacts [N]."""
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
            load: load on both contacts.
            implicit: collector of results of Newton's method, for exact derivatives; None for none.
            displaced: True if the arms of the load may offset the pads laterally from each other.
        """

    # --- smooth quantities for the polish ---

    @property
    def force_branches(self) -> Array:
        """Coefficients (2, branches, 2) of the linear functions of both `force_quantities` whose
        maximum is the normal force of each contact."""
        return np.eye(2)[:, None]

    def force_quantities(self, load: ContactLoad, held: HeldLoad) -> Expression:
        """Return two smooth quantities (2,) [N]. The branches of the normal forces are linear
        functions of them."""
        return held.normal

    def planned_quantities(self, found: Mapping[str, Array]) -> Array:
        """Return the `force_quantities` (n, 2) [N] of n samples from their `LOAD_OUTPUTS`."""
        return found["normal_force"]

    # --- worst cases ---

    def least_friction(self, uncertainty: Uncertainty) -> Array:
        """Compute the friction coefficients (2,) that cover the worst case of an uncertainty; zero
        or less if no friction is left.

        A pad tilted by t has the coefficient tan(atan mu - t). Pads displaced in opposite
        directions by 2 e turn the squeeze into a moment. A coefficient lower by 2 e / L covers this
        moment, L being the distance of the pads.
        """
        friction = np.array([contact.friction for contact in self.workcell.contacts])
        left = np.tan(np.arctan(friction * (1.0 - uncertainty.friction)) - uncertainty.turned)
        apart = np.array(2.0 * uncertainty.pad_position + uncertainty.apart)
        return np.asarray(left - self.friction_lost(apart))

    def friction_lost(self, apart: Array) -> Array:
        """Return the reductions (k,) of the friction coefficient that cover relative displacements
        (k,) of the pads [m]."""
        return apart / self.workcell.pad_distance

    def worst_displacements(self, uncertainty: Uncertainty) -> tuple[Array, Array]:
        """Return the worst displacements of the pads under an uncertainty.

        A common displacement of both pads shifts the centre of mass relative to them.

        Returns:
            Half-widths (3,) of the range of the centre of mass [m], enlarged by common
            displacements, and displacements (k, 4) of both pads along their tangents [m].
        """
        normal = self.workcell.contacts[0].T_box_pad[:3, 2]
        across = np.sqrt(np.maximum(1.0 - normal**2, 0.0))
        centre = uncertainty.centre_of_mass + uncertainty.pad_position * across
        return centre, np.zeros((1, 4))

    def commanded_forces(
        self, normal: Expression, friction: Expression, tracking: Expression, opposed: Expression
    ) -> Expression:
        """Return the commanded normal forces (2,) [N]. Both exceed the least forces by the same
        amount, because the motion fixes their difference.

        Args:
            normal: (2,) least normal forces [N].
            friction: (2,) Coulomb coefficients.
            tracking: (2,) share of each robot's force that may be missing.
            opposed: tangential force with which the arms may push against each other [N].
        """
        share, held = tracking / (1.0 - tracking), opposed / ca.fmin(friction[0], friction[1])
        # Entry by entry: CasADi 3.8 loses the derivative of a product of vectors here.
        more = held + sum(share[i] * (normal[i] + held) for i in (0, 1))
        return ca.vertcat(normal[0] + more, normal[1] + more)

    @property
    def leading_share(self) -> Array:
        """Rise of the leading robot's force per newton of the other robot's commanded force, for
        either robot leading (2,)."""
        return np.ones(2)

    def leading_excess(self, load: ContactLoad, opposed: Expression) -> Expression:
        """Return the force of robot 1 minus `leading_share` times the commanded force of robot 2
        [N].

        Args:
            load: load on both contacts.
            opposed: tangential force with which the arms may push against each other [N].
        """
        return ca.dot(load.force, load.axes[:, 2])

    def internal_force_ratio(self, leader: int) -> Array:
        """Return the rise (2,) of both robots' forces per newton that the force-controlled robot
        presses beyond its planned force."""
        return np.ones(2)

    def raised(self, planned: Array, extra: Array, leader: int) -> Array:
        """Return the forces (n, 2) to command if that of the following robot rises by `extra` (n,)
        beyond its planned one [N]."""
        return planned + np.multiply.outer(extra, self.internal_force_ratio(leader))

    def displacement_margin(self, uncertainty: Uncertainty) -> float:
        """Return the distance by which displacements may still grow until forces can no longer be
        computed [m]; zero or less if the uncertainty exceeds the range."""
        return np.inf

    # --- jobs ---

    def approach(self, arm: int) -> Array:
        """Return the direction (3,) in which an arm's pad approaches the payload, box frame."""
        return self.workcell.contacts[arm].T_box_pad[:3, 2]

    def held_with(self, commanded: Array) -> Array:
        """Return the normal forces (n, 2) [N] that hold the payload if these forces are
        commanded."""
        return commanded

    def pulled_apart(self, along: Array, across: Array, stiffness: float) -> tuple[Array, Array]:
        """Return the changes (n,) [N] of the normal forces and of the least normal forces if the
        arms, as springs in series, are displaced against each other.

        Args:
            along, across: displacements (n,) of one pad along its normal and across it [m].
            stiffness: stiffness of each arm at its pad [N/m].
        """
        friction = min(contact.friction for contact in self.workcell.contacts)
        return stiffness / 2.0 * along, stiffness / 2.0 * across / friction
