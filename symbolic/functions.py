"""The functions that are compiled, by their users.

A whole candidate, from its decision vector to every sample: path, time law, payload load and both
arms composed. The outputs hold one sample per column, so that NumPy sees (n_samples, dim). For the
evaluator also postures and collision bounds; for timings the derivatives along the path.
"""

from __future__ import annotations

import casadi as ca

from symbolic.cell_model import CellModel
from symbolic.contact.load import LOAD_OUTPUTS, load_function, uncertain_load_function
from symbolic.contact.registry import contact_model
from symbolic.expression import (
    mx_parameters,
    named_function,
    select_parameters,
    sx_parameters,
    tile,
)
from symbolic.geometry.screen import Screen
from symbolic.limit_coefficients import path_force_function
from symbolic.path.spline import extended_matrix, sample_basis, waypoint_matrix
from symbolic.path.time_law import driven_path, timed_path
from symbolic.path_motion import arm_derivative_function, path_motion_function, start_posture
from symbolic.records import Task, Workcell
from symbolic.records.quantities import GRAVITY
from symbolic.robot.arm import (
    REACH_TOLERANCE,
    TRACK_OUTPUTS,
    follow_function,
    posture_function,
    prediction_function,
    start_function,
    torque_function,
    track_function,
)
from symbolic.robot.branches import approach_function

CONSTRAINTS = (
    "reach_1",
    "reach_2",
    "joint_limits_1",
    "joint_limits_2",
    "singularity_1",
    "singularity_2",
    "friction",
    "pressure_1",
    "pressure_2",
)
"""Columns of the `constraint` output, each at most 0 where a sample satisfies it.

reach: pose residual over its tolerance [m, rad], or 1 once the arm lost the path.
joint_limits: excess over the nearest limit [rad]. singularity: 1 - |det J| over its least value.
friction: excess of the tangential over the limiting force, over the payload's weight.
pressure: shift of the centre of pressure over the patch radius, minus 1.
Limits and singularity of a lost arm are unknown and count as satisfied; its loss does not.
"""

DRIVE_INPUTS = ("drive_time", "drive_speed", "drive_acceleration")
"""Names of the inputs that describe the timing of a drivable candidate: (n,) times [s], u' [1/s]
and u'' [1/s^2] at the samples, found by a solver."""

TIMING_TOLERANCE = 5e-3
"""Allowed excess of a timing over a limit, as a share of the limit (`hybrid_opt.timing.solve`)."""

FRICTION_TOLERANCE = 1e-9
"""Excess over a friction cone that counts as rounding, as a share of the payload's weight."""


def candidate_function(model: CellModel) -> ca.Function:
    """Build the evaluator of one candidate: from the decision vector to all quantities at its n
    samples.

    Input: x (n_var,); in drivable cells also the inputs named in `DRIVE_INPUTS`; then the cell's
    symbolic parameters.

    Outputs (NumPy shapes): time (n,) [s]; pose (n, 6) of the box [m, rad]; rate and second_rate (n,
    6), the time derivatives of the pose; every output in `LOAD_OUTPUTS` except the wrenches; for
    robot i = 1, 2 every output in `TRACK_OUTPUTS` with the suffix _i, such as q_i (n, joints)
    [rad]; constraint (n, 9) with the columns `CONSTRAINTS`; violation (9,), the largest positive
    value of each constraint over the samples; violation_time (9,), the share of the duration during
    which each constraint is violated.
    """
    workcell = model.workcell
    n = workcell.task.samples
    x, basis, groups = ca.MX.sym("x", workcell.task.n_var), sample_basis(workcell.task), _all(model)
    inputs = {"x": x}
    waypoints, own = _waypoints(workcell.task, x, groups), select_parameters(groups, workcell.task)
    if workcell.task.law.is_drivable:
        inputs |= {name: ca.MX.sym(name, n) for name in DRIVE_INPUTS}
        path = driven_path(basis, waypoints, *[inputs[name].T for name in DRIVE_INPUTS])
    else:
        path = timed_path(workcell.task, basis, waypoints, groups=own)
    inputs |= groups
    held = tile(select_parameters(groups, workcell.payload), n)
    found = load_function(workcell).map(n)(path.pose, path.rate, path.second_rate, *held)
    load = dict(zip(LOAD_OUTPUTS, found, strict=True))
    outputs: dict[str, ca.MX] = {
        "time": path.time,
        "pose": path.pose,
        "rate": path.rate,
        "second_rate": path.second_rate,
        **{name: load[name] for name in LOAD_OUTPUTS if not name.startswith("wrench")},
    }
    whole = extended_matrix(workcell.task, x, waypoints, own)
    pose = ca.mtimes(whole, ca.DM(basis.position.T))
    for i in (0, 1):
        tracked = _track(model, i, pose, load[f"wrench_{i + 1}"], groups)
        outputs |= {f"{name}_{i + 1}": tracked[name] for name in TRACK_OUTPUTS}
    constraint = _constraints(workcell, outputs, n, groups)
    violated = ca.fmax(constraint, 0.0)
    outputs["constraint"] = constraint
    outputs["violation"] = _row_max(violated)
    outputs["violation_time"] = ca.mtimes(violated > 0.0, _time_share(path.time).T)
    return named_function("candidate", inputs, outputs)


