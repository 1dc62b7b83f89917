"""Geometry of a carry: all quantities along the path that do not depend on its timing.

With the path parameter u driven as u(t), every velocity is its derivative by u times u', and every
acceleration is affine in (u'', u'^2). So are the force and the moment that the box needs and the
torque that moves an arm; time-optimal path parameterisation needs the coefficients (Verscheure et
al., IEEE TAC 54(10), 2009; Pham and Pham, IEEE T-RO 34(3), 2018).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from symbolic.cell_model import CellModel
from symbolic.contact.paper import required_moment
from symbolic.expression import (
    as_mx,
    mx_parameters,
    named_function,
    number,
    select_parameters,
    sx_parameters,
    tile,
)
from symbolic.path.rotation import angular_acceleration, angular_velocity, rotation_matrix
from symbolic.path.spline import (
    NO_GROUPS,
    MXGroups,
    PathBasis,
    extended_matrix,
    path_basis,
    waypoint_matrix,
)
from symbolic.records import Contact, Robot, Task, Workcell
from symbolic.records.cell import box_flange
from symbolic.robot.arm import TRACK_OUTPUTS, follow_function, following_columns, joint_torque
from symbolic.robot.model import RobotModel

BOX_OUTPUTS = (
    "rotation",
    "angular_first",
    "angular_second",
    "normal",
    "force_by_acceleration",
    "force_by_speed",
    "moment_by_acceleration",
    "moment_by_speed",
)
"""Per sample of the box, world frame.

rotation (9,): R_world_box row by row. angular_first, angular_second (3,): the angular velocity is
angular_first u', the angular acceleration angular_first u'' + angular_second u'^2. normal (3,): the
unit normal of contact 1; contact 2 has the opposite normal. force_by_... (3,) [kg m]: the required
force is force_by_acceleration u'' + force_by_speed u'^2 - m g. moment_by_... (3,) [kg m^2]: the
required moment about the centre of mass is moment_by_acceleration u'' + moment_by_speed u'^2.
"""

ARM_OUTPUTS = (
    "q_first",
    "q_second",
    "torque_by_acceleration",
    "torque_by_speed",
    "torque_at_rest",
    "wrench_torque",
)
"""Per sample and arm, in addition to `symbolic.robot.arm.TRACK_OUTPUTS` without its joint torque.

