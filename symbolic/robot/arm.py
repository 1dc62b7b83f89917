"""Inverse kinematics of an arm along the samples of a box path, joint limits and joint torques.

Paper Eqs. 29-33 and 61-62. The pose of the box alone determines the target of each flange, so both
arms keep their grasps exactly. The extended pose sets an arm's redundant joints (`RobotModel`); the
other six joints follow the box. Newton's method starts from the quadratic extrapolation of the
previous samples. Two cheap steps suffice nearly everywhere. A third step follows if the residual
before the second step was large. If the residual is still too large, `IK_NEWTON_STEPS` steps by QR
factors are made. A sample that these do not reach either is lost.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, reduce
from itertools import combinations
from operator import add

import casadi as ca
import numpy as np

from symbolic.expression import (
    Expression,
    mx_parameters,
    named_function,
    number,
    sx_parameters,
    tile,
)
from symbolic.path.rotation import rotation_matrix
from symbolic.records import Contact, Robot
from symbolic.records.cell import box_flange, flange_lever
from symbolic.robot.model import RobotModel

Arms = tuple[Robot, Robot]
Models = tuple[RobotModel, RobotModel]
Contacts = tuple[Contact, Contact]

IK_NEWTON_STEPS = 3
"""Number of Newton steps per sample; extrapolation starts them within their basin."""

BEGIN_STEPS = 12
"""Number of Newton steps in which an arm's redundant joints move from the start posture to their
positions at a candidate's first sample."""

CHEAP_STEPS = 2
"""Number of Newton steps by blocks that every sample gets."""

THIRD_STEP_RESIDUAL = 1e-5
"""If the pose residual before the last cheap step exceeds this, one more step is made [m, rad].
Newton's method squares the residual, within a factor of about 5."""

TRUSTED_RESIDUAL = 1e-9
"""Cheap steps are not trusted if their pose residual exceeds this [m, rad]."""

REACH_TOLERANCE = 1e-6
"""Largest pose residual of a reached sample [m, rad]: a twentieth of the arm's repeatability."""

TRACK_OUTPUTS = ("q", "ik_residual", "lost", "limit_margin", "manipulability", "joint_torque")
"""Outputs of `track_function` after the state.

q (n,) [rad, or m for a sliding joint]; once the path is lost, the joints of the last reached
sample. ik_residual: pose residual of q [m, rad]. lost: 0 while this and all earlier samples were
reached without a jump, else 1. limit_margin: least distance to a joint limit, negative beyond it
[rad]. manipulability: |det J| of the flange by the six joints that follow [m^3]. joint_torque (n,):
torque that exerts the contact wrench [N m, or N for a sliding joint].
"""