def _all(model: CellModel) -> dict[str, ca.MX]:
    """Return one MX column for each parameter group that the evaluation of a candidate needs, by
    the group's name."""
    workcell = model.workcell
    return mx_parameters(workcell.task, *workcell.robots, model, workcell.payload)


def _waypoints(task: Task, x: ca.MX, groups: dict[str, ca.MX]) -> ca.MX:
    return waypoint_matrix(task, x, select_parameters(groups, task))


def _constraints(
    workcell: Workcell, values: dict[str, ca.MX], n: int, groups: dict[str, ca.MX]
) -> ca.MX:
    """Build the constraint values (9, n) at n samples, one row for each of `CONSTRAINTS`. A value
    is at most 0 where the sample satisfies the constraint.

    Args:
        workcell: cell with symbolic parameters.
        values: quantities (rows, n) at the samples by name, at least those in `_CONSTRAINT_INPUTS`.
        n: number of samples.
        groups: MX vectors of the cell's parameters, by name of the parameter group.
    """
    numbers = tile(select_parameters(groups, *workcell.robots, workcell.payload), n)
    inputs = [values[name] for name in _CONSTRAINT_INPUTS]
    return _constraint_function(workcell).map(n)(*inputs, *numbers)


def motion_function(model: CellModel) -> ca.Function:
    """Build the function of one candidate's motion without forces, for cells that are not drivable.

    Inputs: x (n_var,), then the cell's symbolic parameters. Outputs, with shapes and units as in
    `candidate_function`: time, pose, q_1, q_2, and violation (9,), in which the entries of friction
    and pressure are 0.
    """
    workcell = model.workcell
    n = workcell.task.samples
    x, basis, groups = ca.MX.sym("x", workcell.task.n_var), sample_basis(workcell.task), _all(model)
    waypoints, own = _waypoints(workcell.task, x, groups), select_parameters(groups, workcell.task)
    path = timed_path(workcell.task, basis, waypoints, groups=own)
    whole = extended_matrix(workcell.task, x, waypoints, own)
    pose = ca.mtimes(whole, ca.DM(basis.position.T))
    values = {name: ca.DM.zeros(2, n) for name in _CONSTRAINT_INPUTS[-3:]}
    for i in (0, 1):
        tracked = _track(model, i, pose, ca.DM.zeros(6, n), groups)
        values |= {f"{name}_{i + 1}": tracked[name] for name in TRACK_OUTPUTS}
    constraint = _constraints(workcell, values, n, groups)
    outputs = {
        "time": path.time,
        "pose": path.pose,
        "q_1": values["q_1"],
        "q_2": values["q_2"],
        "violation": _row_max(ca.fmax(constraint, 0.0)),
    }
    return named_function("motion_alone", {"x": x} | groups, outputs)


