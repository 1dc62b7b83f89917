"""Least contact forces of two round patches that carry a force and a moment together.

    minimise |f_1|^2 + |f_2|^2  subject to  both wrenches balance what the motion needs,
                                            each lies within its patch's cone

(`symbolic.physics.patch_cone`), where the paper (Eqs. 38-42, 51-59) takes the least forces first
and asks for the moment afterwards. The wrench of contact 1 has six free components; that of
contact 2 is what is left. A barrier method follows the central path with a fixed number of Newton
steps, so that the whole is one expression and compiles. Each step aims at a lower barrier with the
curvature of the present one, which takes the tangent of the path and the correction towards it in
one solve, and goes at most `STEP_SHARE` of the way to a bound of the cones' boundary. Pressing
harder carries anything, so a start is at hand.

Coordinates: tangents a, b and normal n = a x b of contact 1. Shifts and arms in m, forces in N.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import casadi as ca

from symbolic.expression import Expression
from symbolic.physics.patch_cone import (
    BARRIER_DEGREE,
    WRENCH_SIZE,
    cross_2,
    patch_barrier,
    patch_slack,
)

STEPS = 26
"""Newton steps before the one that is differentiated."""

FINAL_BARRIER = 1e-8
"""Last weight of the barriers over the objective, which ends above the least by at most twice the
degree of a barrier times this: 6e-8 of it."""

BARRIER_SHRINK = 0.2
"""Of the barriers' weight per step. Twice as fast, one case in some thousands leaves the central
path so far that it does not come back in time."""

STEP_SHARE = 0.9

Objective = Literal["effort", "squeeze"]
"""|f_1|^2 + |f_2|^2 or N_1 + N_2."""

SCALE_FLOOR, START_FLOOR = 1e-9, 1e-3
"""Force scale [N] and squeeze over it to start from where nothing has to be carried."""

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


def allocate_jointly(balance: ca.MX, friction: ca.MX, radius: ca.MX) -> JointAllocation:
    """The least contact forces for what the contacts have to balance.

    There always are some, because pressing harder carries everything, if the patches overlap when
    seen along the normal. First derivatives are those of the central path's point: the last Newton
    step is differentiated, the point it starts from is not. Second ones are not to be had so.

    Args:
        balance: (9,), see `balance_of`.
        friction: (2,) Coulomb coefficients of the contacts.
        radius: (2,) radii of the patches [m].
    """
    return _least(balance, friction, radius, "effort")


def least_squeeze(balance: ca.MX, friction: ca.MX, radius: ca.MX) -> JointAllocation:
    """As `allocate_jointly`, with the least N_1 + N_2 in place of the least effort.

    The balance fixes N_1 - N_2, so that both are as small as they can be: with less of either no
    pressure on the patches carries what is asked, with more of both some does.
    """
    return _least(balance, friction, radius, "squeeze")


def _least(balance: ca.MX, friction: ca.MX, radius: ca.MX, objective: Objective) -> JointAllocation:
    scale = ca.sqrt(ca.sumsqr(balance[:3]) + ca.sumsqr(balance[3:5] / balance[8]) + SCALE_FLOOR**2)
    cell = (ca.vertcat(balance[:6] / scale, balance[6:]), friction, radius)
    wrench, _ = _newton_step(objective)(*_central_path(objective)(*cell), *cell)
    return JointAllocation(*_in_newtons()(wrench, scale, *cell))


@cache
def _central_path(objective: Objective) -> ca.Function:
    """Scaled wrench of contact 1 and the barriers' weight near the end of the central path.

    Its derivatives count as zero.
    """
    cell = [ca.MX.sym(name, size) for name, size in CELL_SIZES]
    wrench, barrier = _start(objective)(*cell)
    for _ in range(STEPS):
        wrench, barrier = _newton_step(objective)(wrench, barrier, *cell)
    constant = {"is_diff_in": [False] * len(cell), "is_diff_out": [False, False]}
    return ca.Function("central_path", cell, [wrench, barrier], constant)


def _both(wrench: ca.SX, cell: list[ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Scaled wrenches (6,) of both contacts: that of contact 1 and what it leaves to contact 2."""
    balance, friction, radius = cell
    tangent, moment = friction[0] * wrench[1:3], radius[0] * wrench[3:5]
    # Moments about pad 2: (p_1 - p_2) x f_1 and the contacts' own make up what is required.
    moment_2 = moment - balance[8] * tangent + wrench[0] * balance[6:8] - balance[3:5]
    about_n = balance[5] - cross_2(balance[6:8], tangent) - friction[0] * radius[0] * wrench[5]
    second = ca.vertcat(
        wrench[0] - balance[0],
        (balance[1:3] - tangent) / friction[1],
        moment_2 / radius[1],
        about_n / (friction[1] * radius[1]),
    )
    return wrench, second


