"""Least contact forces of two round patches that face one another and carry force and moment.

    minimise |f_1|^2 + |f_2|^2  subject to  both wrenches balance what the motion needs,
                                            each lies within its patch's cone

(`symbolic.contact.round_patch`), where the paper (Eqs. 38-42, 51-59) takes the least forces first
and asks for the moment afterwards. The wrench of contact 1 has six free components; that of
contact 2 is what is left (`symbolic.contact.central_path`). Pressing harder carries anything, so a
start is at hand. Pads that do not face one another: `symbolic.contact.grasp`.

Coordinates: tangents a, b and normal n = a x b of contact 1. Shifts and arms in m, forces in N.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import casadi as ca

from symbolic.contact.central_path import START_WEIGHT, differentiable_least_effort, least_effort
from symbolic.contact.force_closure import WRENCH_SIZE
from symbolic.contact.patches import Patch
from symbolic.contact.round_patch import RoundPatch, cross_2, patch_slack
from symbolic.expression import Expression, reciprocal

Objective = Literal["effort", "squeeze"]
"""|f_1|^2 + |f_2|^2 or N_1 + N_2."""

SCALE_FLOOR, START_FLOOR = 1e-9, 1e-3
"""Force scale [N] and squeeze over it to start from where nothing has to be carried."""

START_SHARE = 0.97
"""Of the way to the cones' boundary that what is to be carried takes a start."""

LOWEST = (4.0 / 3.0) ** 0.5
"""Bound of what a wrench without normal force takes from a patch's eigenvalues, over its length:
their sum is zero and that of their squares is twice its square (Samuelson)."""

BALANCE_SIZE = 9
CELL_SIZES = (("balance", BALANCE_SIZE), ("friction", 2), ("radius", 2))


@dataclass(frozen=True)
class JointAllocation:
    """Wrenches of both contacts, in the coordinates of the module.

    Attributes:
        normal: (2,) N_1, N_2 [N].
        tangent_1, tangent_2: (2,) tangential forces on the box [N].
        shift_1, shift_2: (2,) of the centres of pressure [m].
        torsion: (2,) moments about n through the centres of pressure, on the box [N m].
    """

    normal: Expression
    tangent_1: Expression
    tangent_2: Expression
    shift_1: Expression
    shift_2: Expression
    torsion: Expression


def balance_of(
    force: Expression, moment: Expression, arms: tuple[Expression, Expression]
) -> Expression:
    """What the contacts have to balance (9,), see `BALANCE_SIZE`.

    Args:
        force: (3,) resultant force.
        moment: (3,) required moment about the centre of mass.
        arms: (3,) each, from the centre of mass to the nominal contact points.
    """
    rest = moment - ca.cross(arms[1], force)
    return ca.vertcat(force[2], force[:2], -rest[1], rest[0], rest[2], arms[0] - arms[1])


def allocate_jointly(
    balance: ca.MX, friction: ca.MX, radius: ca.MX, differentiable: bool = False
) -> JointAllocation:
    """The least contact forces for what the contacts have to balance.

    There always are some, because pressing harder carries everything, if the patches overlap when
    seen along the normal.

    Args:
        balance: (9,), see `balance_of`.
        friction: (2,) Coulomb coefficients of the contacts.
        radius: (2,) radii of the patches [m].
        differentiable: whether first derivatives are wanted
            (`symbolic.contact.central_path.differentiable_least_effort`).
    """
    return _least((balance, friction, radius), "effort", differentiable)


def least_squeeze(
    balance: ca.MX, friction: ca.MX, radius: ca.MX, differentiable: bool = False
) -> JointAllocation:
    """As `allocate_jointly`, with the least N_1 + N_2 in place of the least effort.

    The balance fixes N_1 - N_2, so that both are as small as they can be: with less of either no
    pressure on the patches carries what is asked, with more of both some does.
    """
    return _least((balance, friction, radius), "squeeze", differentiable)


def _least(
    cell: tuple[ca.MX, ca.MX, ca.MX], objective: Objective, differentiable: bool
) -> JointAllocation:
    balance, friction, radius = cell
    scale = ca.sqrt(ca.sumsqr(balance[:3]) + ca.sumsqr(balance[3:5] / balance[8]) + SCALE_FLOOR**2)
    scaled = (ca.vertcat(balance[:6] / scale, balance[6:]), friction, radius)
    solve = differentiable_least_effort if differentiable else least_effort
    wrenches = solve(OppositePads(objective), *scaled)
    return JointAllocation(*_in_newtons()(wrenches, scale, friction, radius))