_LOAD_SIZES = {
    "angular_velocity": 3,
    "angular_acceleration": 3,
    "normal_force": 2,
    "tangential_force": 2,
    "contact_force": 6,
    "pressure_shift": 2,
    "shift_vector": 6,
    "required_moment": 3,
    "point_moment_residual": 3,
    "moment_residual": 3,
}

FORCE_CONSTRAINTS = CONSTRAINTS[6:]
"""Names of the constraints that depend on the contact forces."""

SAMPLE_NAMES = frozenset(
    (*_LOAD_SIZES, *(f"{name}_{i}" for i in (1, 2) for name in TRACK_OUTPUTS), "constraint")
)
"""Names of all outputs that the function `sample` of `sample_functions` may have after the two
states."""


def sample_sizes(workcell: Workcell) -> dict[str, int]:
    """Return the number of entries of each output of the function `sample` (`sample_functions`), by
    the output's name. The states of both arms, its first two outputs, are left out."""
    sizes = dict(_LOAD_SIZES)
    for i, robot in enumerate(workcell.robots, start=1):
        joints = robot.position_lower.shape[0]
        own = dict.fromkeys(TRACK_OUTPUTS, 1) | {"q": joints, "joint_torque": joints}
        sizes |= {f"{name}_{i}": size for name, size in own.items()}
    return sizes | {"constraint": len(CONSTRAINTS)}


def forces_come_last(workcell: Workcell) -> bool:
    """Return True if a convex program computes the contact forces. Forces are then computed only
    for candidates whose motion violates no constraint."""
    return not contact_model(workcell).has_closed_form


def force_sizes(workcell: Workcell) -> dict[str, int]:
    """Return the number of entries of each output of the function `forces` (`sample_functions`), by
    the output's name."""
    torques = [f"joint_torque_{i}" for i in (1, 2)]
    sizes = _LOAD_SIZES | {name: sample_sizes(workcell)[name] for name in torques}
    return sizes | {"force_constraint": len(FORCE_CONSTRAINTS)}


def sample_functions(model: CellModel) -> dict[str, ca.Function]:
    """Build the evaluation of a candidate in parts that are composed sample by sample, by name.
    There are none for drivable cells. An arm's state is the input of
    `symbolic.robot.arm.track_function`.

    - path takes x (n_var,). It returns time (1, n); pose (6 + m, n), the extended poses; rate and
      second_rate (6, n), the time derivatives of the box pose.
    - start takes the first pose and the joints of both arms at the start. It returns state_1 and
      state_2, each arm's state before the first sample.
    - predict takes state_1 and state_2 after the first sample and the second pose. It returns both
      states with the predicted change of the joints to the second sample.
    - sample takes pose, rate, second_rate, state_1 and state_2. It returns next_state_1,
      next_state_2, then the outputs named by `sample_sizes`. Where `forces_come_last`, the outputs
      of forces are zero.
    - forces exists only where `forces_come_last`. It takes pose, rate, second_rate and the joints
      of both arms, and returns the outputs named by `force_sizes`.

    The last inputs of each function are the parameter groups that `kernel_numbers` names.
    """
    workcell = model.workcell
    x, basis, groups = ca.MX.sym("x", workcell.task.n_var), sample_basis(workcell.task), _all(model)
    own, held = (
        select_parameters(groups, workcell.task),
        select_parameters(groups, workcell.payload),
    )
    arms = select_parameters(groups, *workcell.robots)
    waypoints = _waypoints(workcell.task, x, groups)
    path = timed_path(workcell.task, basis, waypoints, groups=own)
    extended = extended_matrix(workcell.task, x, waypoints, own)
    whole = ca.mtimes(extended, ca.DM(basis.position.T))
    motion = [path.time, whole, path.rate, path.second_rate]
    pose = ca.MX.sym("pose", workcell.task.extended_size)
    box = [pose[:6], *[ca.MX.sym(name, 6) for name in ("rate", "second_rate")]]
    found = load_function(workcell).call([*box, *held.values()])
    load = dict(zip(LOAD_OUTPUTS, found, strict=True))
    apart = forces_come_last(workcell)
    outputs = {k: ca.MX(ca.DM.zeros(v.shape)) for k, v in load.items()} if apart else load
    states, starts, following, predicted = [], [], [], []
    begins = [ca.MX.sym(f"begin_{i + 1}", arm.n_joints) for i, arm in enumerate(model.robots)]
    for i in (0, 1):
        arm = (workcell.robots[i], model.robots[i], workcell.contacts[i])
        given = select_parameters(groups, workcell.robots[i]).values()
        starts.append(start_function(*arm, f"arm_{i + 1}_start")(begins[i], pose, *given))
        state = ca.MX.sym(f"state_{i + 1}", starts[i].shape[0])
        states.append(state)
        track = track_function(*arm, f"arm_{i + 1}_sample")
        after, *tracked = track(state, pose, outputs[f"wrench_{i + 1}"], *given)
        following.append(after)
        outputs |= {
            f"{name}_{i + 1}": value for name, value in zip(TRACK_OUTPUTS, tracked, strict=True)
        }
        predict = prediction_function(*arm, f"arm_{i + 1}_prediction")
        predicted.append(predict(state, pose, *given))
    outputs["constraint"] = _constraints(workcell, outputs, 1, groups)
    sizes = sample_sizes(workcell)
    results = [*following, *(outputs[name] for name in sizes)]
    names = ["next_state_1", "next_state_2", *sizes]
    asked = [pose, *box[1:], *states, *arms.values(), *held.values()]
    return {
        "path": ca.Function("path", [x, *own.values()], motion, {"cse": True}),
        "start": ca.Function("start", [pose, *begins, *arms.values()], starts),
        "predict": ca.Function("predict", [*states, pose, *arms.values()], predicted),
        "sample": ca.Function("sample", asked, results, [v.name() for v in asked], names),
        **({"forces": _forces_function(model, (pose, *box[1:]), load, groups)} if apart else {}),
    }


