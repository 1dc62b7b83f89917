"""The contact forces at one sample of the box motion, as one CasADi function.

It joins rotation, contact forces and centres of pressure (paper Section 4.4). The contact model
gives the forces as an expression, or the program of `symbolic.contact.grasp` computes them.
"""

from __future__ import annotations

import casadi as ca

from symbolic.contact.force_closure import WRENCH_SIZE
from symbolic.contact.grasp import Grasp, grasp_wrenches
from symbolic.contact.model import ContactLoad
from symbolic.contact.paper import required_force, required_moment
from symbolic.contact.registry import contact_model
from symbolic.expression import (
    Expression,
    as_mx,
    mx_parameters,
    named_function,
    number,
    sx_parameters,
)
from symbolic.path.rotation import angular_acceleration, angular_velocity, rotation_matrix
from symbolic.records import Workcell

LOAD_OUTPUTS = (
    "angular_velocity",
    "angular_acceleration",
    "normal_force",
    "tangential_force",
    "contact_force",
    "pressure_shift",
    "shift_vector",
    "required_moment",
    "point_moment_residual",
    "moment_residual",
    "wrench_1",
    "wrench_2",
)
"""Outputs of `load_function`, in order.

angular_velocity, angular_acceleration (3,): world frame [rad/s, rad/s^2]. normal_force,
tangential_force (2,) [N]. contact_force (6,): forces of robots 1 and 2 on the box, world [N].
pressure_shift (2,): lengths of the shifts [m]; shift_vector (6,): both shifts, world [m]. For a
robot with several pads: the sums of the pads' normal forces and of the lengths of their tangential
forces, the longest shift, and the first pad's shift vector. required_moment, point_moment_residual,
moment_residual (3,): about the centre of mass, world [N m]. wrench_1, wrench_2 (6,): force and
moment that each robot exerts on the box, about the nominal contact point, world axes [N, N m].
"""

SIZES = {"pose": 6, "rate": 6, "second_rate": 6, "friction": 2, "centre_of_mass": 3}
"""Inputs of `uncertain_load_function` and their sizes."""

SAMPLE_SIZES = (
    ("pose", 6),
    ("force", 3),
    ("moment", 3),
    ("friction", 2),
    ("centre_of_mass", 3),
)
"""Inputs of functions of one sample's forces, and their sizes; force and moment in the world
frame."""


def load_function(workcell: Workcell) -> ca.Function:
    """Build the function of the contact forces and centres of pressure at one sample of the box
    motion.

    Inputs: pose (6,) of the box [m, rad]; rate and second_rate (6,), its first and second time
    derivative; then the payload's symbolic parameters. Outputs, listed with shapes in
    `LOAD_OUTPUTS`: angular velocity and acceleration, normal, tangential and contact forces, shifts
    of the centres of pressure, required and unbalanced moments, and the wrench of each robot.
    """
    payload = workcell.payload
    own: list[Expression] = [frictions(workcell), ca.SX(number(payload.centre_of_mass))]
    if contact_model(workcell).has_closed_form:
        kind, given = ca.SX, sx_parameters(payload)
    else:
        kind, given = ca.MX, mx_parameters(payload)
        own = [as_mx(value, sx_parameters(payload), given) for value in own]
    inputs = {name: kind.sym(name, 6) for name in ("pose", "rate", "second_rate")}
    outputs = uncertain_load_function(workcell).call([*inputs.values(), *own, *given.values()])
    named = dict(zip(LOAD_OUTPUTS, outputs, strict=True))
    return named_function("load", inputs | given, named, cse=False)


def frictions(workcell: Workcell) -> ca.SX:
    """Return the Coulomb coefficients (2,) of the two robots' contacts."""
    return ca.vertcat(*[ca.SX(number(contact.friction)) for contact in workcell.contacts])


def resultant_force(
    mass: float, offset: ca.SX, omega: ca.SX, alpha: ca.SX, acceleration: ca.SX
) -> ca.SX:
    """Compute the resultant force (3,) that a rotating and accelerating box needs, m (a - g), world
    frame [N] (Eq. 34).

    Args:
        mass: mass of the payload [kg].
        offset: (3,) vector from the box centre to the centre of mass, world axes [m].
        omega, alpha: (3,) angular velocity and acceleration, world frame [rad/s, rad/s^2].
        acceleration: (3,) acceleration of the box centre, world frame [m/s^2].
    """
    turning = ca.cross(alpha, offset) + ca.cross(omega, ca.cross(omega, offset))
    return required_force(mass, acceleration + turning)


def uncertain_load_function(workcell: Workcell) -> ca.Function:
    """Build the function of contact forces at one sample, with friction and centre of mass as
    inputs.

    Inputs: pose (6,) of the box [m, rad]; rate and second_rate (6,), its first and second time
    derivative; friction (2,), the Coulomb coefficients; centre_of_mass (3,), box frame [m]; then
    the payload's symbolic parameters. Outputs: as `load_function`.
    """
    if contact_model(workcell).has_closed_form:
        return _closed_load_function(workcell)
    return _grasp_load_function(workcell)


