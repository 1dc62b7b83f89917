"""Coefficients of the limits on the timing of a path, for the compiled passes and the polish.

`symbolic.path_motion` gives a carry's geometry in physical quantities. Here every limit at a sample
is a function of (u'', u'^2) with its coefficients packed in one vector. The path parameter u is in
[0, 1], u' and u'' are its time derivatives; they are the timing at a sample.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from symbolic.cell_model import CellModel
from symbolic.contact.force_closure import WRENCH_SIZE
from symbolic.contact.grasp import Grasp
from symbolic.contact.load import frictions
from symbolic.contact.model import ContactLoad, ImplicitVariables
from symbolic.contact.registry import contact_model
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.expression import (
    as_mx,
    mx_parameters,
    named_function,
    number,
    select_parameters,
    sx_parameters,
)
from symbolic.limits import limit_layout
from symbolic.path.spline import path_basis, waypoint_matrix
from symbolic.path_motion import (
    ARM_OUTPUTS,
    BOX_OUTPUTS,
    arm_derivative_function,
    box_function,
    extended_motion,
    start_posture,
)
from symbolic.records import Workcell
from symbolic.records.quantities import GRAVITY
from symbolic.robot.arm import TRACK_OUTPUTS, follow_function

ARM_CHECK_OUTPUTS = ("ik_residual", "lost", "limit_margin", "manipulability")
"""Outputs of `symbolic.robot.arm.TRACK_OUTPUTS` about an arm's errors."""

TIMING_BARRIER_WEIGHT = 1e-6
"""Weight of the barriers if a program finds the forces (`symbolic.contact.soft_grasp`): these
exceed the least ones by less than the accuracy of timings."""

PATH_OUTPUTS = ("pose", "pose_first", "pose_second", "q_1", "q_2")
"""Outputs of `path_function` that `sample_limits_function` takes; poses are extended by the
redundant joints."""


def path_function(model: CellModel, samples: int) -> ca.Function:
    """Build the function of box pose and joints along a path, at n uniform samples of u, without
    forces.

    Input: x (n_path,), the variables of the path [m, rad]; then the cell's symbolic parameters.

    Outputs (NumPy shapes): pose (n, 6 + m), the box pose with the m redundant joints [m, rad];
    pose_first and pose_second, its first and second derivative by u; q_1 and q_2 (n, joints), joint
    positions [rad or m]; then for each arm i = 1, 2 ik_residual_i, lost_i, limit_margin_i and
    manipulability_i (n,), explained in `symbolic.robot.arm.TRACK_OUTPUTS`.

    Args:
        model: the cell.
        samples: number n of samples from u = 0 to u = 1, at least 3.
    """
    workcell = model.workcell
    x, task = ca.MX.sym("x", workcell.task.n_path), workcell.task
    groups = mx_parameters(task, *workcell.robots, model)
    waypoints = waypoint_matrix(task, x, select_parameters(groups, task))
    basis = path_basis(len(task.waypoints), np.linspace(0.0, 1.0, samples))
    moved = extended_motion(task, x, basis, waypoints, select_parameters(groups, task))
    outputs = dict(zip(PATH_OUTPUTS, moved, strict=False))
    no_wrench = ca.DM.zeros(6, samples)
    verdicts: dict[str, ca.MX] = {}
    for i, (robot, contact) in enumerate(zip(workcell.robots, workcell.contacts, strict=True)):
        follow = follow_function(robot, model.robots[i], contact, samples, f"limits_arm_{i + 1}")
        start = start_posture(model, i, groups)
        results = follow(
            start, outputs["pose"], no_wrench, *select_parameters(groups, robot).values()
        )
        tracked = dict(zip(TRACK_OUTPUTS, results, strict=True))
        outputs[f"q_{i + 1}"] = tracked["q"]
        verdicts |= {f"{name}_{i + 1}": tracked[name] for name in ARM_CHECK_OUTPUTS}
    outputs |= verdicts
    return named_function("path", {"x": x} | groups, outputs)