def kernel_numbers(workcell: Workcell, screen: Screen) -> dict[str, tuple[str, ...]]:
    """Return which parameter groups each function of `kernel_functions` takes as its last inputs.

    Args:
        workcell: the cell, with symbols as parameters.
        screen: constants of the bodies' distance bounds, with symbols as parameters.

    Returns:
        Names of the groups in the order of the inputs, by name of the function.
    """
    arms, held = tuple(sx_parameters(*workcell.robots)), tuple(sx_parameters(workcell.payload))
    bodies = tuple(sx_parameters(screen))
    found = {"path": tuple(sx_parameters(workcell.task)), "start": arms, "predict": arms}
    found |= {"sample": (*arms, *held)}
    found |= dict.fromkeys(("clearance", "far_clearance", "piece_poses"), bodies)
    return found | ({"forces": (*arms, *held)} if forces_come_last(workcell) else {})


def _forces_function(
    model: CellModel,
    motion: tuple[ca.MX, ...],
    load: dict[str, ca.MX],
    groups: dict[str, ca.MX],
) -> ca.Function:
    """Build the function `forces` that `sample_functions` describes: contact forces, joint torques
    and their constraints at one sample.

    Args:
        model: model of the cell.
        motion: symbols of the extended pose, and of the first and second time derivative (6,) of
            the box pose.
        load: expressions of the outputs `symbolic.contact.load.LOAD_OUTPUTS`, by name.
        groups: MX vectors of the cell's parameters, by name of the parameter group.
    """
    workcell = model.workcell
    joints = [ca.MX.sym(f"q_{i + 1}", model.robots[i].n_joints) for i in (0, 1)]
    outputs = dict(load)
    for i, q in enumerate(joints):
        arm = (workcell.robots[i], model.robots[i], workcell.contacts[i])
        torque, own = (
            torque_function(*arm, f"arm_{i + 1}_torque"),
            select_parameters(groups, arm[0]).values(),
        )
        outputs[f"joint_torque_{i + 1}"] = torque(q, motion[0], load[f"wrench_{i + 1}"], *own)
    known = dict.fromkeys(_CONSTRAINT_INPUTS[:-3], ca.DM.zeros(1))
    constraint = _constraints(workcell, outputs | known, 1, groups)
    outputs["force_constraint"] = constraint[-len(FORCE_CONSTRAINTS) :]
    names = list(force_sizes(workcell))
    given = [
        *motion,
        *joints,
        *select_parameters(groups, *workcell.robots, workcell.payload).values(),
    ]
    results = [outputs[name] for name in names]
    return ca.Function("forces", given, results, [v.name() for v in given], names)


