"""The contact model of soft fingers: elastic pads that press evenly, on arms that keep the
orientation of their pads (`symbolic.contact.soft_finger`)."""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.contact.force_closure import has_force_closure, least_distance, robot_wrenches
from symbolic.contact.grasp import Grasp
from symbolic.contact.grasp_squeeze import GraspSqueeze
from symbolic.contact.model import ContactLoad, ContactModel, HeldLoad, ImplicitVariables, Problem
from symbolic.contact.soft_finger import SoftPatch, least_soft_squeeze
from symbolic.records import Workcell
from symbolic.records.cell import Uncertainty

PAD_OFFSET_SHARE = 0.9
"""Largest lateral offset of the pads, over friction times their distance. The line between the pads
is then well within both friction cones, so pressing harder balances any moment."""

LARGEST_DISPLACEMENT = 0.2
"""Largest displacement for which forces of pads with any normals are computed, over the least
distance between two pads of different robots."""


def soft_finger(workcell: Workcell) -> ContactModel:
    """Return the contact model of a workcell's soft fingers: by formulas for two pads with opposite
    normals, else by a convex program."""
    return (SoftFinger if workcell.has_opposite_pads else SoftFingerGrasp)(workcell)


class SoftFinger(ContactModel):
    """Contact model of two soft fingers with opposite normals and patches of any shape. Their
    forces have a closed form."""

    assumption = "pads that press evenly, on arms that keep their orientation"
    has_elastic_layers = True

    @property
    def problem(self) -> Problem | None:
        """Reason why this contact model does not apply, as (key of the workcell file, message).
        None if the pads' lateral offset is below a share of friction times the pads' distance, so
        that a larger squeeze holds the payload under every motion."""
        friction = min(contact.friction for contact in self.workcell.contacts)
        beside, room = self.workcell.pad_offset, friction * self.workcell.pad_distance
        if beside < PAD_OFFSET_SHARE * room:
            return None
        return (
            "contacts[1].xyz",
            f"faces a point {beside:g} m beside contacts[0]; pads that press evenly allow less "
            f"than {PAD_OFFSET_SHARE * room:g} m here, {PAD_OFFSET_SHARE:g} of friction times the "
            "pads' distance, so that pressing harder holds under every motion",
        )

    def hold(
        self,
        load: ContactLoad,
        implicit: ImplicitVariables | None = None,
        displaced: bool = False,
    ) -> HeldLoad:
        """Compute the least contact forces that balance a load. Centres of pressure do not shift.
        The pads share the torsion in proportion to their torsion capacities.

        Args:
            load: load on both contacts.
            implicit: stores the results of Newton's method, so that derivatives of the forces
                become exact; None if no derivatives are needed.
            displaced: True if `load.arms` may offset the pads laterally from each other.
        """
        workcell, axes = self.workcell, load.axes
        in_box = workcell.contacts[0].T_box_pad[:3, :3]
        patches = [SoftPatch.of(contact, in_box) for contact in workcell.contacts]
        arms = [ca.mtimes(axes.T, arm) for arm in load.arms]
        held = least_soft_squeeze(
            ca.mtimes(axes.T, load.force),
            ca.mtimes(axes.T, load.moment),
            (arms[0], arms[1]),
            load.friction,
            (patches[0], patches[1]),
            displaced or workcell.has_offset_pads,
            implicit,
        )
        force_1 = ca.mtimes(axes, ca.vertcat(held.tangent_1, held.normal[0]))
        force_2 = ca.mtimes(axes, ca.vertcat(held.tangent_2, -held.normal[1]))
        share = held.torsion / ca.fmax(ca.sum1(held.capacity), 1e-300)
        moment_1, moment_2 = (axes[:, 2] * held.capacity[i] * share for i in (0, 1))
        point = load.moment - ca.cross(load.arms[0], force_1) - ca.cross(load.arms[1], force_2)
        tangential = [ca.sqrt(ca.sumsqr(t) + 1e-24) for t in (held.tangent_1, held.tangent_2)]
        none = ca.SX.zeros(3)
        return HeldLoad(
            held.normal,
            ca.vertcat(*tangential),
            (force_1, force_2),
            (none, none),
            (moment_1, moment_2),
            point,
            point - moment_1 - moment_2,
        )


