"""As `symbolic.physics.case_squeeze`, for pads anywhere: the least commanded force of a case.

A displaced pad counts as a smaller one that lies within it: a disc shrinks by the displacement, a
rectangle in proportion, so that its shorter side does.
"""

from __future__ import annotations

import casadi as ca

from symbolic.physics.case_squeeze import CASE_SIZE, case_load_function, case_parts
from symbolic.physics.grasp_squeeze import GraspSqueeze, commanded_forces, held_slack
from symbolic.workcell.records import Workcell


def case_grasp_function(workcell: Workcell, commanded: int) -> ca.Function:
    """pose, rate, second_rate (6,) and a case (15,), see `case_squeeze.CASE_SIZES`, to
    normal_force (2,) [N], see `grasp_squeeze.commanded_forces`.

    Args:
        commanded: index of the robot whose force is commanded.

    Raises:
        SettingsError: the pads do not close their grasp.
    """
    motion = [ca.MX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case = ca.MX.sym("case", CASE_SIZE)
    friction, *_ = case_parts(case)
    squeeze = GraspSqueeze(workcell, commanded)
    load = _origin_load_function(workcell)(*motion, case)
    force = commanded_forces(squeeze, load, friction, _sizes(workcell, case))
    names = ["pose", "rate", "second_rate", "case"]
    return ca.Function("case_grasp", [*motion, case], [force], names, ["normal_force"])


def case_grasp_slack_function(workcell: Workcell, commanded: int) -> ca.Function:
    """pose, rate, second_rate (6,), a case (15,) and the commanded force [N] to slack: where it is
    positive, one pressure that is known holds the case; elsewhere `case_grasp_function` knows."""
    motion = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case, force = ca.SX.sym("case", CASE_SIZE), ca.SX.sym("force")
    friction, *_ = case_parts(case)
    squeeze = GraspSqueeze(workcell, commanded)
    load = _origin_load_function(workcell)(*motion, case)
    slack = held_slack(squeeze, load, friction, _sizes(workcell, case), force)
    names = ["pose", "rate", "second_rate", "case", "force"]
    inputs = [*motion, case, force]
    return ca.Function("case_grasp_slack", inputs, ca.cse([slack]), names, ["slack"])


def least_reaches(workcell: Workcell) -> tuple[float, float]:
    """Of each robot's patches the least radius or half side [m]."""
    first, second = (
        min(pad.patch_radius if pad.half_sides is None else min(pad.half_sides) for pad in pads)
        for pads in ((contact, *contact.further) for contact in workcell.contacts)
    )
    return first, second


def _sizes(workcell: Workcell, case: ca.SX | ca.MX) -> ca.SX | ca.MX:
    """(2,) of the robots' patches over the cell's own."""
    _, radius, *_, displacement = case_parts(case)
    own = ca.DM([contact.patch_radius for contact in workcell.contacts])
    lengths = [ca.norm_2(displacement[2 * i : 2 * i + 2]) for i in (0, 1)]
    return radius / own - ca.vertcat(*lengths) / ca.DM(least_reaches(workcell))


def _origin_load_function(workcell: Workcell) -> ca.Function:
    """The load about the box frame's origin (6,), box axes."""
    inputs = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    inputs.append(ca.SX.sym("case", CASE_SIZE))
    force, moment = case_load_function(workcell)(*inputs)
    about = moment + ca.cross(ca.DM(workcell.payload.centre_of_mass), force)
    return ca.Function("origin_load", inputs, ca.cse([ca.vertcat(force, about)]))
