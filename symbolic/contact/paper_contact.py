"""The paper's contact model: least forces first, then pressure shifts that carry the moments."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.contact.model import ContactLoad, ContactModel, HeldLoad, ImplicitVariables, Problem
from symbolic.contact.paper import allocate, normal_force_branches, pressure_shift, split_force
from symbolic.contact.soft_contact import soft_finger
from symbolic.expression import Expression


class PaperContact(ContactModel):
    """Contact model of two round pads with opposite normals whose centres of pressure can be
    commanded.

    Such pads need commanded moments at both wrists, which few cells offer. So commanded forces are
    computed for evenly pressing pads.
    """

    assumption = "pads that choose their pressure, by moments commanded at both wrists"
    has_pressure_limit = True

    @property
    def command_model(self) -> ContactModel:
        """Contact model of evenly pressing pads (`symbolic.contact.soft_contact`), used for
        commanded forces and worst cases."""
        return soft_finger(self.workcell)

    @property
    def problem(self) -> Problem | None:
        """Reason why this contact model does not apply, as (key of the workcell file, message).

        None if two round pads with opposite normals hold the payload.
        """
        workcell = self.workcell
        if workcell.has_facing_pads:
            return None
        first, second = (contact.T_box_pad[:3, 2] for contact in workcell.contacts)
        turned = np.degrees(np.arccos(np.clip(-first @ second, -1.0, 1.0)))
        return (
            "contacts[1].xyz",
            f"belongs to {len(workcell.pads)} pads, with a normal {turned:.4g} degrees off the "
            "opposite of contacts[0]; the paper's allocation allows two round pads with "
            "opposite normals: task.allocation = 'soft-finger' takes any",
        )

    def hold(
        self,
        load: ContactLoad,
        implicit: ImplicitVariables | None = None,
        displaced: bool = False,
    ) -> HeldLoad:
        """Compute the least contact forces (paper Eqs. 38-42) and the pressure shifts (Eqs. 51-59)
        that balance a load.

        Args:
            load: load on both contacts.
            implicit: not used.
            displaced: not used.
        """
        axes, mu = load.axes, load.friction
        normal, tangential, forces = allocate(load.force, axes[:, 2], (mu[0], mu[1]))
        tangents = axes[:, 0], axes[:, 1]
        shifts, point, residual = pressure_shift(load.moment, load.arms, forces, tangents)
        moments = ca.cross(shifts[0], forces[0]), ca.cross(shifts[1], forces[1])
        return HeldLoad(normal, tangential, forces, shifts, moments, point, residual)

    @property
    def force_branches(self) -> Array:
        """Coefficients (2, 5, 2) of each contact's five `normal_force_branches`. A branch is a
        linear function of the normal component F_n and the tangential magnitude F_t of the required
        force."""
        f_n, f_t = ca.SX.sym("f_n"), ca.SX.sym("f_t")
        contacts = self.workcell.contacts
        second = normal_force_branches(f_n, f_t, (contacts[0].friction, contacts[1].friction))
        split = ca.vertcat(f_n, f_t)
        return np.array(
            [ca.DM(ca.jacobian(second + own * f_n, split)).full() for own in (1.0, 0.0)]
        )

    def force_quantities(self, load: ContactLoad, held: HeldLoad) -> Expression:
        """Compute the normal component F_n and the tangential magnitude F_t of the required force.

        Args:
            load: load on both contacts, of which only the force is used.
            held: not used.

        Returns:
            (2,) F_n and F_t [N].
        """
        return ca.vertcat(*split_force(load.force, load.axes[:, 2])[:2])

    def planned_quantities(self, found: Mapping[str, Array]) -> Array:
        """Compute the normal component F_n and the tangential magnitude F_t of the required force
        at n samples, (n, 2) [N].

        The tangential forces of both contacts have the same direction, so F_t is the sum of their
        magnitudes.

        Args:
            found: arrays of n samples by name, as in `LOAD_OUTPUTS`.
        """
        normal, tangential = found["normal_force"], found["tangential_force"]
        return np.column_stack([normal[:, 0] - normal[:, 1], tangential.sum(axis=1)])
