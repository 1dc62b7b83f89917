"""The least squeeze that holds a moving box in one case of what is not exactly known.

A case says what friction, mass, centre of mass, pad positions and disturbance really are. What is
known of the payload's inertia is taken to hold about the nominal centre of mass, whatever the true
one, and to grow with the mass: with it the required force and moment are affine in the centre of
mass and in the disturbance, each for itself.
"""

from __future__ import annotations

import casadi as ca

from symbolic.physics.joint_allocation import balance_of, even_slack, least_squeeze
from symbolic.physics.payload_load import resultant_force
from symbolic.physics.pressure import required_moment
from symbolic.physics.rotation import angular_acceleration, angular_velocity, rotation_matrix
from symbolic.workcell.records import Workcell

CASE_SIZES = {
    "friction": 2,
    "radius": 2,
    "mass": 1,
    "centre_of_mass": 3,
    "disturbance": 3,
    "displacement": 4,
}
"""Parts of a case, in order: coefficients; radii of the patches [m]; mass [kg]; centre of mass in
the box frame [m]; acceleration beside the motion's, world frame [m/s^2]; displacements of both
pads along the tangents of contact 1 [m], of pads anywhere along their own."""

SQUARED_SPEED_FLOOR = 1e-12
"""Of u'^2 [1/s^2]; what it adds to a force is far below rounding."""

CASE_SIZE = sum(CASE_SIZES.values())


def case_squeeze_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate (6,) and a case (15,), see `CASE_SIZES`, to normal_force (2,) [N].

    With the least squeeze the patches can carry the case; with more they can, with less not.
    """
    motion = [ca.MX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case = ca.MX.sym("case", CASE_SIZE)
    friction, radius, *_ = case_parts(case)
    held = least_squeeze(_balance_function(workcell)(*motion, case), friction, radius)
    names = ["pose", "rate", "second_rate", "case"]
    return ca.Function("case_squeeze", [*motion, case], [held.normal], names, ["normal_force"])


def case_gradient_function(workcell: Workcell) -> ca.Function:
    """As `case_squeeze_function`, and slope (NumPy shape (2, 18)), of each force by pose, rate and
    second_rate."""
    motion = [ca.MX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case = ca.MX.sym("case", CASE_SIZE)
    friction, radius, *_ = case_parts(case)
    balance = _balance_function(workcell)(*motion, case)
    force = least_squeeze(balance, friction, radius, differentiable=True).normal
    slope = ca.densify(ca.horzcat(*[ca.jacobian(force, part) for part in motion]).T)
    names = ["pose", "rate", "second_rate", "case"]
    outputs = ["normal_force", "slope"]
    return ca.Function("case_gradient", [*motion, case], [force, slope], names, outputs)


def case_slopes_function(workcell: Workcell) -> ca.Function:
    """Box pose and its derivatives by u (6,), u'', u'^2 and a case (15,), see `CASE_SIZES`, to
    normal_force (2,) [N] as of `case_squeeze_function`, and slope (NumPy shape (2, 20)), of each
    force by pose, both derivatives, u'' and u'^2."""
    path = [ca.MX.sym(name, 6) for name in ("pose", "first", "second")]
    a, w, case = ca.MX.sym("a"), ca.MX.sym("w"), ca.MX.sym("case", CASE_SIZE)
    pose, first, second = path
    # A root has no slope at rest, what follows from its square has.
    motion = (pose, first * ca.sqrt(w + SQUARED_SPEED_FLOOR), first * a + second * w)
    friction, radius, *_ = case_parts(case)
    balance = _balance_function(workcell)(*motion, case)
    held = least_squeeze(balance, friction, radius, differentiable=True)
    slope = ca.densify(ca.jacobian(held.normal, ca.vertcat(*path, a, w)).T)
    names = ["pose", "first", "second", "a", "w", "case"]
    outputs = ["normal_force", "slope"]
    return ca.Function("case_slopes", [*path, a, w, case], [held.normal, slope], names, outputs)


def case_difference_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate (6,) and a case (15,), see `CASE_SIZES`, to difference N_1 - N_2 [N],
    which no squeeze changes."""
    motion = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case = ca.SX.sym("case", CASE_SIZE)
    difference = ca.cse([_balance_function(workcell)(*motion, case)[0]])
    names = ["pose", "rate", "second_rate", "case"]
    return ca.Function("case_difference", [*motion, case], difference, names, ["difference"])


def case_slack_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate (6,), a case (15,), force [N] and arm to slack.

    With the force commanded of the arm (0 or 1), a pressure that shares everything evenly holds the
    case where slack is positive; elsewhere `case_squeeze_function` knows. It takes a
    thirtieth of that one's time.
    """
    motion = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case, force, arm = ca.SX.sym("case", CASE_SIZE), ca.SX.sym("force"), ca.SX.sym("arm")
    friction, radius, *_ = case_parts(case)
    balance = _balance_function(workcell)(*motion, case)
    n_1 = force + arm * balance[0]
    names = ["pose", "rate", "second_rate", "case", "force", "arm"]
    slack = ca.cse([even_slack(balance, friction, radius, n_1)])
    return ca.Function("case_slack", [*motion, case, force, arm], slack, names, ["slack"])


def case_parts(case: ca.SX | ca.MX) -> list[ca.SX | ca.MX]:
    """The parts of a case (15,), see `CASE_SIZES`."""
    ends = [0]
    for size in CASE_SIZES.values():
        ends.append(ends[-1] + size)
    return list(ca.vertsplit(case, ends))


def _balance_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate and a case to what the contacts have to balance (9,)."""
    motion = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case = ca.SX.sym("case", CASE_SIZE)
    *_, displacement = case_parts(case)
    in_box = case_load_function(workcell)(*motion, case)
    nominal = ca.DM(workcell.payload.centre_of_mass)
    axes = ca.DM(workcell.contacts[0].T_box_pad[:3, :3])
    arms = [
        ca.mtimes(axes.T, ca.DM(contact.T_box_pad[:3, 3]) - nominal)
        + ca.vertcat(displacement[2 * i : 2 * i + 2], 0.0)
        for i, contact in enumerate(workcell.contacts)
    ]
    force, moment = (ca.mtimes(axes.T, part) for part in in_box)
    return ca.Function(
        "case_balance", [*motion, case], [balance_of(force, moment, (arms[0], arms[1]))]
    )


def case_load_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate and a case to the force and the moment about the nominal centre of
    mass that the case asks for, (3,) each, box axes."""
    pose, rate, second = motion = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    case = ca.SX.sym("case", CASE_SIZE)
    _, _, mass, centre, disturbance, _ = case_parts(case)
    payload = workcell.payload
    turned = workcell.task.orientation
    rotation = rotation_matrix(turned, pose[3:])
    omega = angular_velocity(turned, pose[3:], rate[3:])
    alpha = angular_acceleration(turned, pose[3:], rate[3:], second[3:])
    share = mass / payload.mass
    nominal = ca.DM(payload.centre_of_mass)
    pulled = second[:3] + disturbance

    def resultant(offset: ca.SX | ca.DM) -> ca.SX:
        return resultant_force(payload.mass, ca.mtimes(rotation, offset), omega, alpha, pulled)

    # About the nominal centre of mass; the true one's distance turns the force on a mass there.
    turning = required_moment(ca.SX(ca.DM(payload.inertia)), rotation, omega, alpha)
    moment = turning + ca.cross(ca.mtimes(rotation, centre - nominal), resultant(nominal))
    parts = [share * ca.mtimes(rotation.T, part) for part in (resultant(centre), moment)]
    return ca.Function("case_load", [*motion, case], parts)