@cache
def _newton_step(objective: Objective) -> ca.Function:
    """wrench (6,), barrier's weight and the cell to the next wrench and weight."""
    wrench, barrier = ca.SX.sym("wrench", WRENCH_SIZE), ca.SX.sym("barrier")
    cell = [ca.SX.sym(name, size) for name, size in CELL_SIZES]
    friction = cell[1]
    pair = _both(wrench, cell)
    forces = ca.vertcat(
        *[ca.vertcat(w[0], mu * w[1:3]) for w, mu in zip(pair, ca.vertsplit(friction), strict=True)]
    )
    least = ca.sumsqr(forces) / 2.0 if objective == "effort" else pair[0][0] + pair[1][0]
    gradient, hessian = ca.gradient(least, wrench), ca.hessian(least, wrench)[0]
    target = ca.fmax(BARRIER_SHRINK * barrier, FINAL_BARRIER * least)
    local = []
    for one in pair:
        change = ca.jacobian(one, wrench)
        slope, curvature = patch_barrier()(one)
        gradient += target * ca.mtimes(change.T, slope)
        hessian += barrier * ca.mtimes([change.T, curvature, change])
        local.append((change, slope, curvature))
    direction = -ca.ldl_solve(gradient, *ca.ldl(hessian, False))
    # Along the step the cone's matrix has relative eigenvalues with this sum and sum of squares, so
    # that none is below their mean less sqrt(2) of their deviation (Samuelson's inequality).
    lowest = []
    for change, slope, curvature in local:
        step = ca.mtimes(change, direction)
        mean = -ca.dot(slope, step) / 3.0
        variance = ca.dot(step, ca.mtimes(curvature, step)) / 3.0 - mean**2
        lowest.append(mean - ca.sqrt(2.0 * ca.fmax(variance, 0.0)))
    share = ca.fmin(1.0, STEP_SHARE / ca.fmax(-ca.fmin(*lowest), STEP_SHARE))
    return ca.Function(
        "newton_step",
        [wrench, barrier, *cell],
        ca.cse([wrench + share * direction, barrier + share * (target - barrier)]),
    )


@cache
def _start(objective: Objective) -> ca.Function:
    """A wrench well within both cones, from pressing hard, and the weight of its barriers."""
    balance, friction, radius = cell = [ca.SX.sym(name, size) for name, size in CELL_SIZES]
    _, tilt, about_n = _shared_evenly(cell)
    # The squeeze itself tilts the box where the pads do not face one another.
    overlap = 1.0 - _length(balance[6:8]) / ca.sum1(radius)
    asked = (
        _length(balance[1:3]) / ca.sum1(friction)
        + _length(tilt) / ca.sum1(radius)
        + ca.fabs(about_n) / ca.sum1(friction * radius)
        + ca.fabs(balance[0])
        + START_FLOOR
    )
    n_1 = 2.0 * asked / overlap + ca.fmax(balance[0], 0.0)
    weight = n_1**2 if objective == "effort" else n_1
    return ca.Function("start", cell, [_evenly(cell, n_1), weight / BARRIER_DEGREE])


def even_slack(balance: ca.SX, friction: ca.SX, radius: ca.SX, n_1: ca.SX) -> ca.SX:
    """Whether wrenches hold that share everything evenly, if contact 1 presses with n_1 [N].

    Positive where both lie within their cones: then the patches carry what is asked. Where it is
    not, another pressure still may.

    Args:
        balance, friction, radius: as in `allocate_jointly`.
    """
    cell = [balance, friction, radius]
    left = []
    for wrench in _both(_evenly(cell, n_1), cell):
        normal = wrench[0]
        left += [
            normal,
            1.0 - ca.sumsqr(wrench[1:3]) / normal**2,
            1.0 - ca.sumsqr(wrench[3:5]) / normal**2,
            patch_slack(wrench) / normal**4,
        ]
    return ca.mmin(ca.vertcat(*left))


def _shared_evenly(cell: list[ca.SX]) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Tangential force of contact 1 in proportion to friction; the moments in the contact plane,
    but for the squeeze's, and about n that then are to be carried."""
    balance, friction, _ = cell
    tangent = friction[0] / ca.sum1(friction) * balance[1:3]
    about_n = balance[5] - cross_2(balance[6:8], tangent)
    return tangent, balance[8] * tangent + balance[3:5], about_n


def _evenly(cell: list[ca.SX], n_1: ca.SX) -> ca.SX:
    """Scaled wrench of contact 1 (6,) under a normal force, moments in proportion to radii and
    torsion to friction times radius."""
    balance, friction, radius = cell
    tangent, tilt, about_n = _shared_evenly(cell)
    # A share over the contact's own friction or radius is the whole over the sum of both.
    return ca.vertcat(
        n_1,
        tangent / friction[0],
        (tilt - n_1 * balance[6:8]) / ca.sum1(radius),
        about_n / ca.sum1(friction * radius),
    )


@cache
def _in_newtons() -> ca.Function:
    """The fields of `JointAllocation` from contact 1's scaled wrench."""
    wrench, scale = ca.SX.sym("wrench", WRENCH_SIZE), ca.SX.sym("scale")
    cell = [ca.SX.sym(name, size) for name, size in CELL_SIZES]
    normal, tangent, shift, torsion = [], [], [], []
    for i, one in enumerate(_both(wrench, cell)):
        friction, radius = cell[1][i], cell[2][i]
        normal.append(scale * one[0])
        tangent.append(scale * friction * one[1:3])
        shift.append(radius * one[3:5] / one[0])
        moment = scale * friction * radius * one[5]
        torsion.append(moment - cross_2(shift[i], tangent[i]))
    outputs = [ca.vertcat(*normal), *tangent, *shift, ca.vertcat(*torsion)]
    return ca.Function("in_newtons", [wrench, scale, *cell], outputs)


def _length(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector))