def sample_limits_function(model: CellModel) -> ca.Function:
    """Build the function of the coefficients of all timing limits at one sample.

    Inputs: `PATH_OUTPUTS` of the sample: pose and its two derivatives by u, (6 + m,) each, and the
    joints q_1, q_2; then the symbolic parameters `limit_numbers`. Output: limits, one vector laid
    out by `limit_layout`.
    """
    workcell = model.workcell
    payload, task, layout = workcell.payload, workcell.task, limit_layout(workcell)
    given = [ca.SX.sym(name, task.extended_size) for name in ("pose", "first", "second")]
    pose, first, second = (values[:6] for values in given)
    held = sx_parameters(payload).values()
    box = dict(zip(BOX_OUTPUTS, box_function(workcell)(pose, first, second, *held), strict=True))
    rotation = ca.reshape(box["rotation"], 3, 3).T
    axes = ca.mtimes(rotation, number(workcell.contacts[0].T_box_pad[:3, :3]))
    q, speed, by_a, by_w, torque, wrench = [], [], [], [], [], []
    for i, (robot, contact) in enumerate(zip(workcell.robots, workcell.contacts, strict=True)):
        q.append(ca.SX.sym(f"q_{i + 1}", robot.velocity_max.shape[0]))
        derivatives = arm_derivative_function(robot, model.robots[i], contact, f"limits_of_{i + 1}")
        own_numbers = sx_parameters(robot).values()
        arm = dict(zip(ARM_OUTPUTS, derivatives(q[i], *given, *own_numbers), strict=True))
        torque_max = number(robot.torque_max)
        speed.append(arm["q_first"] / number(robot.velocity_max))
        by_a.append(arm["q_first"] / number(robot.acceleration_max))
        by_w.append(arm["q_second"] / number(robot.acceleration_max))
        own = ("torque_by_acceleration", "torque_by_speed", "torque_at_rest")
        torque.append(ca.horzcat(*[arm[name] / torque_max for name in own]))
        world = ca.reshape(arm["wrench_torque"], 6, robot.velocity_max.shape[0]).T
        turned = ca.mtimes(world, ca.diagcat(axes, axes))
        wrench.append(ca.mtimes(ca.diag(1.0 / torque_max), turned))
    linear, angular = ca.norm_2(first[:3]), ca.norm_2(box["angular_first"])
    weight = ca.DM(GRAVITY) * payload.mass
    forces = (box["force_by_acceleration"], box["force_by_speed"], -weight)
    moments = (box["moment_by_acceleration"], box["moment_by_speed"])
    blocks = {
        "speed": ca.vertcat(
            *speed,
            linear / payload.velocity_max,
            angular / payload.angular_velocity_max,
            linear / task.reference_speed,
            angular / task.reference_angular_speed,
        ),
        "acceleration": ca.vertcat(*by_a, *by_w),
        "cone": ca.vertcat(
            ca.vertcat(first[:3], second[:3]) / payload.acceleration_max,
            ca.vertcat(box["angular_first"], box["angular_second"])
            / payload.angular_acceleration_max,
        ),
        "force": ca.vertcat(*[ca.mtimes(axes.T, force) for force in forces]),
        "moment": ca.vertcat(*[ca.mtimes(axes.T, moment) for moment in moments]),
        "torque": ca.vec(ca.vertcat(*torque)),
        "wrench": ca.vec(ca.vertcat(*wrench).T),
    }
    assert {name: block.shape[0] for name, block in blocks.items()} == layout.sizes
    limits = ca.vertcat(*[ca.densify(blocks[name]) for name in layout.sizes])
    inputs = dict(zip(PATH_OUTPUTS, (*given, *q), strict=True)) | limit_numbers(workcell)
    return named_function("sample_limits", inputs, {"limits": limits})


def limit_numbers(workcell: Workcell) -> dict[str, ca.SX]:
    """Return the symbolic parameters that `sample_limits_function` takes after its other inputs, by
    group."""
    return sx_parameters(workcell.task, *workcell.robots, workcell.payload)


def _contact_load(workcell: Workcell, blocks: dict[str, ca.SX], a: ca.SX, w: ca.SX) -> ContactLoad:
    """Return the load on the contacts at one sample, with all vectors along the axes of contact 1.

    Args:
        workcell: the cell.
        blocks: by name, the block force (9,) of `limit_layout`, required force by u'', by u'^2 and
            at rest [N], and the block moment (6,), required moment by u'' and by u'^2 [N m].
        a: second time derivative u'' of the path parameter.
        w: square u'^2 of its first time derivative.
    """
    by = [blocks["force"][3 * k : 3 * k + 3] for k in range(3)]
    axes, centre = workcell.contacts[0].T_box_pad[:3, :3], workcell.payload.centre_of_mass
    arms = [ca.SX(number(axes.T @ (c.T_box_pad[:3, 3] - centre))) for c in workcell.contacts]
    return ContactLoad(
        by[0] * a + by[1] * w + by[2],
        blocks["moment"][:3] * a + blocks["moment"][3:] * w,
        (arms[0], arms[1]),
        ca.SX(ca.DM.eye(3)),
        frictions(workcell),
    )