def _track(
    model: CellModel, i: int, pose: ca.MX, wrench: ca.MX, groups: dict[str, ca.MX]
) -> dict[str, ca.MX]:
    robot, contact = model.workcell.robots[i], model.workcell.contacts[i]
    n = model.workcell.task.samples
    follow = follow_function(robot, model.robots[i], contact, n, f"arm_{i + 1}")
    start = start_posture(model, i, groups)
    results = follow(start, pose, wrench, *select_parameters(groups, robot).values())
    return dict(zip(TRACK_OUTPUTS, results, strict=True))


_CONSTRAINT_INPUTS = (
    "ik_residual_1",
    "ik_residual_2",
    "lost_1",
    "lost_2",
    "limit_margin_1",
    "limit_margin_2",
    "manipulability_1",
    "manipulability_2",
    "normal_force",
    "tangential_force",
    "pressure_shift",
)


def _constraint_function(workcell: Workcell) -> ca.Function:
    """Build the function of the constraint values (9,) of one sample, in the order of
    `CONSTRAINTS`. A value is at most 0 where the sample satisfies the constraint.

    Inputs: the quantities that `_CONSTRAINT_INPUTS` names, from inverse kinematics and contact
    forces.
    """
    sizes = {"normal_force": 2, "tangential_force": 2, "pressure_shift": 2}
    inputs = {name: ca.SX.sym(name, sizes.get(name, 1)) for name in _CONSTRAINT_INPUTS}
    given = sx_parameters(*workcell.robots, workcell.payload)
    weight = -workcell.payload.mass * GRAVITY[2]
    values: dict[str, ca.SX] = {}
    cones = []
    for i in (0, 1):
        robot, contact, arm = workcell.robots[i], workcell.contacts[i], i + 1
        lost = inputs[f"lost_{arm}"]
        off_path = ca.fmax(inputs[f"ik_residual_{arm}"] - REACH_TOLERANCE, lost)
        values[f"reach_{arm}"] = ca.if_else(lost > 0.5, off_path, -REACH_TOLERANCE)
        values[f"joint_limits_{arm}"] = ca.if_else(lost > 0.5, 0.0, -inputs[f"limit_margin_{arm}"])
        values[f"singularity_{arm}"] = ca.if_else(
            lost > 0.5, 0.0, 1.0 - inputs[f"manipulability_{arm}"] / robot.min_manipulability
        )
        allowed = 1.0 + (TIMING_TOLERANCE if workcell.task.law.is_drivable else 0.0)
        values[f"pressure_{arm}"] = inputs["pressure_shift"][i] / contact.patch_radius - allowed
        limit = contact.friction * inputs["normal_force"][i]
        cones.append((inputs["tangential_force"][i] - limit) / weight - FRICTION_TOLERANCE)
    values["friction"] = ca.fmax(cones[0], cones[1])
    return ca.Function(
        "constraints",
        [*inputs.values(), *given.values()],
        [ca.vertcat(*[values[name] for name in CONSTRAINTS])],
    )


def _row_max(matrix: ca.MX) -> ca.MX:
    return ca.vertcat(*[ca.mmax(matrix[i, :]) for i in range(matrix.shape[0])])


def _time_share(time: ca.MX) -> ca.MX:
    """Compute the share (1, n) of the whole duration that each sample represents, from the middle
    of the time step before it to the middle of the one after it. The shares add up to 1.

    Args:
        time: (1, n) times of the samples [s], beginning at 0.
    """
    steps = time[:, 1:] - time[:, :-1]
    return (ca.horzcat(0.0, steps) + ca.horzcat(steps, 0.0)) / (2.0 * time[-1])