class SoftFingerGrasp(SoftFinger):
    """Contact model of soft fingers with any normals, one or several per arm. The convex program of
    `symbolic.contact.grasp` computes their forces."""

    has_closed_form = False

    @property
    def problem(self) -> Problem | None:
        """Reason why this contact model does not apply, as (key of the workcell file, message).

        None if friction closes the grasp.
        """
        if has_force_closure(self.workcell):
            return None
        return (
            "contacts",
            "the pads do not close their grasp: no squeeze within their friction cones holds the "
            "payload under every motion; allowed is enough friction (with 5 % to "
            "spare) along the lines between them: turn them towards one another, raise friction "
            "or add a pad (further)",
        )

    def friction_lost(self, apart: Array) -> Array:
        """Return k zeros: worst cases displace these pads explicitly, not by a lower friction.

        Args:
            apart: (k,) displacements of the two robots' pads relative to each other [m].
        """
        return 0.0 * apart

    def worst_displacements(self, uncertainty: Uncertainty) -> tuple[Array, Array]:
        """Return how displaced pads enter the worst cases of an uncertainty.

        Args:
            uncertainty: ranges of the centre of mass and of the pads' displacements, among others.

        Returns:
            Half-widths (3,) of the range of the centre of mass along the box axes, without
            displacements of the pads [m]; and k cases (k, 4) of displacements along the pads'
            tangents, two entries per robot [m]. The cases are the corners of squares around the
            discs within which pads may be displaced; to first order no displacements are worse.
        """
        off = uncertainty.pad_position + uncertainty.apart / 2.0
        signs = product((-1.0, 1.0) if off > 0.0 else (0.0,), repeat=4)
        return uncertainty.centre_of_mass, np.array([off * np.array(at) for at in signs])

    def displacement_margin(self, uncertainty: Uncertainty) -> float:
        """Return how much larger than the uncertainty states the displacement of the pads may
        become before forces can no longer be computed [m]. It is zero or negative if the stated
        displacement is already too large.

        Args:
            uncertainty: ranges of the uncertain quantities, pad displacements among them.
        """
        off = uncertainty.pad_position + uncertainty.apart / 2.0
        return LARGEST_DISPLACEMENT * least_distance(self.workcell) - off

    @property
    def leading_share(self) -> Array:
        """Rise of the position-controlled robot's normal force per newton of the other robot's
        commanded force, (2,): entry i holds if robot i is position-controlled. It follows from the
        internal squeeze of `GraspSqueeze`.
        """
        normals = GraspSqueeze(self.workcell, 1).squeeze_normals()
        return np.asarray(normals / normals[::-1])

    def internal_force_ratio(self, leader: int) -> Array:
        """Return how much the normal force (2,) of each robot rises per newton by which the
        force-controlled robot presses harder. Normal forces rise in the ratio of
        `Grasp.squeeze_normals`.

        Args:
            leader: index of the robot that is not force-controlled.
        """
        normals = Grasp(self.workcell).squeeze_normals()
        return np.asarray(normals / normals[1 - leader])

    def squeeze_wrenches(self, leader: int) -> Array:
        """Compute by how much the wrenches of both robots on the payload change per newton by which
        the force-controlled robot presses harder: an internal squeeze within all friction cones.

        Args:
            leader: index of the robot that is not force-controlled.

        Returns:
            Change (2, 6) of force [N/N] and moment about the robot's nominal contact point [N m/N],
            along the axes of the box.
        """
        grasp = Grasp(self.workcell)
        to_robots = robot_wrenches(self.workcell).reshape(6, -1, 6)
        each = np.einsum("ipj,pj->pi", to_robots, grasp.squeeze_wrenches())
        parts = np.stack([each[np.array(grasp.robots) == robot].sum(axis=0) for robot in (0, 1)])
        axes = self.workcell.contacts[0].T_box_pad[:3, :3]
        wrenches = parts.reshape(2, 2, 3) @ axes.T / grasp.squeeze_normals()[1 - leader]
        return np.asarray(wrenches.reshape(2, 6))
