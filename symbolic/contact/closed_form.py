"""Contact wrenches of two pads with opposite normals: the allocations that have a closed form."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symbolic.contact.paper import allocate, pressure_shift
from symbolic.contact.soft_finger import Detached, SoftPatch, least_soft_squeeze
from symbolic.expression import Expression
from symbolic.records import Allocation, Workcell


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
    arms: tuple[Expression, Expression]
    axes: Expression
    friction: Expression


@dataclass(frozen=True)
class HeldLoad:
    """How two contacts bear a load.

    Attributes:
        normal, tangential: (2,) normal forces and magnitudes of the tangential ones [N].
        force_1, force_2: (3,) on the payload [N].
        shift_1, shift_2: (3,) of the centres of pressure [m].
        moment_1, moment_2: (3,) on the payload about the nominal contact points [N m].
        point_residual, residual: (3,) moment missing with the forces at the nominal points, and
            with the moments [N m].
    """

    normal: Expression
    tangential: Expression
    force_1: Expression
    force_2: Expression
    shift_1: Expression
    shift_2: Expression
    moment_1: Expression
    moment_2: Expression
    point_residual: Expression
    residual: Expression


def held_by(
    workcell: Workcell, allocation: Allocation, asked: ContactLoad, detached: Detached | None = None
) -> HeldLoad:
    """The least contact forces: of the paper, or of soft fingers.

    Args:
        workcell: whose contacts these are.
        allocation: 'paper' or 'soft-finger'.
        asked: what the contacts have to give.
        detached: see `symbolic.contact.soft_finger.Detached`.
    """
    if allocation == "paper":
        return _by_paper(asked)
    return _by_soft_fingers(workcell, asked, detached)


def _by_paper(asked: ContactLoad) -> HeldLoad:
    """Least forces first; then the least shifts of the pressure that carry the moment."""
    axes, mu = asked.axes, asked.friction
    forces = allocate(asked.force, axes[:, 2], (mu[0], mu[1]))
    pushed = (forces.force_1, forces.force_2)
    shift = pressure_shift(asked.moment, asked.arms, pushed, (axes[:, 0], axes[:, 1]))
    return HeldLoad(
        forces.normal,
        forces.tangential,
        *pushed,
        shift.shift_1,
        shift.shift_2,
        ca.cross(shift.shift_1, forces.force_1),
        ca.cross(shift.shift_2, forces.force_2),
        shift.point_residual,
        shift.residual,
    )


def _by_soft_fingers(workcell: Workcell, asked: ContactLoad, detached: Detached | None) -> HeldLoad:
    """Pads that press evenly: no shift, torsion in proportion to what either can carry."""
    axes = asked.axes
    in_box = workcell.contacts[0].T_box_pad[:3, :3]
    patches = [SoftPatch.of(contact, in_box) for contact in workcell.contacts]
    arms = [ca.mtimes(axes.T, arm) for arm in asked.arms]
    held = least_soft_squeeze(
        ca.mtimes(axes.T, asked.force),
        ca.mtimes(axes.T, asked.moment),
        (arms[0], arms[1]),
        asked.friction,
        (patches[0], patches[1]),
        workcell.has_pads_beside,
        detached,
    )
    force_1 = ca.mtimes(axes, ca.vertcat(held.tangent_1, held.normal[0]))
    force_2 = ca.mtimes(axes, ca.vertcat(held.tangent_2, -held.normal[1]))
    share = held.torsion / ca.fmax(ca.sum1(held.capacity), 1e-300)
    moment_1, moment_2 = (axes[:, 2] * held.capacity[i] * share for i in (0, 1))
    point = asked.moment - ca.cross(asked.arms[0], force_1) - ca.cross(asked.arms[1], force_2)
    tangential = [ca.sqrt(ca.sumsqr(t) + 1e-24) for t in (held.tangent_1, held.tangent_2)]
    none = ca.SX.zeros(3)
    return HeldLoad(
        held.normal,
        ca.vertcat(*tangential),
        force_1,
        force_2,
        none,
        none,
        moment_1,
        moment_2,
        point,
        point - moment_1 - moment_2,
    )