def _closed_load_function(workcell: Workcell) -> ca.Function:
    inputs = {name: ca.SX.sym(name, size) for name, size in SIZES.items()}
    pose, rate, second, friction, centre_of_mass = inputs.values()
    contacts = workcell.contacts
    rotation, omega, alpha, force, moment = required(workcell, pose, rate, second, centre_of_mass)
    points = [number(contact.T_box_pad[:3, 3]) for contact in contacts]
    arms = [ca.mtimes(rotation, point - centre_of_mass) for point in points]
    axes = ca.mtimes(rotation, number(contacts[0].T_box_pad[:3, :3]))
    load = ContactLoad(force, moment, (arms[0], arms[1]), axes, friction)
    held = contact_model(workcell).hold(load)
    outputs = {
        "angular_velocity": omega,
        "angular_acceleration": alpha,
        "normal_force": held.normal,
        "tangential_force": held.tangential,
        "contact_force": ca.vertcat(*held.forces),
        "pressure_shift": ca.vertcat(*map(_length, held.shifts)),
        "shift_vector": ca.vertcat(*held.shifts),
        "required_moment": moment,
        "point_moment_residual": held.point_residual,
        "moment_residual": held.residual,
        "wrench_1": held.wrenches[0],
        "wrench_2": held.wrenches[1],
    }
    outputs = {name: ca.densify(value) for name, value in outputs.items()}
    return _named(inputs | sx_parameters(workcell.payload), outputs)


def _grasp_load_function(workcell: Workcell) -> ca.Function:
    """Build the function that `uncertain_load_function` describes, for pads whose forces a convex
    program computes."""
    inputs = {name: ca.MX.sym(name, size) for name, size in SIZES.items()}
    names = ("angular_velocity", "angular_acceleration", "force", "required_moment")
    given = [ca.SX.sym(name, size) for name, size in SIZES.items() if name != "friction"]
    numbers, groups = sx_parameters(workcell.payload), mx_parameters(workcell.payload)
    of_motion = required(workcell, *given)[1:]
    asked_of = [inputs[name] for name in SIZES if name != "friction"]
    function = ca.Function("required", [*given, *numbers.values()], of_motion)
    found = function(*asked_of, *groups.values())
    outputs = dict(zip(names, found, strict=True))
    asked = (inputs["pose"], outputs["force"], outputs["required_moment"])
    further = (inputs["friction"], inputs["centre_of_mass"], *groups.values())
    outputs |= dict(zip(GRASP_OUTPUTS, _sample_function(workcell)(*asked, *further), strict=True))
    return _named(inputs | groups, outputs)


def _named(inputs: dict[str, ca.MX], outputs: dict[str, ca.MX]) -> ca.Function:
    """Build the CasADi function named `uncertain_load` from its inputs and the outputs that
    `LOAD_OUTPUTS` lists.

    Args:
        inputs: symbols by name, in order.
        outputs: expressions by name, at least those in `LOAD_OUTPUTS`.
    """
    ordered = {name: outputs[name] for name in LOAD_OUTPUTS}
    return named_function("uncertain_load", inputs, ordered, cse=False)


def required(
    workcell: Workcell, pose: ca.SX, rate: ca.SX, second: ca.SX, centre_of_mass: ca.SX | ca.DM
) -> list[ca.SX]:
    """Compute the rotation of the box, and the force and moment that its motion requires.

    Args:
        workcell: cell with the payload.
        pose, rate, second: (6,) box pose [m, rad] and its first and second time derivative.
        centre_of_mass: (3,) box frame [m].

    Returns:
        R_world_box (3, 3); then in the world frame, (3,) each: angular velocity [rad/s], angular
        acceleration [rad/s^2], required force [N], and required moment about the centre of mass [N
        m].
    """
    turned = workcell.task.orientation
    rotation = rotation_matrix(turned, pose[3:])
    omega = angular_velocity(turned, pose[3:], rate[3:])
    alpha = angular_acceleration(turned, pose[3:], rate[3:], second[3:])
    offset = ca.mtimes(rotation, centre_of_mass)
    force = resultant_force(workcell.payload.mass, offset, omega, alpha, second[:3])
    moment = required_moment(ca.SX(number(workcell.payload.inertia)), rotation, omega, alpha)
    return [rotation, omega, alpha, force, moment]


def _sample_function(workcell: Workcell) -> ca.Function:
    """Build the function of the pads' forces at one sample, for pads with any normals.

    Inputs: pose (6,) of the box [m, rad]; required force (3,) [N] and moment (3,) about the centre
    of mass [N m], world axes; friction (2,), the Coulomb coefficients; centre_of_mass (3,), box
    frame [m]; then the payload's symbolic parameters. Outputs: those of `load_function` that
    `GRASP_OUTPUTS` names.
    """
    inputs, given = [ca.MX.sym(*entry) for entry in SAMPLE_SIZES], mx_parameters(workcell.payload)
    pose, force, moment, friction, centre_of_mass = inputs
    asked = (pose, force, moment, centre_of_mass)
    load = box_load_function(workcell)(*asked)
    wrenches = grasp_wrenches(Grasp(workcell), load, friction, list(given.values()))
    outputs = grasp_world_function(workcell)(*asked, wrenches, *given.values())
    return ca.Function("grasp_sample", [*inputs, *given.values()], outputs)