@dataclass(frozen=True)
class OppositePads:
    """Two round pads that face one another, as a `symbolic.contact.central_path.Program`.

    Its inputs are `balance_of`, over the force's scale, the coefficients and the radii, so that all
    of these may vary.

    Attributes:
        objective: what is minimised.
    """

    objective: Objective
    patches: tuple[Patch, ...] = (RoundPatch(), RoundPatch())
    cell_sizes: tuple[tuple[str, int], ...] = CELL_SIZES

    def left(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """What contact 1 leaves to contact 2, its normal force along -n."""
        (wrench,), (balance, friction, radius) = wrenches, cell
        tangent, moment = friction[0] * wrench[1:3], radius[0] * wrench[3:5]
        # Moments about pad 2: (p_1 - p_2) x f_1 and the contacts' own make up what is required.
        moment_2 = moment - balance[8] * tangent + wrench[0] * balance[6:8] - balance[3:5]
        about_n = balance[5] - cross_2(balance[6:8], tangent) - friction[0] * radius[0] * wrench[5]
        over_mu, over_r = reciprocal(friction[1]), reciprocal(radius[1])
        return ca.vertcat(
            wrench[0] - balance[0],
            (balance[1:3] - tangent) * over_mu,
            moment_2 * over_r,
            about_n * (over_mu * over_r),
        )

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """Half the sum of the squared forces, or the sum of the normal ones."""
        if self.objective == "squeeze":
            return wrenches[0][0] + wrenches[1][0]
        mu = cell[1]
        forces = [ca.vertcat(w[0], mu[i] * w[1:3]) for i, w in enumerate(wrenches)]
        return ca.sumsqr(ca.vertcat(*forces)) / 2.0

    def start(self, cell: list[ca.SX]) -> tuple[list[ca.SX], ca.SX]:
        """Wrenches within both cones, pressed as hard as what else they carry asks."""
        balance, friction, radius = cell
        # Tangential forces that leave little moment to be carried: least squares, scaled.
        over_mu_1, over_mu_2 = 1.0 / friction[0] ** 2, 1.0 / friction[1] ** 2
        lever = balance[8] / ca.sum1(radius)
        by_lever = lever / ca.sum1(radius)
        tangent = (over_mu_2 * balance[1:3] - by_lever * balance[3:5]) / (
            over_mu_1 + over_mu_2 + lever**2
        )
        lighter = ca.fmax(balance[0], 0.0)
        asked = [_length(wrench[1:]) for wrench in _shared(cell, tangent, lighter)]
        # The squeeze itself tilts the box where the pads do not face one another.
        overlap = 1.0 - _length(balance[6:8]) / ca.sum1(radius)
        pressed = LOWEST * ca.fmax(*asked) / (START_SHARE * overlap) + START_FLOOR
        return _shared(cell, tangent, pressed + lighter), ca.SX(START_WEIGHT)


def even_slack(balance: ca.SX, friction: ca.SX, radius: ca.SX, n_1: ca.SX) -> ca.SX:
    """Whether wrenches hold that share everything evenly, if contact 1 presses with n_1 [N].

    Positive where both lie within their cones: then the patches carry what is asked. Where it is
    not, another pressure still may.

    Args:
        balance, friction, radius: as in `allocate_jointly`.
    """
    left = []
    for wrench in _evenly([balance, friction, radius], n_1):
        normal = wrench[0]
        left += [
            normal,
            1.0 - ca.sumsqr(wrench[1:3]) / normal**2,
            1.0 - ca.sumsqr(wrench[3:5]) / normal**2,
            patch_slack(wrench) / normal**4,
        ]
    return ca.mmin(ca.vertcat(*left))


def _evenly(cell: list[ca.SX], n_1: ca.SX) -> list[ca.SX]:
    """`_shared` with tangential forces in proportion to friction."""
    balance, friction, _ = cell
    return _shared(cell, friction[0] / ca.sum1(friction) * balance[1:3], n_1)


def _shared(cell: list[ca.SX], tangent: ca.SX, n_1: ca.SX) -> list[ca.SX]:
    """Scaled wrenches (6,) of both contacts under a normal force and a tangential force (2,) of
    contact 1, moments in proportion to radii and torsion to friction times radius."""
    balance, friction, radius = cell
    tilt = balance[8] * tangent + balance[3:5]
    about_n = balance[5] - cross_2(balance[6:8], tangent)
    # A share over the contact's own friction or radius is the whole over the sum of both.
    first = ca.vertcat(
        n_1,
        tangent / friction[0],
        (tilt - n_1 * balance[6:8]) / ca.sum1(radius),
        about_n / ca.sum1(friction * radius),
    )
    return [first, OppositePads("effort").left([first], cell)]


@cache
def _in_newtons() -> ca.Function:
    """The fields of `JointAllocation` from both scaled wrenches."""
    wrenches, scale = ca.SX.sym("wrenches", 2 * WRENCH_SIZE), ca.SX.sym("scale")
    mu, r = ca.SX.sym("friction", 2), ca.SX.sym("radius", 2)
    normal, tangent, shift, torsion = [], [], [], []
    for i, one in enumerate(ca.vertsplit(wrenches, WRENCH_SIZE)):
        normal.append(scale * one[0])
        tangent.append(scale * mu[i] * one[1:3])
        shift.append(r[i] * one[3:5] / one[0])
        moment = scale * mu[i] * r[i] * one[5]
        torsion.append(moment - cross_2(shift[i], tangent[i]))
    outputs = [ca.vertcat(*normal), *tangent, *shift, ca.vertcat(*torsion)]
    return ca.Function("in_newtons", [wrenches, scale, mu, r], outputs)


def _length(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector))
