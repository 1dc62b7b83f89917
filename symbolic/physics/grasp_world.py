"""What pads do to a payload, seen from the world: their wrenches turned, and summed per robot."""

from __future__ import annotations

import casadi as ca

from symbolic.physics.closure import WRENCH_SIZE
from symbolic.physics.rotation import rotation_matrix
from symbolic.workcell.records import Workcell

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
"""Those of `symbolic.physics.payload_load.LOAD_OUTPUTS` that depend on the allocation."""

LEAST_FORCE = 1e-9
"""Normal force below which a centre of pressure counts as the patch's [N]."""

_ASKED = (("pose", 6), ("force", 3), ("moment", 3), ("centre_of_mass", 3))


def box_load_function(workcell: Workcell) -> ca.Function:
    """pose, force, moment about the centre of mass (world) and centre of mass to force and moment
    about the box frame's origin (6,), along the box's axes."""
    pose, force, moment, centre_of_mass = inputs = [ca.SX.sym(*entry) for entry in _ASKED]
    to_box = rotation_matrix(workcell.task.orientation, pose[3:]).T
    in_box = ca.mtimes(to_box, force)
    about = ca.mtimes(to_box, moment) + ca.cross(centre_of_mass, in_box)
    return ca.Function("box_load", inputs, [ca.vertcat(in_box, about)])


def grasp_world_function(workcell: Workcell) -> ca.Function:
    """The inputs of `box_load_function` and the pads' wrenches (6 k,), see
    `symbolic.physics.grasp.grasp_wrenches`, to `GRASP_OUTPUTS`."""
    pose, _, moment, centre_of_mass = inputs = [ca.SX.sym(*entry) for entry in _ASKED]
    pads, robots = workcell.pads, workcell.pad_robots
    wrenches = ca.SX.sym("wrenches", WRENCH_SIZE * len(pads))
    rotation = rotation_matrix(workcell.task.orientation, pose[3:])
    zero = ca.SX.zeros(3)
    normal, tangential, longest = [ca.SX(0.0)] * 2, [ca.SX(0.0)] * 2, [ca.SX(0.0)] * 2
    forces, moments, shifts = [zero] * 2, [zero] * 2, [zero] * 2
    point, left = moment, moment
    for pad, robot, own in zip(pads, robots, ca.vertsplit(wrenches, WRENCH_SIZE), strict=True):
        axes = ca.mtimes(rotation, ca.DM(pad.T_box_pad[:3, :3]))
        pushed = ca.mtimes(axes, ca.vertcat(own[1:3], own[0]))
        # A normal force N n at d turns about d x n = (d_y, -d_x).
        turned = ca.mtimes(axes, ca.vertcat(own[4], -own[3], own[5]))
        shift = own[3:5] / ca.fmax(own[0], LEAST_FORCE)
        first = workcell.contacts[robot]
        beside = ca.mtimes(rotation, ca.DM(pad.T_box_pad[:3, 3] - first.T_box_pad[:3, 3]))
        arm = ca.mtimes(rotation, ca.DM(pad.T_box_pad[:3, 3]) - centre_of_mass)
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
        [*inputs, wrenches],
        ca.cse([ca.densify(outputs[name]) for name in GRASP_OUTPUTS]),
    )


def _length(vector: ca.SX) -> ca.SX:
    """Length with a finite derivative at zero; 1e-12 is far below any patch and any force."""
    return ca.sqrt(ca.sumsqr(vector) + 1e-24)
