"""One arm that follows the box: inverse kinematics along the samples, limits and joint load.

Paper Eqs. 29-33 and 61-62. The flange's target follows from the box pose alone, so both arms
keep the relative grasp exactly. Newton's method is warm started by linear extrapolation of the
two previous samples; what it reaches is measured, never assumed.
"""

from __future__ import annotations

import casadi as ca

from symbolic.array import Array
from symbolic.expression import Expression
from symbolic.physics.pose import inverse
from symbolic.physics.rotation import rotation_matrix
from symbolic.robot.model import RobotModel
from symbolic.workcell.records import Contact, Robot

Arms = tuple[Robot, Robot]
Models = tuple[RobotModel, RobotModel]
Contacts = tuple[Contact, Contact]

NEWTON_STEPS = 3
"""Newton steps per sample; extrapolation brings the start within their basin."""

REACH_TOLERANCE = 1e-6
"""Largest pose residual of a reached sample [m, rad]: a twentieth of the arm's repeatability."""

MAX_JOINT_STEP = 0.5
"""Largest change of a joint in one Newton step, and between samples of one motion [rad]."""

TRACK_OUTPUTS = ("q", "ik_residual", "lost", "limit_margin", "manipulability", "joint_torque")
"""Outputs of `track_function` after the state.

q (6,) [rad], held at the last reached sample once the path is lost. ik_residual: pose residual
of q [m, rad]. lost: 0 while this and all earlier samples were reached without a jump, else 1.
limit_margin: least distance to a joint limit, negative beyond it [rad]. manipulability: |det J|
of the flange [m^3]. joint_torque (6,): torque that exerts the contact wrench [N m].
"""


def box_flange(robot: Robot, contact: Contact) -> Array:
    """T_box_flange (4, 4) of the arm that holds this contact."""
    return contact.T_box_pad @ inverse(robot.T_flange_pad)


def flange_target(
    robot: Robot, contact: Contact, position: ca.SX, rotation: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Flange rotation (3, 3) and position (3,) in the robot's root frame, from the box pose.

    Args:
        position, rotation: (3,) and (3, 3), the box in the world (paper Eqs. 30-33).
    """
    T_box_flange = box_flange(robot, contact)
    R_root_world = ca.DM(robot.T_world_base[:3, :3].T)
    R_root_box = ca.mtimes(R_root_world, rotation)
    offset = position - ca.DM(robot.T_world_base[:3, 3])
    return (
        ca.mtimes(R_root_box, ca.DM(T_box_flange[:3, :3])),
        ca.mtimes(R_root_world, offset) + ca.mtimes(R_root_box, ca.DM(T_box_flange[:3, 3])),
    )


def pose_error(R_target: ca.SX, p_target: ca.SX, R: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Newton's right-hand side (6,) and the pose residual (scalar) of a placement.

    The right-hand side holds the position error and the axis of the rotation error times the
    sine of its angle. The residual uses twice the sine of the half angle instead, which is zero
    for equal rotations only.
    """
    dR = ca.mtimes(R_target, R.T)
    axis = ca.vertcat(dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]) / 2.0
    dp = p_target - p
    turn_squared = ca.sumsqr(R_target - R) / 2.0
    return ca.vertcat(dp, axis), ca.sqrt(ca.sumsqr(dp) + turn_squared + 1e-40)


def newton_step(model: RobotModel, q: ca.SX, R_target: ca.SX, p_target: ca.SX) -> ca.SX:
    """One safeguarded Newton step of the inverse kinematics; q (6,) to q (6,)."""
    R, p = model.placement(q)
    error, _ = pose_error(R_target, p_target, R, p)
    Q, upper = ca.qr(model.jacobian(q))
    step = ca.solve(upper, ca.mtimes(Q.T, error))
    largest = ca.norm_inf(step)
    # At a singular posture the step is not a number: stay, and let the residual tell.
    usable = ca.norm_1(step) < 1e9
    scale = MAX_JOINT_STEP / ca.fmax(largest, MAX_JOINT_STEP)
    return ca.vertcat(*[q[i] + ca.if_else(usable, scale * step[i], 0.0) for i in range(6)])


def manipulability(jacobian: ca.SX) -> ca.SX:
    """|det J| [m^3] of a (6, 6) Jacobian (Yoshikawa's measure of a six-joint arm)."""
    _, upper = ca.qr(jacobian)
    product = upper[0, 0]
    for i in range(1, 6):
        product = product * upper[i, i]
    return product


def limit_margin(robot: Robot, q: ca.SX) -> ca.SX:
    """Least distance (scalar) of the joints to their limits, negative beyond one [rad]."""
    return ca.mmin(ca.vertcat(q - ca.DM(robot.position_lower), ca.DM(robot.position_upper) - q))


def joint_torque(
    robot: Robot, contact: Contact, jacobian: ca.SX, rotation: ca.SX, wrench: ca.SX
) -> ca.SX:
    """Joint torques (6,) that exert a contact wrench on the box (paper Eq. 45) [N m].

    Args:
        jacobian: (6, 6) of the flange in the robot's root frame, linear rows first.
        rotation: R_world_box (3, 3).
        wrench: (6,) on the box about the nominal contact point, world axes.
    """
    lever_box = contact.T_box_pad[:3, 3] - box_flange(robot, contact)[:3, 3]
    lever = ca.mtimes(rotation, ca.DM(lever_box))
    moment = wrench[3:] + ca.cross(lever, wrench[:3])
    R_root_world = ca.DM(robot.T_world_base[:3, :3].T)
    local = ca.vertcat(ca.mtimes(R_root_world, wrench[:3]), ca.mtimes(R_root_world, moment))
    return ca.mtimes(jacobian.T, local)