def _length(vector: Expression) -> Expression:
    """Compute the length of a vector, with a finite derivative at zero. The error is at most 1e-12
    in the vector's unit."""
    return ca.sqrt(ca.sumsqr(vector) + 1e-24)


# --- wrenches of pads in the world ---


GRASP_OUTPUTS = (
    "normal_force",
    "tangential_force",
    "contact_force",
    "pressure_shift",
    "shift_vector",
    "point_moment_residual",
    "moment_residual",
    "wrench_1",
    "wrench_2",
)
"""Entries of `LOAD_OUTPUTS` that follow from the wrenches of the program."""

LEAST_FORCE = 1e-9
"""With a smaller normal force the centre of pressure counts as the patch's centre [N]."""

_ASKED = (("pose", 6), ("force", 3), ("moment", 3), ("centre_of_mass", 3))


def box_load_function(workcell: Workcell) -> ca.Function:
    """Build the function that converts the force and moment on the box from world to box frame.

    Inputs: pose (6,) of the box; force (3,) [N] and moment (3,) about the centre of mass [N m],
    both along world axes; centre_of_mass (3,), box frame [m]. Output (6,): force [N] and moment
    about the box frame's origin [N m], along the box's axes.
    """
    pose, force, moment, centre_of_mass = inputs = [ca.SX.sym(*entry) for entry in _ASKED]
    to_box = rotation_matrix(workcell.task.orientation, pose[3:]).T
    in_box = ca.mtimes(to_box, force)
    about = ca.mtimes(to_box, moment) + ca.cross(centre_of_mass, in_box)
    return ca.Function("box_load", inputs, [ca.vertcat(in_box, about)])


def grasp_world_function(workcell: Workcell) -> ca.Function:
    """Build the function that converts the wrenches of k pads to contact quantities in world axes.
    Its outputs are those of `load_function` that `GRASP_OUTPUTS` names: forces, shifts of the
    centres of pressure, unbalanced moments and the wrench of each robot.

    Inputs: pose (6,) of the box [m, rad]; force (3,) [N] and moment (3,) about the centre of mass
    [N m] that the motion requires, world axes; centre_of_mass (3,), box frame [m]; wrenches (6 k,)
    of the pads, described in `symbolic.contact.grasp.grasp_wrenches`; then the payload's symbolic
    parameters.
    """
    pose, _, moment, centre_of_mass = inputs = [ca.SX.sym(*entry) for entry in _ASKED]
    pads, robots = workcell.pads, workcell.pad_robots
    wrenches = ca.SX.sym("wrenches", WRENCH_SIZE * len(pads))
    rotation = rotation_matrix(workcell.task.orientation, pose[3:])
    zero = ca.SX.zeros(3)
    normal, tangential, longest = [ca.SX(0.0)] * 2, [ca.SX(0.0)] * 2, [ca.SX(0.0)] * 2
    forces, moments, shifts = [zero] * 2, [zero] * 2, [zero] * 2
    point, left = moment, moment
    for pad, robot, own in zip(pads, robots, ca.vertsplit(wrenches, WRENCH_SIZE), strict=True):
        axes = ca.mtimes(rotation, number(pad.T_box_pad[:3, :3]))
        pushed = ca.mtimes(axes, ca.vertcat(own[1:3], own[0]))
        # A normal force N n at d turns about d x n = (d_y, -d_x).
        turned = ca.mtimes(axes, ca.vertcat(own[4], -own[3], own[5]))
        shift = own[3:5] / ca.fmax(own[0], LEAST_FORCE)
        first = workcell.contacts[robot]
        beside = ca.mtimes(rotation, number(pad.T_box_pad[:3, 3] - first.T_box_pad[:3, 3]))
        arm = ca.mtimes(rotation, number(pad.T_box_pad[:3, 3]) - centre_of_mass)
        normal[robot] += own[0]
        tangential[robot] += _length(own[1:3])
        longest[robot] = ca.fmax(longest[robot], _length(shift))
        forces[robot] += pushed
        moments[robot] += turned + ca.cross(beside, pushed)
        if pad is first:
            shifts[robot] = ca.mtimes(axes, ca.vertcat(shift, 0.0))
        point -= ca.cross(arm, pushed)
        left -= ca.cross(arm, pushed) + turned
    outputs = {
        "normal_force": ca.vertcat(*normal),
        "tangential_force": ca.vertcat(*tangential),
        "contact_force": ca.vertcat(*forces),
        "pressure_shift": ca.vertcat(*longest),
        "shift_vector": ca.vertcat(*shifts),
        "point_moment_residual": point,
        "moment_residual": left,
        "wrench_1": ca.vertcat(forces[0], moments[0]),
        "wrench_2": ca.vertcat(forces[1], moments[1]),
    }
    return ca.Function(
        "grasp_world",
        [*inputs, wrenches, *sx_parameters(workcell.payload).values()],
        ca.cse([ca.densify(outputs[name]) for name in GRASP_OUTPUTS]),
    )
