"""Contact models: the forces with which pads hold a load, their limits, and commanded forces.

A workcell file names a model and `symbolic.contact.registry` makes it. A new model is a subclass of
`ContactModel` and a line in the registry.

`ContactModel.hold` gives the forces under a load as an expression; planned forces, their limits and
derivatives, worst cases and commanded forces follow from it. The program of
`symbolic.contact.grasp` finds the forces of models without a closed form.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import Expression
from symbolic.records.cell import Contact, Uncertainty, Workcell
from symbolic.records.quantities import GRAVITY

Problem = tuple[str, str]
"""Key of the workcell file, and a message."""

Both = tuple[Expression, Expression]
"""One value per contact."""

HELD_FLOOR = 1e-9
"""Least force of a ratio's denominator [N]."""


@dataclass(frozen=True)
class ContactLoad:
    """Force and moment that two contacts have to balance. All vectors are along the same axes, for
    example the world's.

    Attributes:
        force, moment: (3,) force [N] and moment about the centre of mass [N m] that the contacts
            exert together on the payload.
        arms: for each contact the vector (3,) from the centre of mass to the nominal contact point
            [m].
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
    """Forces of two contacts that balance a load, along the axes of the load.

    Attributes:
        normal, tangential: (2,) normal forces and magnitudes of the tangential forces [N].
        forces: for each contact the force (3,) on the payload [N].
        shifts: for each contact the shift (3,) of the centre of pressure [m].
        moments: for each contact the moment (3,) on the payload about the nominal contact point [N
            m].
        point_residual: (3,) moment that `forces`, acting at the nominal points, leave unbalanced [N
            m].
        residual: (3,) moment that `forces` and `moments` together leave unbalanced [N m].
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
        """Wrench (6,) of each contact on the payload: force [N], then moment about the nominal
        contact point [N m]."""
        first, second = (ca.vertcat(*pair) for pair in zip(self.forces, self.moments, strict=True))
        return first, second


@dataclass
class ImplicitVariables:
    """Symbols that stand for results of Newton's method while expressions are differentiated.
    Outputs are built from the symbols; `replaced` then inserts the results.

    Attributes:
        steps: number of Newton steps between a symbol and the outputs. One step makes first
            derivatives exact although the symbol counts as constant; two steps make second
            derivatives exact too.
    """

    steps: int = 2
    _found: list[tuple[ca.SX, ca.SX]] = field(default_factory=list)

    def detach(self, value: ca.SX) -> ca.SX:
        """Return a new scalar symbol that stands for the expression `value`."""
        symbol = ca.SX.sym("solved")
        self._found.append((symbol, value))
        return symbol

    @property
    def symbols(self) -> ca.SX:
        """All k symbols, as a column (k,)."""
        return ca.vertcat(ca.SX(0, 1), *[symbol for symbol, _ in self._found])

    @property
    def values(self) -> ca.SX:
        """Expressions (k,) for which the k symbols stand."""
        return ca.vertcat(ca.SX(0, 1), *[value for _, value in self._found])

    def replaced(self, outputs: list[Expression]) -> list[Expression]:
        """Return the expressions `outputs` with every symbol replaced by the expression that it
        stands for.
        """
        if not self._found:
            return outputs
        found: list[Expression] = ca.substitute(outputs, [self.symbols], [self.values])
        return list(ca.cse(found))