def track_function(robot: Robot, model: RobotModel, contact: Contact, name: str) -> ca.Function:
    """One sample of an arm's motion, to be accumulated along the path.

    Inputs: state (13,) = joints at the previous sample, at the one before, and `lost`; pose (6,)
    of the box; wrench (6,) on the box about the nominal contact point.
    Outputs: the next state, then `TRACK_OUTPUTS`.
    """
    state, pose, wrench = ca.SX.sym("state", 13), ca.SX.sym("pose", 6), ca.SX.sym("wrench", 6)
    previous, before, lost = state[:6], state[6:12], state[12]
    rotation = rotation_matrix(pose[3:])
    R_target, p_target = flange_target(robot, contact, pose[:3], rotation)
    q = 2.0 * previous - before
    for _ in range(NEWTON_STEPS):
        q = newton_step(model, q, R_target, p_target)
    _, reached = pose_error(R_target, p_target, *model.placement(q))
    jump = ca.norm_inf(q - previous)
    arrived = ca.logic_and(reached <= REACH_TOLERANCE, jump <= MAX_JOINT_STEP)
    lost = ca.fmax(lost, ca.if_else(arrived, 0.0, 1.0))
    # A lost arm stays where it was: what Newton's method does off the path is arbitrary.
    q = ca.vertcat(*[ca.if_else(lost > 0.5, previous[i], q[i]) for i in range(6)])
    jacobian = model.jacobian(q)
    _, residual = pose_error(R_target, p_target, *model.placement(q))
    outputs = ca.cse(
        [
            ca.vertcat(q, previous, lost),
            q,
            residual,
            lost,
            limit_margin(robot, q),
            manipulability(jacobian),
            joint_torque(robot, contact, jacobian, rotation, wrench),
        ]
    )
    return ca.Function(
        name,
        [state, pose, wrench],
        [ca.densify(output) for output in outputs],
        ["state", "pose", "wrench"],
        ["next_state", *TRACK_OUTPUTS],
    )


def follow_function(
    robot: Robot, model: RobotModel, contact: Contact, samples: int, name: str
) -> ca.Function:
    """An arm's motion along all samples of a box path.

    Inputs: start (6,), joints at the first pose [rad]; pose (6, samples) of the box; wrench
    (6, samples) on the box about the nominal contact point. Outputs: `TRACK_OUTPUTS`.

    The second sample has no motion before it to extrapolate: Newton steps from the start posture
    predict it, and what they find takes the extrapolation's place.
    """
    start, pose = ca.MX.sym("start", 6), ca.MX.sym("pose", 6, samples)
    wrench = ca.MX.sym("wrench", 6, samples)
    track = track_function(robot, model, contact, f"{name}_sample")
    first = track(start_state(start), pose[:, 0], wrench[:, 0])
    predict = prediction_function(robot, model, contact, f"{name}_prediction")
    state = predict(first[0], pose[:, 1])
    rest = track.mapaccum(f"{name}_samples", samples - 1)(state, pose[:, 1:], wrench[:, 1:])
    return ca.Function(
        name,
        [start, pose, wrench],
        [ca.horzcat(one, more) for one, more in zip(first[1:], rest[1:], strict=True)],
        ["start", "pose", "wrench"],
        list(TRACK_OUTPUTS),
    )


def start_state(start: Expression) -> Expression:
    """State of `track_function` before the first sample, from its joints (6,)."""
    return ca.vertcat(start, start, 0.0)


def prediction_function(
    robot: Robot, model: RobotModel, contact: Contact, name: str
) -> ca.Function:
    """State of `track_function` after the first sample -> one that predicts the second.

    Inputs: state (13,); pose (6,) of the box at the second sample.
    """
    state, pose = ca.SX.sym("state", 13), ca.SX.sym("pose", 6)
    R_target, p_target = flange_target(robot, contact, pose[:3], rotation_matrix(pose[3:]))
    q = start = state[:6]
    for _ in range(NEWTON_STEPS):
        q = newton_step(model, q, R_target, p_target)
    predicting = ca.vertcat(start, 2.0 * start - q, state[12])
    return ca.Function(name, [state, pose], ca.cse([predicting]), ["state", "pose"], ["predicting"])


def posture_function(robots: Arms, models: Models, contacts: Contacts) -> ca.Function:
    """Both arms' postures at one box pose, from nearby joint positions.

    Inputs: pose (6,) of the box; guess_1, guess_2 (6,) [rad]. Outputs: q_1, q_2 (6,) after
    `NEWTON_STEPS`; residual_1, residual_2, their pose residuals [m, rad].
    """
    pose = ca.SX.sym("pose", 6)
    guesses = ca.SX.sym("guess_1", 6), ca.SX.sym("guess_2", 6)
    rotation = rotation_matrix(pose[3:])
    postures, residuals = [], []
    for robot, model, contact, q in zip(robots, models, contacts, guesses, strict=True):
        R_target, p_target = flange_target(robot, contact, pose[:3], rotation)
        for _ in range(NEWTON_STEPS):
            q = newton_step(model, q, R_target, p_target)
        R, p = model.placement(q)
        postures.append(q)
        residuals.append(pose_error(R_target, p_target, R, p)[1])
    return ca.Function(
        "posture",
        [pose, *guesses],
        ca.cse([*postures, *residuals]),
        ["pose", "guess_1", "guess_2"],
        ["q_1", "q_2", "residual_1", "residual_2"],
    )