q_first, q_second (n,): derivatives of the joints by u [rad or m]. torque_by_... and torque_at_rest
(n,): the bare arm's inverse dynamics is torque_by_acceleration u'' + torque_by_speed u'^2 +
torque_at_rest [N m]. wrench_torque (6 n,): the (n, 6) matrix, row by row, from the contact wrench
(force and moment on the box about the nominal contact point, world axes) to joint torques.
"""


def path_motion_function(model: CellModel, samples: int) -> ca.Function:
    """Build the function of a carry's geometry at n uniform samples of the path parameter u in [0,
    1].

    Input: x (n_var,), the decision vector; then the cell's symbolic parameters.

    Outputs (NumPy shapes): pose (n, 6) of the box [m, rad]; pose_first and pose_second (n, 6), its
    first and second derivative by u; the outputs of `box_function`. For each arm i = 1, 2 follow,
    with the suffix _i: joint positions and further `symbolic.robot.arm.TRACK_OUTPUTS` except
    joint_torque, and the outputs of `arm_derivative_function`; for example q_1 (n, joints).

    Args:
        model: the cell.
        samples: number n of samples, at least 3.
    """
    workcell = model.workcell
    x, task = ca.MX.sym("x", workcell.task.n_var), workcell.task
    groups = mx_parameters(task, *workcell.robots, model, workcell.payload)
    waypoints = waypoint_matrix(task, x, select_parameters(groups, task))
    basis = path_basis(len(task.waypoints), np.linspace(0.0, 1.0, samples))
    pose, first, second = (
        ca.mtimes(waypoints, ca.DM(matrix.T))
        for matrix in (basis.position, basis.first, basis.second)
    )
    outputs = {"pose": pose, "pose_first": first, "pose_second": second}
    held = tile(select_parameters(groups, workcell.payload), samples)
    box = box_function(workcell).map(samples)(pose, first, second, *held)
    outputs |= dict(zip(BOX_OUTPUTS, box, strict=True))
    no_wrench = ca.DM.zeros(6, samples)
    moved = extended_motion(task, x, basis, waypoints, select_parameters(groups, task))
    for i in (0, 1):
        robot, contact = workcell.robots[i], workcell.contacts[i]
        follow = follow_function(robot, model.robots[i], contact, samples, f"path_arm_{i + 1}")
        given = select_parameters(groups, robot)
        start = start_posture(model, i, groups)
        found = follow(start, moved[0], no_wrench, *given.values())
        tracked = dict(zip(TRACK_OUTPUTS, found, strict=True))
        del tracked["joint_torque"]
        arm = arm_derivative_function(robot, model.robots[i], contact, f"path_derivatives_{i + 1}")
        derivatives = arm.map(samples)(tracked["q"], *moved, *tile(given, samples))
        derived = dict(zip(ARM_OUTPUTS, derivatives, strict=True))
        outputs |= {f"{name}_{i + 1}": value for name, value in (tracked | derived).items()}
    return named_function("path_motion", {"x": x} | groups, outputs)


def start_posture(model: CellModel, arm: int, groups: MXGroups) -> ca.MX:
    """Return the joint positions (n,) [rad or m] in which an arm holds the box at the start of the
    path: its start branch, as an expression.

    Args:
        model: the cell.
        arm: index of the arm.
        groups: MX vectors of the cell's parameters, by name of the parameter group; empty for plain
            numbers.
    """
    start = model.start[arm]
    return (
        as_mx(start, sx_parameters(model), select_parameters(groups, model))
        if groups
        else ca.MX(ca.DM(start))
    )


def extended_motion(
    task: Task, x: ca.MX, basis: PathBasis, waypoints: ca.MX, groups: MXGroups = NO_GROUPS
) -> list[ca.MX]:
    """Compute the extended poses (box pose, then redundant joints) at n samples of the path, and
    their first and second derivatives by u.

    Args:
        task: task with m redundant joints.
        x: (n_var,) decision vector.
        basis: spline basis at the n samples.
        waypoints: (6, n_waypoints) box poses at the waypoints [m, rad].
        groups: MX vectors of the task's parameters, by name of the parameter group; empty for plain
            numbers.

    Returns:
        Three matrices (6 + m, n), one sample per column.
    """
    whole = extended_matrix(task, x, waypoints, groups)
    matrices = (basis.position, basis.first, basis.second)
    return [ca.mtimes(whole, ca.DM(matrix.T)) for matrix in matrices]


def box_function(workcell: Workcell) -> ca.Function:
    """Build the function of the box's required force and moment at one sample of a path, as
    coefficients of the timing.

    Inputs: pose, first, second (6,), the box pose [m, rad] and its first and second derivative by
    u; then the payload's symbolic parameters. Outputs, listed with shapes in `BOX_OUTPUTS`:
    rotation of the box, normal of contact 1, and the coefficients of u'' and u'^2 in angular
    motion, required force and required moment, world frame.
    """
    pose, first, second = (ca.SX.sym(name, 6) for name in ("pose", "first", "second"))
    payload = workcell.payload
    turned = workcell.task.orientation
    rotation = rotation_matrix(turned, pose[3:])
    omega = angular_velocity(turned, pose[3:], first[3:])
    alpha = angular_acceleration(turned, pose[3:], first[3:], second[3:])
    offset = ca.mtimes(rotation, number(payload.centre_of_mass))
    inertia = ca.SX(number(payload.inertia))
    outputs = {
        "rotation": ca.vec(rotation.T),
        "angular_first": omega,
        "angular_second": alpha,
        "normal": ca.mtimes(rotation, number(workcell.contacts[0].T_box_pad[:3, 2])),
        "force_by_acceleration": payload.mass * (first[:3] + ca.cross(omega, offset)),
        "force_by_speed": payload.mass
        * (second[:3] + ca.cross(alpha, offset) + ca.cross(omega, ca.cross(omega, offset))),
        "moment_by_acceleration": required_moment(inertia, rotation, ca.SX.zeros(3), omega),
        "moment_by_speed": required_moment(inertia, rotation, omega, alpha),
    }
    inputs = [pose, first, second, *sx_parameters(payload).values()]
    return ca.Function("path_box", inputs, [ca.densify(outputs[name]) for name in BOX_OUTPUTS])


def arm_derivative_function(
    robot: Robot, model: RobotModel, contact: Contact, name: str
) -> ca.Function:
    """Build the function of an arm's joint derivatives by u and joint torques at one sample.

    Inputs: q (n,), the joint positions that hold the box at this pose; pose, first, second (6 +
    m,), the extended pose and its first and second derivative by u; then the robot's symbolic
    parameters. Outputs, listed with shapes in `ARM_OUTPUTS`: first and second derivative of q by u;
    joint torques of the arm without the box by u'', by u'^2 and at rest; joint torques per unit of
    contact wrench.

    Args:
        robot: description of the arm.
        model: kinematics and dynamics of the arm.
        contact: contact of the arm's pad with the box.
        name: name of the function.
    """
    n = model.n_joints
    q, names = ca.SX.sym("q", n), ("pose", "first", "second")
    given = [ca.SX.sym(each, model.pose_size) for each in names]
    pose, first, second = (values[:6] for values in given)
    turned = model.orientation
    rotation = rotation_matrix(turned, pose[3:])
    omega = angular_velocity(turned, pose[3:], first[3:])
    alpha = angular_acceleration(turned, pose[3:], first[3:], second[3:])
    lever = ca.mtimes(rotation, number(box_flange(robot, contact)[:3, 3]))
    to_root = number(robot.T_world_base[:3, :3].T)
    twist = ca.vertcat(
        ca.mtimes(to_root, first[:3] + ca.cross(omega, lever)), ca.mtimes(to_root, omega)
    )
    twist_rate = ca.vertcat(
        ca.mtimes(
            to_root,
            second[:3] + ca.cross(alpha, lever) + ca.cross(omega, ca.cross(omega, lever)),
        ),
        ca.mtimes(to_root, alpha),
    )
    jacobian = model.jacobian(q)
    following = list(model.following)
    own = [model.with_redundant(ca.SX(n, 1), moved) for moved in given[1:]]
    if model.redundant:  # J_following qd_following = twist - J_redundant qd_redundant
        twist -= ca.mtimes(jacobian, own[0])
        twist_rate -= ca.mtimes(jacobian, own[1])
    Q, upper = ca.qr(following_columns(model, jacobian))
    q_first, q_second = own
    q_first[following] = ca.solve(upper, ca.mtimes(Q.T, twist))
    q_second[following] = ca.solve(upper, ca.mtimes(Q.T, twist_rate - model.drift(q, q_first)))
    still = ca.SX.zeros(n)
    at_rest = model.inverse_dynamics(q, still, still)
    wrench = ca.SX.sym("wrench", 6)
    torque = joint_torque(robot, contact, jacobian, rotation, wrench)
    outputs = {
        "q_first": q_first,
        "q_second": q_second,
        "torque_by_acceleration": model.inverse_dynamics(q, still, q_first) - at_rest,
        "torque_by_speed": model.inverse_dynamics(q, q_first, q_second) - at_rest,
        "torque_at_rest": at_rest,
        "wrench_torque": ca.vec(ca.jacobian(torque, wrench).T),
    }
    inputs = {"q": q} | dict(zip(names, given, strict=True)) | sx_parameters(robot)
    return named_function(name, inputs, {k: ca.densify(outputs[k]) for k in ARM_OUTPUTS})