class ContactModel(ABC):
    """Contact model of one workcell. Methods assume two pads with opposite normals, unless a
    subclass overrides them.

    Attributes:
        workcell: the workcell; its parameters may be symbols.
        assumption: description of the pads that planned forces assume, for messages.
        has_pressure_limit: True if the shift of the pressure within a patch has a limit of its own,
            because forces do not grow with the moments.
        has_elastic_layers: True if pads are elastic layers (`symbolic.contact.elastic`).
        has_closed_form: True if `hold` computes the forces by formulas, False if they need a convex
            program.
        is_squeeze: True if the arms press the payload between them. Forces are then commanded.
        holders: description of the pads or hands that commanded forces assume, for messages.
        order: words of the command, as in 'press with 80 N'.
        relief: what relieves a job that exceeds a limit, besides slower motion; '' for nothing.
        closing: names of the phases of a job in which arms at rest take hold of the payload.
        opening: names of the phases of a job in which arms at rest let go of the payload.
    """

    assumption: ClassVar[str]
    has_pressure_limit: ClassVar[bool] = False
    has_elastic_layers: ClassVar[bool] = False
    has_closed_form: ClassVar[bool] = True
    is_squeeze: ClassVar[bool] = True
    holders: ClassVar[str] = "pads that press evenly"
    order: ClassVar[str] = "press with"
    relief: ClassVar[str] = "press less (squeeze)"
    closing: ClassVar[tuple[str, ...]] = ("press",)
    opening: ClassVar[tuple[str, ...]] = ("release",)

    def __init__(self, workcell: Workcell) -> None:
        self.workcell = workcell

    def with_workcell(self, workcell: Workcell) -> ContactModel:
        """Return this contact model for another workcell, which must have the same arrangement of
        pads."""
        return type(self)(workcell)

    @property
    def has_scalar_squeeze(self) -> bool:
        """True if the normal force of one pad determines the normal force of the other. A case of
        the uncertainty then requires a single number, the least squeeze."""
        return self.has_closed_form

    @property
    def command_model(self) -> ContactModel:
        """Contact model that computes commanded forces and worst cases in place of this one; by
        default this model itself."""
        return self

    @property
    def pad_parameters(self) -> list[dict[str, Any]]:
        """One dictionary per pad with those fields of `NumberedContact` that this model's formulas
        need beyond the pad's description, by name; by default empty."""
        return [{} for _ in self.workcell.pads]

    @property
    @abstractmethod
    def problem(self) -> Problem | None:
        """Reason why this contact model does not apply, as (key of the workcell file, message).

        None if the contacts can hold the payload under every motion.
        """

    @property
    def level_force(self) -> float:
        """Least normal force of each pad [N] that holds the payload at rest, for two pads with
        horizontal normals."""
        weight = -self.workcell.payload.mass * GRAVITY[2]
        return float(weight / sum(contact.friction for contact in self.workcell.contacts))

    def limited_force(self, normal: Array, whole: Array) -> Array:
        """Return for each robot the force (2,) [N] that must not exceed its reference force. For
        pads it is the magnitude of the whole contact force.

        Args:
            normal: (2,) normal force of each robot [N]; not used.
            whole: (2,) magnitude of each robot's contact force [N]; returned unchanged.
        """
        return whole

    def friction_use(self, normal: Array, tangential: Array) -> Array:
        """Compute for each of n motions how much of the friction is used if the arms press as hard
        as their reference forces allow, (n,). Above 1, even these forces do not hold the payload.

        At their least normal forces, pads always use the whole friction. Therefore both normal
        forces are raised equally, up to the smaller reference force. The needed friction
        coefficient is the sum of both tangential forces over the sum of both raised normal forces.
        The result is its largest value over the samples, divided by the smaller coefficient of the
        pads.

        Args:
            normal, tangential: (n, samples, 2) least normal force, and magnitude of the tangential
                force, of each robot [N].
        """
        difference = np.abs(normal[:, :, 0] - normal[:, :, 1])
        squeeze = 2.0 * float(self.workcell.task.reference_force.min()) - difference
        needed = tangential.sum(axis=2) / np.maximum(squeeze, HELD_FLOOR)
        use: Array = needed.max(axis=1)
        return use / min(contact.friction for contact in self.workcell.contacts)

    @abstractmethod
    def hold(
        self,
        load: ContactLoad,
        implicit: ImplicitVariables | None = None,
        displaced: bool = False,
    ) -> HeldLoad:
        """Compute the least contact forces that balance a load.

        Args:
            load: load on both contacts.
            implicit: stores the results of Newton's method, so that derivatives of the forces
                become exact; None if no derivatives are needed.
            displaced: True if `load.arms` may offset the pads laterally from each other.
        """

    # --- smooth quantities for the polish ---

    @property
    def force_branches(self) -> Array:
        """Coefficients (2, b, 2) of b linear functions of the two `force_quantities` for each
        contact. The contact's normal force is the largest value of its b functions [N]."""
        return np.eye(2)[:, None]

    def force_quantities(self, load: ContactLoad, held: HeldLoad) -> Expression:
        """Compute two quantities (2,) [N] that are smooth in the load and from which the normal
        forces follow: a normal force is the largest of the contact's linear functions
        `force_branches`. By default the quantities are the normal forces themselves.

        Args:
            load: load on both contacts.
            held: least contact forces for this load, from `hold`.
        """
        return held.normal

    def planned_quantities(self, found: Mapping[str, Array]) -> Array:
        """Compute the two `force_quantities` (n, 2) [N] at the n samples of an evaluated carry.

        Args:
            found: arrays of n samples by name, as in `LOAD_OUTPUTS`.
        """
        return found["normal_force"]

    # --- worst cases ---

    def least_friction(self, uncertainty: Uncertainty) -> Array:
        """Compute the friction coefficients (2,) that cover the uncertainty of contact: forces
        computed with them hold for every loss of friction, and every tilt and displacement of the
        pads. A coefficient is zero or negative if no friction is left.

        A pad with friction mu that is tilted by an angle t has the coefficient tan(atan mu - t).
        Pads displaced in opposite directions, by 2 e relative to each other, turn the squeeze into
        a moment. A coefficient lower by 2 e / L, with the distance L of the pads, covers this
        moment.

        Args:
            uncertainty: ranges of friction, tilt and displacements of the pads.
        """
        friction = np.array([contact.friction for contact in self.workcell.contacts])
        left = np.tan(np.arctan(friction * (1.0 - uncertainty.friction)) - uncertainty.turned)
        apart = np.array(2.0 * uncertainty.pad_position + uncertainty.apart)
        return np.asarray(left - self.friction_lost(apart))

    def friction_lost(self, apart: Array) -> Array:
        """Compute how much lower the friction coefficient has to be assumed to cover displaced
        pads.

        Args:
            apart: (k,) displacements of the two pads relative to each other along the faces [m].

        Returns:
            (k,) reductions of the friction coefficient.
        """
        return apart / self.workcell.pad_distance

    def worst_displacements(self, uncertainty: Uncertainty) -> tuple[Array, Array]:
        """Return how displaced pads enter the worst cases of an uncertainty: as a shift of the
        centre of mass, or as cases of their own.

        Args:
            uncertainty: ranges of the centre of mass and of the pads' displacements, among others.

        Returns:
            Half-widths (3,) of the range of the centre of mass along the box axes [m]. They include
            displacements that both pads have in common, which shift the centre of mass relative to
            the pads. Then k cases (k, 4) of the pads' displacements along their tangents, two
            entries per robot [m]; by default one case of zeros, because `least_friction` covers
            opposite displacements.
        """
        normal = self.workcell.contacts[0].T_box_pad[:3, 2]
        across = np.sqrt(np.maximum(1.0 - normal**2, 0.0))
        centre = uncertainty.centre_of_mass + uncertainty.pad_position * across
        return centre, np.zeros((1, 4))

    def commanded_forces(
        self, normal: Expression, friction: Expression, tracking: Expression, opposed: Expression
    ) -> Expression:
        """Compute the normal forces (2,) to command [N]. The commanded force of each robot exceeds
        its least force by the same amount, because the motion fixes the difference of the two
        forces.

        Args:
            normal: (2,) least normal forces of the robots [N].
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
        """Rise of the position-controlled robot's normal force per newton of the other robot's
        commanded force, (2,): entry i holds if robot i is position-controlled.
        """
        return np.ones(2)

    def leading_excess(self, load: ContactLoad, opposed: Expression) -> Expression:
        """Compute the part of robot 1's normal force [N] that does not depend on the commanded
        force of robot 2: the normal force is this part plus `leading_share` times the commanded
        force. With two opposite pads it is the component of the load along the normal of contact 1.

        Args:
            load: load on both contacts.
            opposed: tangential force with which the arms may push against each other [N].
        """
        return ca.dot(load.force, load.axes[:, 2])

    def internal_force_ratio(self, leader: int) -> Array:
        """Return how much the normal force (2,) of each robot rises per newton by which the
        force-controlled robot presses harder. The force-controlled robot's own entry is 1.

        Args:
            leader: index of the robot that is not force-controlled.
        """
        return np.ones(2)

    def raised(self, planned: Array, extra: Array, leader: int) -> Array:
        """Compute the normal forces (n, 2) to command [N] if the force of the force-controlled
        robot rises.

        Args:
            planned: (n, 2) planned normal forces of the robots [N].
            extra: (n,) rise of the force-controlled robot's force [N].
            leader: index of the robot that is not force-controlled.
        """
        return planned + np.multiply.outer(extra, self.internal_force_ratio(leader))

    def squeeze_wrenches(self, leader: int) -> Array:
        """Compute by how much the wrenches of both robots on the payload change per newton by which
        the force-controlled robot presses harder. Forces of pads with opposite normals then act on
        one line, midway between the nominal contact points, and cancel.

        Args:
            leader: index of the robot that is not force-controlled.

        Returns:
            Change (2, 6) of force [N/N] and moment about the robot's nominal contact point [N m/N],
            along the axes of the box.
        """
        first, second = (contact.T_box_pad for contact in self.workcell.contacts)
        normal = first[:3, 2]
        apart = second[:3, 3] - first[:3, 3]
        beside = (apart - (apart @ normal) * normal) / 2.0
        return np.array(
            [
                np.concatenate([sign * normal, np.cross(sign * beside, sign * normal)])
                for sign in (1.0, -1.0)
            ]
        )

    def displacement_margin(self, uncertainty: Uncertainty) -> float:
        """Return how much larger than the uncertainty states the displacement of the pads may
        become before forces can no longer be computed [m]. It is zero or negative if the stated
        displacement is already too large, and infinite for a model that allows any displacement.

        Args:
            uncertainty: ranges of the uncertain quantities, pad displacements among them.
        """
        return np.inf

    # --- changes of the cell ---

    @property
    def strength(self) -> float:
        """Holding force of the weakest hand [N]; 1 for pads. For advice, the forces of a changed
        cell are divided by it, so that cells with weaker and stronger hands can be compared."""
        return 1.0

    @property
    def own_changes(self) -> dict[str, Callable[[Contact], Contact]]:
        """Changes of the contacts that may be proposed to the user with this contact model only; by
        default none. Keys are texts of the changes, such as 'cups 10 mm larger across'. Values are
        functions that take a contact and return its changed copy."""
        return {}

    # --- jobs ---

    def follower(self, leader: int) -> int | None:
        """Return the index of the force-controlled arm; None if neither arm controls a force.

        Args:
            leader: index of the position-controlled arm.
        """
        return 1 - leader

    def approach(self, arm: int) -> Array:
        """Return the unit direction (3,) in which the pad of arm `arm` approaches the payload, box
        frame."""
        return self.workcell.contacts[arm].T_box_pad[:3, 2]

    def held_with(self, commanded: Array) -> Array:
        """Return the normal forces (n, 2) [N] that act on the payload if the forces `commanded` (n,
        2) [N] are commanded. For pads they are equal."""
        return commanded

    def force_use(self, commanded: Array, least: Array) -> dict[str, Array]:
        """Compute how far the forces of a job use their limits.

        Args:
            commanded, least: (n, 2) commanded and least normal forces of the robots [N].

        Returns:
            Ratios (n, 2) of a force to its limit, by name of the limit. For pads there is one,
            'least normal force': the least force over the force that acts.
        """
        return {"least normal force": least / np.maximum(self.held_with(commanded), HELD_FLOOR)}

    def pulled_apart(self, along: Array, across: Array, stiffness: float) -> tuple[Array, Array]:
        """Compute how a displacement of the two pads against each other changes the forces. Both
        arms count as springs of equal stiffness in series.

        Args:
            along, across: (n,) displacement of one pad relative to the other, along its normal and
                across it [m].
            stiffness: stiffness of each arm at its pad [N/m].

        Returns:
            Changes (n,) of the normal forces, and changes (n,) of the least normal forces that hold
            the payload [N].
        """
        friction = min(contact.friction for contact in self.workcell.contacts)
        return stiffness / 2.0 * along, stiffness / 2.0 * across / friction