def force_functions(workcell: Workcell) -> tuple[ca.Function, ca.Function]:
    """Build the functions of both normal forces at one sample, and of their derivatives by u'' and
    u'^2, where u is the path parameter.

    limit_forces takes sample (15,), the blocks force (9) and moment (6) of `limit_layout`; a = u'';
    w = u'^2; then the payload's symbolic parameters. It returns the normal forces (2,) [N], which
    are convex in a and w, and the solved variables (k,): results of Newton's method for soft
    fingers, or the state of the convex program that finds the forces.

    limit_force_slopes takes the same inputs and the solved variables. It returns the forces (2,)
    and their derivatives (2,) by a and (2,) by w. Forces of a convex program are then those on its
    central path (`symbolic.contact.soft_grasp`).
    """
    sizes = limit_layout(workcell).sizes
    names = ("limit_forces", "limit_force_slopes")
    if not contact_model(workcell).has_closed_form:
        groups = mx_parameters(workcell.payload)
        asked = [ca.MX.sym("asked", sizes["force"] + sizes["moment"]), *map(ca.MX.sym, "aw")]
        asked += groups.values()
        load, by_timing = _load_function(workcell)(*asked)
        soft = SoftGrasp(Grasp(workcell), TIMING_BARRIER_WEIGHT)
        found, state = soft.solve(load, groups), ca.MX.sym("solved", soft.size)
        normal, slope = soft.slopes()(state, *groups.values())
        slopes = ca.horzsplit(ca.mtimes(slope.T, by_timing))
        alone = ca.densify(ca.mtimes(soft.normals, found))
        return (
            ca.Function(names[0], asked, [alone, found]),
            ca.Function(names[1], [*asked, state], [normal, *slopes]),
        )
    blocks = {name: ca.SX.sym(name, sizes[name]) for name in ("force", "moment")}
    inputs, alone, sloping = _inputs(workcell, blocks), ImplicitVariables(0), ImplicitVariables(1)
    load = _contact_load(workcell, blocks, inputs["a"], inputs["w"])
    value, varied = (contact_model(workcell).hold(load, of).normal for of in (alone, sloping))
    found = alone.replaced([ca.densify(value), alone.symbols])
    outputs = dict(zip(("value", "solved"), found, strict=True))
    return named_function(names[0], inputs, outputs), _slopes(names[1], varied, inputs, sloping)


def _load_function(workcell: Workcell) -> ca.Function:
    """Build the function of the load that the pads have to balance at one sample, and of its
    derivatives by u'' and u'^2, where u is the path parameter.

    Inputs: vector (15,) of the blocks force (9) and moment (6) of `limit_layout`: the coefficients
    of u'', u'^2 and 1 in the required force, and of u'' and u'^2 in the required moment; u''
    [1/s^2]; u'^2 [1/s^2]; then the payload's symbolic parameters. Outputs: load (6,), force and
    moment about the box frame's origin, along the box's axes [N, N m]; and the derivatives (6, 2)
    of the load by u'' and by u'^2.
    """
    size = limit_layout(workcell).sizes["force"]
    payload = workcell.payload
    axes, centre = number(workcell.contacts[0].T_box_pad[:3, :3]), number(payload.centre_of_mass)
    asked = ca.SX.sym("asked", size + limit_layout(workcell).sizes["moment"])
    timing = ca.SX.sym("timing", 2)
    factors = ca.vertcat(timing, 1.0)
    force = ca.mtimes(axes, ca.mtimes(ca.reshape(asked[:size], 3, 3), factors))
    about = ca.mtimes(axes, ca.mtimes(ca.reshape(asked[size:], 3, 2), timing))
    load = ca.vertcat(force, about + ca.cross(ca.SX(centre), force))
    outputs = [load, ca.densify(ca.jacobian(load, timing))]
    inputs = [asked, timing[0], timing[1], *sx_parameters(payload).values()]
    return ca.Function("load", inputs, ca.cse(outputs))


