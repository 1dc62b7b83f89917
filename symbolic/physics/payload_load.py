"""What one sample of the box motion asks of the two contacts, as one CasADi function.

Joins rotation, force allocation and centre of pressure (paper Section 4.4).
"""

from __future__ import annotations

import casadi as ca

from symbolic.physics.contact_forces import allocate, required_force
from symbolic.physics.pressure import pressure_shift, required_moment
from symbolic.physics.rotation import angular_acceleration, angular_velocity, rotation_matrix
from symbolic.workcell.records import Workcell

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
pressure_shift (2,): lengths of the shifts [m]; shift_vector (6,): both shifts, world [m].
required_moment, point_moment_residual, moment_residual (3,): about the centre of mass, world
[N m]. wrench_1, wrench_2 (6,): force and moment that each robot exerts on the box, about the
nominal contact point, world axes [N, N m].
"""


def load_function(workcell: Workcell) -> ca.Function:
    """Contact forces and centres of pressure from a box pose and its time derivatives.

    Inputs: pose, rate, second_rate (6,) as in `symbolic.physics.time_law.TimedPath`.
    Outputs: see `LOAD_OUTPUTS`.
    """
    motion = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    friction = ca.SX([contact.friction for contact in workcell.contacts])
    centre_of_mass = ca.SX(ca.DM(workcell.payload.centre_of_mass))
    return ca.Function(
        "load",
        motion,
        uncertain_load_function(workcell).call([*motion, friction, centre_of_mass]),
        ["pose", "rate", "second_rate"],
        list(LOAD_OUTPUTS),
    )


def resultant_force(
    mass: float, offset: ca.SX, omega: ca.SX, alpha: ca.SX, acceleration: ca.SX
) -> ca.SX:
    """Resultant force (3,) on a turning and accelerating box, world frame (Eq. 34) [N].

    Args:
        offset: (3,) from the box centre to its centre of mass [m].
        omega, alpha: (3,) angular velocity and acceleration [rad/s, rad/s^2].
        acceleration: (3,) of the box centre [m/s^2].
    """
    turning = ca.cross(alpha, offset) + ca.cross(omega, ca.cross(omega, offset))
    return required_force(mass, acceleration + turning)


def uncertain_load_function(workcell: Workcell) -> ca.Function:
    """`load_function` with further inputs for what is known least.

    Inputs: pose, rate, second_rate (6,); friction (2,) coefficients of the contacts;
    centre_of_mass (3,) in the box frame [m]. Outputs: see `LOAD_OUTPUTS`.
    """
    pose, rate, second = (ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate"))
    friction, centre_of_mass = ca.SX.sym("friction", 2), ca.SX.sym("centre_of_mass", 3)
    payload, contacts = workcell.payload, workcell.contacts
    rotation = rotation_matrix(pose[3:])
    omega = angular_velocity(pose[3:], rate[3:])
    alpha = angular_acceleration(pose[3:], rate[3:], second[3:])

    offset = ca.mtimes(rotation, centre_of_mass)
    force = resultant_force(payload.mass, offset, omega, alpha, second[:3])
    normal = ca.mtimes(rotation, ca.DM(contacts[0].T_box_pad[:3, 2]))
    forces = allocate(force, normal, (friction[0], friction[1]))

    moment = required_moment(ca.SX(ca.DM(payload.inertia)), rotation, omega, alpha)
    arms = tuple(ca.mtimes(rotation, ca.DM(c.T_box_pad[:3, 3]) - centre_of_mass) for c in contacts)
    tangents = tuple(ca.mtimes(rotation, ca.DM(contacts[0].T_box_pad[:3, k])) for k in (0, 1))
    shift = pressure_shift(
        moment, (arms[0], arms[1]), (forces.force_1, forces.force_2), (tangents[0], tangents[1])
    )
    outputs = {
        "angular_velocity": omega,
        "angular_acceleration": alpha,
        "normal_force": forces.normal,
        "tangential_force": forces.tangential,
        "contact_force": ca.vertcat(forces.force_1, forces.force_2),
        "pressure_shift": ca.vertcat(_length(shift.shift_1), _length(shift.shift_2)),
        "shift_vector": ca.vertcat(shift.shift_1, shift.shift_2),
        "required_moment": shift.required_moment,
        "point_moment_residual": shift.point_residual,
        "moment_residual": shift.residual,
        "wrench_1": ca.vertcat(forces.force_1, ca.cross(shift.shift_1, forces.force_1)),
        "wrench_2": ca.vertcat(forces.force_2, ca.cross(shift.shift_2, forces.force_2)),
    }
    return ca.Function(
        "uncertain_load",
        [pose, rate, second, friction, centre_of_mass],
        [ca.densify(outputs[name]) for name in LOAD_OUTPUTS],
        ["pose", "rate", "second_rate", "friction", "centre_of_mass"],
        list(LOAD_OUTPUTS),
    )


def _length(vector: ca.SX) -> ca.SX:
    """Length with a finite derivative at zero; 1e-12 m is far below any patch."""
    return ca.sqrt(ca.sumsqr(vector) + 1e-24)