def flange_target(
    robot: Robot, contact: Contact, position: ca.SX, rotation: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Compute the rotation (3, 3) and position (3,) that the flange has to reach, in the robot's
    root frame [m].

    Args:
        robot: the arm.
        contact: the arm's contact with the box.
        position, rotation: position (3,) [m] and rotation (3, 3) of the box in the world (paper
            Eqs. 30-33).
    """
    T_box_flange = box_flange(robot, contact)
    R_root_world = number(robot.T_world_base[:3, :3].T)
    R_root_box = ca.mtimes(R_root_world, rotation)
    offset = position - number(robot.T_world_base[:3, 3])
    return (
        ca.mtimes(R_root_box, number(T_box_flange[:3, :3])),
        ca.mtimes(R_root_world, offset) + ca.mtimes(R_root_box, number(T_box_flange[:3, 3])),
    )


def limit_margin(robot: Robot, q: ca.SX) -> ca.SX:
    """Compute the least distance of any joint to its limits [rad, or m for a sliding joint],
    negative beyond a limit.

    Args:
        robot: the arm.
        q: (n,) joint positions [rad, or m for a sliding joint].
    """
    lower, upper = number(robot.position_lower), number(robot.position_upper)
    return ca.mmin(ca.vertcat(q - lower, upper - q))


def joint_torque(
    robot: Robot, contact: Contact, jacobian: ca.SX, rotation: ca.SX, wrench: ca.SX
) -> ca.SX:
    """Compute the joint torques (n,) that exert a contact wrench on the box (paper Eq. 45) [N m].

    Args:
        robot: the arm.
        contact: the arm's contact with the box.
        jacobian: Jacobian (6, n) of the flange in the robot's root frame, linear rows first.
        rotation: rotation R_world_box (3, 3) of the box.
        wrench: contact wrench (6,) on the box about the nominal contact point, world axes [N, N m].
    """
    lever = ca.mtimes(rotation, number(flange_lever(robot, contact)))
    moment = wrench[3:] + ca.cross(lever, wrench[:3])
    R_root_world = number(robot.T_world_base[:3, :3].T)
    local = ca.vertcat(ca.mtimes(R_root_world, wrench[:3]), ca.mtimes(R_root_world, moment))
    return ca.mtimes(jacobian.T, local)


def track_function(robot: Robot, model: RobotModel, contact: Contact, name: str) -> ca.Function:
    """Build the function that moves an arm to the next sample of a box path.

    Inputs: state (3 n + 1,), which holds the joints (n,) at the previous sample, their first and
    second difference between samples, and 1 if the arm did not reach an earlier sample, else 0;
    pose (6 + m,), the extended pose of the sample (box pose, then the cell's m redundant joints);
    wrench (6,) on the box about the nominal contact point, world axes [N, N m]. Outputs:
    next_state, then `TRACK_OUTPUTS`: joints, pose residual, lost (1 from the first sample on that
    the arm does not reach), joint-limit margin, manipulability, joint torque.

    Args:
        robot, model, contact: the arm, its model, and its contact with the box.
        name: name of the new function.
    """
    n = model.n_joints
    state, pose = ca.MX.sym("state", 3 * n + 1), ca.MX.sym("pose", model.pose_size)
    wrench, given = ca.MX.sym("wrench", 6), mx_parameters(robot)
    parts = _track_parts(robot, model, contact)
    previous, lost = state[:n], state[3 * n]
    rotation, R_target, p_target = parts["target"](pose, *given.values())
    target = (R_target, p_target)
    q, before = parts["approach"](state, pose, *target)
    following = lost < 0.5
    q = parts["closer"](
        ca.logic_and(following, ca.logic_not(before <= THIRD_STEP_RESIDUAL)), q, *target
    )
    found = parts["place"](q, *target)
    unsure = ca.logic_and(following, ca.logic_not(found[1] <= TRUSTED_RESIDUAL))
    found = parts["again"](unsure, state, pose, *target, *found)
    jump = ca.norm_inf(found[0] - previous)
    arrived = ca.logic_and(found[1] <= REACH_TOLERANCE, jump <= MAX_JOINT_STEP)
    lost = ca.fmax(lost, ca.logic_not(arrived))
    # A lost arm stays where it was: what Newton's method does off the path is arbitrary.
    q, residual, jacobian = parts["held"](lost > 0.5, previous, *target, *found)
    change = q - previous
    return ca.Function(
        name,
        [state, pose, wrench, *given.values()],
        [
            ca.vertcat(q, change, change - state[n : 2 * n], lost),
            q,
            residual,
            lost,
            *parts["measures"](q, jacobian, rotation, wrench, *given.values()),
        ],
        ["state", "pose", "wrench", *given],
        ["next_state", *TRACK_OUTPUTS],
    )


def torque_function(robot: Robot, model: RobotModel, contact: Contact, name: str) -> ca.Function:
    """Build the function of the joint torques (n,) that exert a contact wrench [N m].

    Inputs: joints (n,) [rad or m]; extended pose (6 + m,), which is the box pose, then the cell's m
    redundant joints; and wrench (6,) on the box about the nominal contact point, world axes [N, N
    m].

    Args:
        robot, model, contact: the arm, its model, and its contact with the box.
        name: name of the new function.
    """
    q, pose = ca.SX.sym("q", model.n_joints), ca.SX.sym("pose", model.pose_size)
    wrench = ca.SX.sym("wrench", 6)
    rotation = rotation_matrix(model.orientation, pose[3:6])
    _, _, jacobian = model.kinematics(q)
    torque = joint_torque(robot, contact, jacobian, rotation, wrench)
    return _function(name, [q, pose, wrench, *sx_parameters(robot).values()], [torque])


def _track_parts(robot: Robot, model: RobotModel, contact: Contact) -> dict[str, ca.Function]:
    """Build the steps of `track_function` as functions by name.

    A target is R_world_box and the flange's rotation and position that hold the box. A placement is
    joints, pose residual [m, rad] and flange Jacobian (6, n).

    - target: extended pose -> target.
    - approach: state, pose, target -> joints after `CHEAP_STEPS` steps from the extrapolated
      joints, residual before the last step.
    - closer: joints, target -> joints after one more such step.
    - place: joints, target -> placement.
    - again: state, pose, target, placement -> the better one of this placement and of the placement
      after `IK_NEWTON_STEPS` steps by QR from other extrapolated joints.
    - held: previous joints, target, placement -> placement at the previous joints, for an arm that
      is lost.
    - measures: joints, Jacobian, R_world_box, wrench -> limit margin, manipulability, joint torque.

    closer, again and held take a condition as their first input. If it is false, they return the
    joints or the placement among their inputs unchanged.

    Args:
        robot, model, contact: the arm, its model, and its contact with the box.
    """
    n = model.n_joints
    state, pose = ca.SX.sym("state", 3 * n + 1), ca.SX.sym("pose", model.pose_size)
    wrench = ca.SX.sym("wrench", 6)
    q, R, p = ca.SX.sym("q", n), ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3)
    residual, jacobian = ca.SX.sym("residual"), ca.SX.sym("jacobian", 6, n)
    start, given = ca.SX.sym("start", n), sx_parameters(robot).values()
    rotation = rotation_matrix(model.orientation, pose[3:6])
    target = [rotation, *flange_target(robot, contact, pose[:3], rotation)]
    previous, change = state[:n], state[n : 2 * n]

    near = model.with_redundant(previous + (change + state[2 * n : 3 * n]), pose)
    before = ca.SX(0)
    for _ in range(CHEAP_STEPS):
        near, before = block_step(model, near, R, p)
    place = _function("place", [q, R, p], _placed(model, q, R, p))
    found = [q, residual, jacobian]

    other = model.with_redundant(previous + change, pose)
    for _ in range(IK_NEWTON_STEPS):
        other = newton_step(model, other, R, p)
    anew = _placed(model, other, R, p)
    keep = residual <= anew[1]
    better = [ca.if_else(keep, a, b) for a, b in zip(found, anew, strict=True)]
    measures = [
        limit_margin(robot, q),
        manipulability(following_columns(model, jacobian)),
        joint_torque(robot, contact, jacobian, R, wrench),
    ]
    return {
        "target": _function("target", [pose, *given], target),
        "approach": _function("approach", [state, pose, R, p], [near, before]),
        "closer": _where("closer", [q, R, p], [block_step(model, q, R, p)[0]], [q]),
        "place": place,
        "again": _where("again", [state, pose, R, p, *found], better, found),
        "held": _where("held", [start, R, p, *found], _placed(model, start, R, p), found),
        "measures": _function("measures", [q, jacobian, R, wrench, *given], measures),
    }


def _placed(model: RobotModel, q: ca.SX, R_target: ca.SX, p_target: ca.SX) -> list[ca.SX]:
    """Compute how well joint positions place the flange.

    Args:
        model: model of the robot.
        q: (n,) joint positions [rad or m].
        R_target, p_target: wanted rotation (3, 3) and position (3,) [m] of the flange in the root.

    Returns:
        q unchanged; the pose residual, a scalar [m, rad] (`pose_error`); and the flange's Jacobian
        (6, n) at q.
    """
    R, p, jacobian = model.kinematics(q)
    return [q, pose_error(R_target, p_target, R, p)[1], jacobian]


def _function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
    return ca.Function(name, inputs, ca.cse([ca.densify(output) for output in outputs]))


def _where(
    name: str, inputs: list[ca.SX], results: list[ca.SX], otherwise: list[ca.SX]
) -> ca.Function:
    """Build a function that returns some expressions if its first input, a condition, is true, and
    other expressions if it is false.

    Args:
        name: name of the function.
        inputs: symbols of the inputs after the condition.
        results: expressions if the condition is true.
        otherwise: expressions of the same shapes if it is false.
    """
    chosen = _function(name, inputs, results)
    left = _function(f"{name}_not", inputs, otherwise)
    return ca.Function.if_else(f"{name}_where", chosen, left)


def follow_function(
    robot: Robot, model: RobotModel, contact: Contact, samples: int, name: str
) -> ca.Function:
    """Build the function of an arm's motion along all samples of a box path.

    Inputs: start (n,), joints at the first box pose [rad or m]; pose (6 + m, samples), the extended
    poses (box pose, then the cell's m redundant joints); wrench (6, samples) on the box about the
    nominal contact point, world axes [N, N m]. Outputs of all samples, one column per sample:
    `TRACK_OUTPUTS`, which are joints, pose residual, lost (1 from the first sample on that the arm
    does not reach), joint-limit margin, manipulability and joint torque.

    The second sample has no earlier motion to extrapolate, so Newton steps from the start posture
    predict its joints.

    Args:
        robot, model, contact: the arm, its model, and its contact with the box.
        samples: number of samples.
        name: name of the new function.
    """
    start, pose = ca.MX.sym("start", model.n_joints), ca.MX.sym("pose", model.pose_size, samples)
    wrench, given = ca.MX.sym("wrench", 6, samples), mx_parameters(robot)
    track = track_function(robot, model, contact, f"{name}_sample")
    begin = start_function(robot, model, contact, f"{name}_start")
    first = track(
        begin(start, pose[:, 0], *given.values()), pose[:, 0], wrench[:, 0], *given.values()
    )
    predict = prediction_function(robot, model, contact, f"{name}_prediction")
    state = predict(first[0], pose[:, 1], *given.values())
    rest = track.mapaccum(f"{name}_samples", samples - 1)(
        state, pose[:, 1:], wrench[:, 1:], *tile(given, samples - 1)
    )
    return ca.Function(
        name,
        [start, pose, wrench, *given.values()],
        [ca.horzcat(one, more) for one, more in zip(first[1:], rest[1:], strict=True)],
        ["start", "pose", "wrench", *given],
        list(TRACK_OUTPUTS),
    )


def start_function(robot: Robot, model: RobotModel, contact: Contact, name: str) -> ca.Function:
    """Build the function of an arm's state before the first sample, the input of `track_function`.

    Inputs: start (n,), joints that hold the box at its first pose; pose (6 + m,), the first
    extended pose (box pose, then the cell's m redundant joints). The redundant joints move evenly
    from their start positions to their values in the extended pose, in `BEGIN_STEPS` Newton steps
    that keep the flange at the box. Output: state (3 n + 1,): the joints after these steps, zeros
    for their differences, and 0 because no sample was missed.

    Args:
        robot, model, contact: the arm, its model, and its contact with the box.
        name: name of the new function.
    """
    n = model.n_joints
    start, pose = ca.MX.sym("start", n), ca.MX.sym("pose", model.pose_size)
    numbers = mx_parameters(robot)
    q: Expression = start
    if model.redundant:
        q_start, at = ca.SX.sym("start", n), ca.SX.sym("q", n)
        given = ca.SX.sym("pose", model.pose_size)
        rotation = rotation_matrix(model.orientation, given[3:6])
        target = flange_target(robot, contact, given[:3], rotation)
        away = (model.with_redundant(q_start, given) - q_start) / BEGIN_STEPS
        moved = newton_step(model, at + away, *target)
        inputs = [q_start, at, given, *sx_parameters(robot).values()]
        move = _function(f"{name}_step", inputs, [moved])
        for _ in range(BEGIN_STEPS):
            q = move(start, q, pose, *numbers.values())
    state = ca.vertcat(q, ca.MX.zeros(2 * n + 1))
    inputs, names = [start, pose, *numbers.values()], ["start", "pose", *numbers]
    return ca.Function(name, inputs, [state], names, ["state"])


def prediction_function(
    robot: Robot, model: RobotModel, contact: Contact, name: str
) -> ca.Function:
    """Build the function that predicts an arm's motion from the first sample to the second.

    Inputs: state (3 n + 1,) of `track_function` after the first sample; pose (6 + m,), the extended
    pose of the second sample (box pose, then the cell's m redundant joints). Output: the state for
    the second sample, in which the joints' first difference is the one that Newton steps find, and
    the second difference zero.

    Args:
        robot, model, contact: the arm, its model, and its contact with the box.
        name: name of the new function.
    """
    n = model.n_joints
    state, pose = ca.SX.sym("state", 3 * n + 1), ca.SX.sym("pose", model.pose_size)
    rotation = rotation_matrix(model.orientation, pose[3:6])
    R_target, p_target = flange_target(robot, contact, pose[:3], rotation)
    start = state[:n]
    q = model.with_redundant(start, pose)
    for _ in range(IK_NEWTON_STEPS):
        q = newton_step(model, q, R_target, p_target)
    predicting = ca.vertcat(start, q - start, ca.SX.zeros(n), state[3 * n])
    given = sx_parameters(robot)
    inputs, names = [state, pose, *given.values()], ["state", "pose", *given]
    return ca.Function(name, inputs, ca.cse([predicting]), names, ["predicting"])


def posture_function(robots: Arms, models: Models, contacts: Contacts) -> ca.Function:
    """Build the function of both arms' postures at one box pose, from nearby joint positions.

    Inputs: pose (6,) of the box [m, rad]; guess_1, guess_2 (n,), nearby joint positions [rad]. The
    guess sets the redundant joints. Outputs: q_1, q_2 (n,) after `IK_NEWTON_STEPS` [rad];
    residual_1, residual_2, the pose residuals of q_1 and q_2 [m, rad].

    Args:
        robots: descriptions of both arms.
        models: models of both arms.
        contacts: contacts of both arms with the box.
    """
    pose = ca.SX.sym("pose", 6)
    guesses = [ca.SX.sym(f"guess_{i + 1}", model.n_joints) for i, model in enumerate(models)]
    rotation = rotation_matrix(models[0].orientation, pose[3:])
    postures, residuals = [], []
    for robot, model, contact, q in zip(robots, models, contacts, guesses, strict=True):
        R_target, p_target = flange_target(robot, contact, pose[:3], rotation)
        for _ in range(IK_NEWTON_STEPS):
            q = newton_step(model, q, R_target, p_target)
        R, p = model.placement(q)
        postures.append(q)
        residuals.append(pose_error(R_target, p_target, R, p)[1])
    given = sx_parameters(*robots)
    inputs = {"pose": pose, "guess_1": guesses[0], "guess_2": guesses[1]} | given
    names = ("q_1", "q_2", "residual_1", "residual_2")
    outputs = dict(zip(names, (*postures, *residuals), strict=True))
    return named_function("posture", inputs, outputs)


# --- Newton steps ---


MAX_JOINT_STEP = 0.5
"""Largest change of a joint in one Newton step, and between two samples of one motion [rad]."""

_POSTURES = 200
"""Number of random postures in which the axes of an arm are compared."""


def pose_error(R_target: ca.SX, p_target: ca.SX, R: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Compute the wanted minus the actual placement of a flange, in two forms.

    Args:
        R_target, p_target: wanted rotation (3, 3) and position (3,) [m] of the flange.
        R, p: actual rotation (3, 3) and position (3,) [m] in the same frame.

    Returns:
        Right-hand side (6,) of a Newton step: position error [m], then rotation axis times the sine
        of the error's angle. Scalar residual: the root of the summed squares of the position error
        [m] and of twice the sine of half the angle, which is zero for equal rotations only.
    """
    dR = ca.mtimes(R_target, R.T)
    axis = ca.vertcat(dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]) / 2.0
    dp = p_target - p
    turn_squared = ca.sumsqr(R_target - R) / 2.0
    return ca.vertcat(dp, axis), ca.sqrt(ca.sumsqr(dp) + turn_squared + 1e-40)


def newton_step(model: RobotModel, q: ca.SX, R_target: ca.SX, p_target: ca.SX) -> ca.SX:
    """Return the joints (n,) after one Newton step of the inverse kinematics, limited in length.

    Args:
        model: model of the arm.
        q: (n,) joint positions before the step [rad or m].
        R_target, p_target: wanted rotation (3, 3) and position (3,) [m] of the flange in the root.
    """
    R, p = model.placement(q)
    error, _ = pose_error(R_target, p_target, R, p)
    Q, upper = ca.qr(following_columns(model, model.jacobian(q)))
    step = ca.solve(upper, ca.mtimes(Q.T, error))
    return _limited(model, q, step)


def block_step(
    model: RobotModel, q: ca.SX, R_target: ca.SX, p_target: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the joints (n,) after a Newton step that needs few operations, and the pose residual
    before the step [m, rad].

    The step solves two 3 by 3 systems by Cramer's rule: the angular rows of the Jacobian give three
    joints in terms of the other three, which follow from the linear rows. Without pivoting the step
    fails where the axes of the first three joints nearly lie in a plane; the next residual is then
    large.

    Args:
        model: model of the arm.
        q: (n,) joint positions before the step [rad or m].
        R_target, p_target: wanted rotation (3, 3) and position (3,) [m] of the flange in the root.
    """
    R, p, whole = model.kinematics(q)
    jacobian = following_columns(model, whole)
    error, residual = pose_error(R_target, p_target, R, p)
    inner = _independent_axes(model)
    outer = list(_others(inner))
    linear, angular = jacobian[:3, :], jacobian[3:, :]
    solve = _cramer(angular[:, list(inner)])
    across = ca.horzcat(*[solve(angular[:, k]) for k in outer])
    turned = solve(error[3:])
    reduced = linear[:, outer] - ca.mtimes(linear[:, list(inner)], across)
    moved = _cramer(reduced)(error[:3] - ca.mtimes(linear[:, list(inner)], turned))
    rest = turned - ca.mtimes(across, moved)
    step = [ca.SX(0)] * 6
    for group, values in ((outer, moved), (inner, rest)):
        for k, joint in enumerate(group):
            step[joint] = values[k]
    return _limited(model, q, ca.vertcat(*step)), residual


def _cramer(A: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """Return a function that solves A x = b, with A (3, 3), for right sides b (3,)."""
    a, b, c = A[:, 0], A[:, 1], A[:, 2]
    rows = ca.cross(b, c), ca.cross(c, a), ca.cross(a, b)
    # The guard keeps CasADi from turning the products with a reciprocal into divisions.
    reciprocal = ca.fmin(1.0 / ca.dot(a, rows[0]), 1e300)
    return lambda right: ca.vertcat(*[ca.dot(row, right) * reciprocal for row in rows])


@lru_cache(maxsize=8)
def _independent_axes(model: RobotModel) -> tuple[int, ...]:
    """Return the indices of three of the six joints that follow the box, with independent axes.

    In random postures the axes of these three stay farthest from a common plane.
    """
    lower, upper = model.model.lowerPositionLimit, model.model.upperPositionLimit
    postures = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, len(lower)))
    jacobians = np.array(model.jacobian.map(_POSTURES)(postures.T)).reshape(6, _POSTURES, -1)
    axes = jacobians[3:, :, list(model.following)].transpose(1, 0, 2)

    def volume(joints: tuple[int, ...]) -> float:
        return float(np.quantile(np.abs(np.linalg.det(axes[:, :, list(joints)])), 0.1))

    return max(combinations(range(6), 3), key=volume)


def following_columns(model: RobotModel, jacobian: ca.SX) -> ca.SX:
    """Return those columns (6, 6) of an arm's Jacobian `jacobian` (6, n) that belong to the six
    joints which follow the box."""
    return jacobian[:, list(model.following)] if model.redundant else jacobian


def _limited(model: RobotModel, q: ca.SX, step: ca.SX) -> ca.SX:
    """Return the joints (n,) after a step of the six joints that follow the box.

    If a joint would move more than `MAX_JOINT_STEP`, the whole step is shortened. A step that is
    not finite is left out.

    Args:
        model: model of the robot.
        q: (n,) joint positions before the step [rad or m].
        step: (6,) change of the six joints [rad or m].
    """
    largest = ca.norm_inf(step)
    # At a singular posture the step is not a number: stay, and let the residual tell.
    usable = ca.norm_1(step) < 1e9
    scale = MAX_JOINT_STEP / ca.fmax(largest, MAX_JOINT_STEP)
    moved = list(ca.vertsplit(q))
    for k, joint in enumerate(model.following):
        moved[joint] = q[joint] + ca.if_else(usable, scale * step[k], 0.0)
    return ca.vertcat(*moved)


def manipulability(jacobian: ca.SX) -> ca.SX:
    """Compute abs(det(J)) [m^3] of a Jacobian J (6, 6), Yoshikawa's manipulability of six joints.

    The determinant is expanded in minors of three rows (Laplace). Without division it is exact at
    singular postures too.
    """
    upper, lower = _minors(jacobian[:3, :]), _minors(jacobian[3:, :])
    signed = [
        (-1.0) ** (sum(chosen) - 3) * minor * lower[_others(chosen)]
        for chosen, minor in upper.items()
    ]
    return ca.fabs(reduce(add, signed))


def _others(joints: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(k for k in range(6) if k not in joints)


def _minors(rows: ca.SX) -> dict[tuple[int, ...], ca.SX]:
    """Compute the determinants of all 3 by 3 submatrices of a matrix `rows` (3, 6). The key is the
    triple of their column indices."""
    pairs = {
        (i, j): rows[1, i] * rows[2, j] - rows[1, j] * rows[2, i]
        for i, j in combinations(range(6), 2)
    }
    return {
        (i, j, k): rows[0, i] * pairs[j, k] - rows[0, j] * pairs[i, k] + rows[0, k] * pairs[i, j]
        for i, j, k in combinations(range(6), 3)
    }