def path_force_function(workcell: Workcell) -> ca.Function:
    """Build the function of both normal forces at one point of a path, and of their derivatives by
    u'' and u'^2, where u is the path parameter.

    Inputs: pose, first, second (6,), the box pose and its first and second derivative by u; a =
    u''; w = u'^2; then the payload's symbolic parameters. Outputs: normal_force (2,) [N]; slope
    (NumPy shape (2, 2)), the derivatives of each force by a and w.
    """
    closed, payload = contact_model(workcell).has_closed_form, workcell.payload
    kind, given = (ca.SX, sx_parameters) if closed else (ca.MX, mx_parameters)
    numbers: dict[str, Any] = dict(given(payload))
    own = [ca.SX(number(workcell.contacts[0].T_box_pad[:3, :3])), ca.DM(GRAVITY) * payload.mass]
    if not closed:
        own = [as_mx(ca.SX(value), sx_parameters(payload), numbers) for value in own]
    path = {name: kind.sym(name, 6) for name in ("pose", "first", "second")}
    a, w = kind.sym("a"), kind.sym("w")
    moved = box_function(workcell)(*path.values(), *numbers.values())
    box = dict(zip(BOX_OUTPUTS, moved, strict=True))
    rotation = ca.reshape(box["rotation"], 3, 3).T
    axes, weight = ca.mtimes(rotation, own[0]), own[1]
    asked = (
        *(box["force_by_acceleration"], box["force_by_speed"], -weight),
        *(box["moment_by_acceleration"], box["moment_by_speed"]),
    )
    blocks = ca.vertcat(*[ca.mtimes(axes.T, part) for part in asked])
    forces, slopes = force_functions(workcell)
    _, solved = forces(blocks, a, w, *numbers.values())
    force, by_a, by_w = slopes(blocks, a, w, *numbers.values(), solved)
    outputs = {"normal_force": force, "slope": ca.vertcat(by_a.T, by_w.T)}
    return named_function("path_force", {**path, "a": a, "w": w, **numbers}, outputs, cse=closed)


def ratio_functions(workcell: Workcell) -> tuple[ca.Function, ca.Function]:
    """Build the functions of joint torques and pressure shifts over their limits at one sample, and
    of their derivatives by u'' and u'^2, where u is the path parameter. These limits are not convex
    in u'' and u'^2.

    Inputs of both: one vector, the blocks force, moment, torque and wrench of `limit_layout`; a =
    u''; w = u'^2; the payload's symbolic parameters; and the solved variables of `force_functions`.

    - limit_ratios returns the ratios (joints + 2,): signed joint torques of both arms, then the
      shifts of both centres of pressure over the patch radii.
    - limit_slopes returns the ratios, then their derivatives (joints + 2,) by a and by w.

    If a convex program finds the forces, pressure is not limited and its two ratios are zero.
    """
    sizes = limit_layout(workcell).sizes
    names = ("force", "moment", "torque", "wrench")
    if not contact_model(workcell).has_closed_form:
        return _program_ratios(workcell)
    blocks = {name: ca.SX.sym(name, sizes[name]) for name in names}
    inputs, alone, sloping = _inputs(workcell, blocks), ImplicitVariables(0), ImplicitVariables(1)
    timing = inputs["a"], inputs["w"]
    value, varied = (
        contact_limits(workcell, blocks, timing, implicit)[0] for implicit in (alone, sloping)
    )
    whole = inputs | {"solved": alone.symbols}
    return (
        named_function("limit_ratios", whole, {"value": ca.densify(value)}),
        _slopes("limit_slopes", varied, inputs, sloping),
    )


def contact_limits(
    workcell: Workcell,
    blocks: dict[str, ca.SX],
    timing: tuple[ca.SX, ca.SX],
    implicit: ImplicitVariables,
) -> tuple[ca.SX, ca.SX]:
    """Compute the limited quantities at one sample that depend on the contact forces.

    Args:
        workcell: the cell.
        blocks: the blocks force, moment, torque and wrench of `limit_layout`, by name.
        timing: u'' and u'^2.
        implicit: stores the results of Newton's method, so that derivatives of the forces become
            exact.

    Returns:
        Ratios (joints + 2,) to the limits, first the signed joint torques of both arms, then the
        shifts of both centres of pressure over the patch radii; and the two quantities (2,) of
        `ContactModel.force_quantities` [N].
    """
    (a, w), joints = timing, limit_layout(workcell).joints
    model, load = contact_model(workcell), _contact_load(workcell, blocks, a, w)
    held = model.hold(load, implicit)
    own = ca.reshape(blocks["torque"], joints, 3)
    wrench_by_joint = ca.reshape(blocks["wrench"], 6, joints).T
    torque, start = own[:, 0] * a + own[:, 1] * w + own[:, 2], 0
    ratios = []
    for robot, wrench in zip(workcell.robots, held.wrenches, strict=True):
        stop = start + robot.velocity_max.shape[0]
        ratios.append(torque[start:stop] + ca.mtimes(wrench_by_joint[start:stop, :], wrench))
        start = stop
    ratios += [
        ca.sqrt(ca.sumsqr(moved) + 1e-24) / contact.patch_radius
        for moved, contact in zip(held.shifts, workcell.contacts, strict=True)
    ]
    return ca.vertcat(*ratios), model.force_quantities(load, held)