# --- sets of functions ---


def arm_functions(model: CellModel) -> dict[str, ca.Function]:
    """Build the functions of a cell that do not depend on collision bodies, by name.

    - candidate evaluates a whole candidate (`candidate_function`).
    - inverse_dynamics_i, for arm i = 1, 2, computes the joint torques that move the arm without the
      box (`symbolic.robot.model.RobotModel.inverse_dynamics`).
    - posture computes the joint positions of both arms at one box pose
      (`symbolic.robot.arm.posture_function`).
    """
    return {
        "candidate": candidate_function(model),
        **{f"inverse_dynamics_{i + 1}": model.robots[i].inverse_dynamics for i in (0, 1)},
        "posture": posture_function(model.workcell.robots, model.robots, model.workcell.contacts),
    }


def cell_functions(model: CellModel) -> dict[str, ca.Function]:
    """Build all compiled functions of a cell, by name: those of `arm_functions`, and those of
    `symbolic.geometry.clearance.screening_functions`, which bound the distances of bodies."""
    return arm_functions(model) | model.screening


def branch_functions(model: CellModel) -> dict[str, ca.Function]:
    """Build the functions that find the start branches of the arms, by name.

    - poses takes waypoints (6 + m, w), the extended poses at w waypoints. It returns poses (6 + m,
      n), the extended poses of all samples.
    - approach_i, for arm i = 1, 2, solves the inverse kinematics at the start; see
      `symbolic.robot.branches.approach_function`.
    - follow_i, for arm i = 1, 2, computes the joints along the path; see
      `symbolic.robot.arm.follow_function`.
    """
    task = model.workcell.task
    waypoints = ca.SX.sym("waypoints", task.extended_size, len(task.waypoints))
    poses = waypoints @ ca.DM(sample_basis(task).position.T)
    found = {"poses": ca.Function("poses", [waypoints], [poses], ["waypoints"], ["poses"])}
    for i, (robot, contact) in enumerate(
        zip(model.workcell.robots, model.workcell.contacts, strict=True)
    ):
        own, name = model.robots[i], f"follow_{i + 1}"
        found[f"approach_{i + 1}"] = approach_function(own, f"approach_{i + 1}")
        found[name] = follow_function(robot, own, contact, model.workcell.task.samples, name)
    return found


def kernel_functions(model: CellModel) -> dict[str, ca.Function]:
    """Build the functions from which compiled code composes the evaluation of a candidate, by name.

    These are all functions of `sample_functions` (path, start, predict, sample and, in some cells,
    forces), and clearance, far_clearance and piece_poses of
    `symbolic.geometry.clearance.screening_functions`, the distances and poses of bodies.
    """
    motions = [f"{block}motion" for block in model.geometry.blocks]
    screening = {name: f for name, f in model.screening.items() if name not in motions}
    return sample_functions(model) | screening


def timing_functions(model: CellModel, samples: int) -> dict[str, ca.Function]:
    """Build the functions for the timing of paths in one workcell, by name.

    - path_motion computes the geometry of a path at uniform samples (`symbolic.path_motion`).
    - load and uncertain_load compute contact forces (`symbolic.contact.load`).
    - path_force computes normal forces and their derivatives by the timing
      (`symbolic.limit_coefficients.path_force_function`).
    - arm_1 and arm_2 compute joint derivatives and torques of an arm along a path
      (`symbolic.path_motion.arm_derivative_function`).

    Args:
        model: the cell.
        samples: number of samples of path_motion.
    """
    workcell = model.workcell
    functions = {
        "path_motion": path_motion_function(model, samples),
        "load": load_function(workcell),
        "uncertain_load": uncertain_load_function(workcell),
        "path_force": path_force_function(workcell),
    }
    for i, (robot, robot_model, contact) in enumerate(
        zip(workcell.robots, model.robots, workcell.contacts, strict=True), start=1
    ):
        functions[f"arm_{i}"] = arm_derivative_function(robot, robot_model, contact, f"arm_{i}")
    return functions