def _program_ratios(workcell: Workcell) -> tuple[ca.Function, ca.Function]:
    """Build the functions `limit_ratios` and `limit_slopes` that `ratio_functions` describes, for
    cells whose forces a convex program computes."""
    layout = limit_layout(workcell)
    sizes, joints = layout.sizes, layout.joints
    names = ("force", "moment", "torque", "wrench")
    ends = np.cumsum([0, sizes["force"] + sizes["moment"], sizes["torque"], sizes["wrench"]])
    inputs = [ca.MX.sym("blocks", sum(sizes[name] for name in names)), *map(ca.MX.sym, "aw")]
    asked, torque, wrench = ca.vertsplit(inputs[0], ends.tolist())
    own, by_wrench = ca.reshape(torque, joints, 3), ca.reshape(wrench, 6, joints).T
    # Each arm's joints feel its own wrench.
    first, grasp = workcell.robots[0].velocity_max.shape[0], Grasp(workcell)
    groups = mx_parameters(workcell.payload)
    given = list(groups.values())
    felt = as_mx(ca.SX(number(grasp.numbers.to_robots)), grasp.given, groups)
    # The pads of the first robot come first.
    others = WRENCH_SIZE * grasp.robots.index(1)
    _, by_timing = _load_function(workcell)(asked, *inputs[1:], *given)
    soft, none = SoftGrasp(grasp, TIMING_BARRIER_WEIGHT), ca.DM.zeros(2, 1)

    def on_joints(held: ca.MX) -> ca.MX:
        one = ca.mtimes(felt[:, :others], held[:others, :])
        other = ca.mtimes(felt[:, others:], held[others:, :])
        arms = (by_wrench[:first, :], by_wrench[first:, :])
        return ca.vertcat(ca.mtimes(arms[0], one), ca.mtimes(arms[1], other))

    ratios, state = ca.mtimes(own, ca.vertcat(*inputs[1:], 1.0)), ca.MX.sym("solved", soft.size)
    held, by_load = soft.wrenches(slopes=True)(state, *given)
    slopes = own[:, :2] + on_joints(ca.mtimes(by_load, by_timing))
    alone = soft.wrenches(slopes=False)(state, *given)
    inputs += [*given, state]
    whole = [ratios + on_joints(held), *ca.horzsplit(slopes)]
    return (
        ca.Function("limit_ratios", inputs, [ca.vertcat(ratios + on_joints(alone), none)]),
        ca.Function("limit_slopes", inputs, [ca.vertcat(value, none) for value in whole]),
    )


def _inputs(workcell: Workcell, blocks: dict[str, ca.SX]) -> dict[str, ca.SX]:
    """Return symbols of the inputs of `limit_forces` or, with more blocks, of `limit_ratios`.

    By name, in the order of the inputs: `sample`, one column of all entries of `blocks`; `a`, u''
    [1/s^2]; `w`, u'^2 [1/s^2]; then the payload's symbolic parameters. The path parameter is u.

    Args:
        workcell: the cell.
        blocks: symbols of blocks of `limit_layout` by name: force (9,) and moment (6,) for
            `limit_forces`; also torque and wrench for `limit_ratios`.
    """
    timing = {name: ca.SX.sym(name) for name in ("a", "w")}
    return {"sample": ca.vertcat(*blocks.values())} | timing | sx_parameters(workcell.payload)


def _slopes(
    name: str, value: ca.SX, inputs: dict[str, ca.SX], implicit: ImplicitVariables
) -> ca.Function:
    """Build the function of an expression and its derivatives by a = u'' and w = u'^2.

    Args:
        name: name of the function.
        value: the expression.
        inputs: symbols of the function's inputs by name; `a` and `w` are among them.
        implicit: holds the symbols in `value` that stand for results of Newton's method. These
            results are the function's last input, called `solved`.
    """
    value = ca.densify(value)
    by = {f"by_{z}": ca.densify(ca.jacobian(value, inputs[z])) for z in ("a", "w")}
    return named_function(name, inputs | {"solved": implicit.symbols}, {"value": value} | by)
