"""Time laws: the time of each sample, and the velocity and acceleration of the box there.

`constant` is the law of the paper (Eqs. 22-26). The duration of a step is its length over the
reference speed. Velocity and acceleration are second-order finite differences, one-sided at the
ends. The box starts and stops at full speed, which no robot can do. The paper gives a pure rotation
no time; here a step takes at least its rotation angle over the reference angular speed.

`ramped` moves the box along the same path from rest to rest. The speed rises by a smooth cubic step
to the reference speed, stays constant, and falls again. Derivatives are exact.

`optimal` is no expression: a solver (`hybrid_opt.timing`) finds the times and path speeds, and
`driven_path` computes the motion from them.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symbolic.expression import sx_parameters, tile
from symbolic.path.rotation import angular_acceleration, angular_velocity
from symbolic.path.spline import NO_GROUPS, MXGroups, PathBasis
from symbolic.records import Task

LENGTH_FLOOR = 1e-10
"""Added in squares below the root of lengths [m], to keep derivatives of a zero step finite."""

STEP_TIME_FLOOR = 1e-6
"""Least duration of a step [s]: a step without motion still advances the clock."""

RAMP_NEWTON_STEPS = 8
"""Number of Newton steps that invert the ramp. The ramp is convex, and the steps start on the side
from which they converge."""


@dataclass(frozen=True)
class TimedPath:
    """Sampled box motion; one column per sample.

    Attributes:
        time: (1, n) times [s], from 0.
        pose: (6, n) position [m] and orientation [rad] of the box (`symbolic.records.poses`).
        rate: (6, n) first time derivative of the pose [m/s, rad/s].
        second_rate: (6, n) second time derivative of the pose [m/s^2, rad/s^2].
    """

    time: ca.MX
    pose: ca.MX
    rate: ca.MX
    second_rate: ca.MX


def timed_path(
    task: Task,
    basis: PathBasis,
    waypoints: ca.MX,
    rounding: ca.MX | None = None,
    groups: MXGroups = NO_GROUPS,
) -> TimedPath:
    """Compute the box motion at the samples of `basis` by the task's time law, `constant` or
    `ramped`.

    Args:
        task: task that states the time law and the reference speeds.
        basis: spline basis at the n samples.
        waypoints: (6, n_waypoints) box poses from `symbolic.path.spline.waypoint_matrix`.
        rounding: relative width that smooths the maximum of translation and rotation time in the
            `constant` law; None for the exact maximum.
        groups: MX vectors of the task's parameters, by name of the parameter group; empty for plain
            numbers.
    """
    pose = ca.mtimes(waypoints, ca.DM(basis.position.T))
    if task.law.has_differences:
        return _constant(task, pose, rounding, groups)
    first = ca.mtimes(waypoints, ca.DM(basis.first.T))
    second = ca.mtimes(waypoints, ca.DM(basis.second.T))
    return _ramped(task, basis, (pose, first, second), groups)


def driven_path(
    basis: PathBasis, waypoints: ca.MX, time: ca.MX, speed: ca.MX, acceleration: ca.MX
) -> TimedPath:
    """Compute the box motion at the samples of `basis`, with the timing that a solver found.

    Args:
        basis: spline basis at the n samples.
        waypoints: (6, n_waypoints) box poses from `symbolic.path.spline.waypoint_matrix`.
        time: (1, n) times of the samples [s].
        speed: (1, n) path speeds u' at the samples [1/s].
        acceleration: (1, n) second time derivatives u'' of the path parameter at the samples
            [1/s^2].
    """
    pose, first, second = (
        ca.mtimes(waypoints, ca.DM(matrix.T))
        for matrix in (basis.position, basis.first, basis.second)
    )
    return _along(time, (pose, first, second), speed, acceleration)


def _along(
    time: ca.MX, path: tuple[ca.MX, ca.MX, ca.MX], speed: ca.MX, acceleration: ca.MX
) -> TimedPath:
    """Compute the motion along a path with a given timing.

    Args:
        time: (1, n) times of the samples [s].
        path: (6, n) box poses, and their first and second derivatives by u.
        speed, acceleration: (1, n) u' [1/s] and u'' [1/s^2].
    """
    (pose, first, second), rows = path, ca.repmat(1.0, 6, 1)
    pushed = second * ca.mtimes(rows, speed**2) + first * ca.mtimes(rows, acceleration)
    return TimedPath(time, pose, first * ca.mtimes(rows, speed), pushed)


def _constant(task: Task, pose: ca.MX, rounding: ca.MX | None, groups: MXGroups) -> TimedPath:
    count = pose.shape[1] - 1
    step = _step_time_function(task, rounding is not None).map(count)
    rounded = [] if rounding is None else [ca.repmat(rounding, 1, count)]
    durations = step(pose[:, :-1], pose[:, 1:], *rounded, *tile(groups, count))
    time = ca.horzcat(0.0, ca.cumsum(durations, 1))
    rate = _gradient(pose, durations)
    return TimedPath(time, pose, rate, _gradient(rate, durations))


def _step_time_function(task: Task, is_rounded: bool) -> ca.Function:
    """Build the function of the duration of a step between two poses at the reference speeds (paper
    Eqs. 23-24).

    Inputs: start pose (6,) and end pose (6,) [m, rad]; with `is_rounded` the relative width of the
    smoothing; then the task's symbolic parameters. Output: the duration [s], the larger one of
    translation and rotation time.

    Args:
        task: task with the reference speeds.
        is_rounded: True to smooth the maximum of translation and rotation time.
    """
    start, end, given = ca.SX.sym("start", 6), ca.SX.sym("end", 6), sx_parameters(task).values()
    step = end - start
    length = _smooth_norm(step[:3])
    angle = _smooth_norm(angular_velocity(task.orientation, (start[3:] + end[3:]) / 2.0, step[3:]))
    moving, turning = length / task.reference_speed, angle / task.reference_angular_speed
    if not is_rounded:
        duration = ca.fmax(ca.fmax(moving, turning), STEP_TIME_FLOOR)
        return ca.Function("step_time", [start, end, *given], [duration])
    rounding, both = ca.SX.sym("rounding"), moving + turning
    # A hyperbola; the floor keeps its slope finite where there is no rounding.
    width = ca.sqrt((moving - turning) ** 2 + (rounding * both) ** 2 + LENGTH_FLOOR**2)
    duration = ca.fmax((both + width) / 2.0, STEP_TIME_FLOOR)
    return ca.Function("step_time", [start, end, rounding, *given], [duration])


def _gradient(values: ca.MX, durations: ca.MX) -> ca.MX:
    """Compute time derivatives (k, n) of tabulated values by second-order finite differences,
    one-sided at the ends.

    Args:
        values: (k, n) values at n samples.
        durations: (1, n - 1) time steps between the samples [s].
    """
    rows = values.shape[0]
    before, after = durations[:, :-1], durations[:, 1:]
    step = ca.repmat(1.0, rows, 1)
    inner = (
        values[:, 2:] * ca.mtimes(step, before / (after * (before + after)))
        + values[:, 1:-1] * ca.mtimes(step, (after - before) / (before * after))
        - values[:, :-2] * ca.mtimes(step, after / (before * (before + after)))
    )
    first = _one_sided(values[:, 0], values[:, 1], values[:, 2], durations[0], durations[1])
    last = _one_sided(values[:, -1], values[:, -2], values[:, -3], -durations[-1], -durations[-2])
    return ca.horzcat(first, inner, last)


def _one_sided(here: ca.MX, near: ca.MX, far: ca.MX, near_step: ca.MX, far_step: ca.MX) -> ca.MX:
    """Compute the time derivative of the parabola through three values, at the first of them.

    Args:
        here, near, far: the values; the derivative is at `here`.
        near_step, far_step: time from `here` to `near` and from `near` to `far` [s]; both are
            negative if `near` and `far` are earlier than `here`.
    """
    total = near_step + far_step
    return (
        -(2.0 * near_step + far_step) / (near_step * total) * here
        + total / (near_step * far_step) * near
        - near_step / (far_step * total) * far
    )


def _ramped(
    task: Task, basis: PathBasis, along: tuple[ca.MX, ca.MX, ca.MX], groups: MXGroups
) -> TimedPath:
    pose, first, second = along
    n = pose.shape[1]
    given = tile(groups, n)
    slope, curvature = _length_rate_function(task).map(n)(pose, first, second, *given)
    width = float(basis.parameter[1] - basis.parameter[0])
    # Trapezoid with end correction: fourth order in the sample width.
    pieces = width / 2.0 * (slope[:, :-1] + slope[:, 1:]) + width**2 / 12.0 * (
        curvature[:, :-1] - curvature[:, 1:]
    )
    arc = ca.horzcat(0.0, ca.cumsum(pieces, 1))
    time, speed, acceleration = _ramp_function(task).map(n)(arc, ca.repmat(arc[-1], 1, n), *given)
    u_rate = speed / slope
    return _along(time - time[0], along, u_rate, (acceleration - curvature * u_rate**2) / slope)


def _length_rate_function(task: Task) -> ca.Function:
    """Build the function of the arc length per unit of u [m] and of its derivative by u.

    Inputs: pose (6,) of the box [m, rad], its first and second derivative by u (6,), then the
    task's symbolic parameters. The arc length grows by translation or by rotation, whichever is
    more. A rotation counts as its angle times reference speed over reference angular speed.
    """
    pose, first, second = (ca.SX.sym(name, 6) for name in ("pose", "first", "second"))
    lever = task.reference_speed / task.reference_angular_speed
    turn = angular_velocity(task.orientation, pose[3:], first[3:])
    turn_rate = angular_acceleration(task.orientation, pose[3:], first[3:], second[3:])
    linear, angular = _smooth_norm(first[:3]), lever * _smooth_norm(turn)
    linear_rate = ca.dot(first[:3], second[:3]) / linear
    angular_rate = lever**2 * ca.dot(turn, turn_rate) / angular
    slope = ca.fmax(linear, angular)
    curvature = ca.if_else(linear >= angular, linear_rate, angular_rate)
    inputs = [pose, first, second, *sx_parameters(task).values()]
    return ca.Function("length_rate", inputs, [slope, curvature])


def _ramp_function(task: Task) -> ca.Function:
    """Build the function of the motion along an arc from rest to rest by the time law `ramped`:
    smooth ramps at both ends, and constant speed between them.

    Inputs: arc length so far [m], total arc length [m], then the task's symbolic parameters.
    Outputs at this arc length: time [s], speed [m/s] and acceleration [m/s^2].
    """
    arc, total = ca.SX.sym("arc"), ca.SX.sym("total")
    ramp = task.ramp_time
    cruise = ca.fmin(task.reference_speed, total / ramp)
    duration = ramp + total / cruise
    from_end = arc > total / 2.0
    share = ca.fmin(arc, total - arc) / (cruise * ramp)
    # Speed rises as 3 tau^2 - 2 tau^3, so that share = tau^3 - tau^4 / 2 during the ramp.
    # The floor keeps the root's derivative finite; it leaves less than 1e-9 m/s^2 at the ends.
    inside = ca.fmin(ca.fmax(share, 1e-30), 0.5)
    tau = (2.0 * inside) ** (1.0 / 3.0)
    for _ in range(RAMP_NEWTON_STEPS):
        tau = tau - (tau**3 - tau**4 / 2.0 - inside) / (3.0 * tau**2 - 2.0 * tau**3)
    ramping = share < 0.5
    elapsed = ca.if_else(ramping, ramp * tau, ramp + (share - 0.5) * ramp)
    time = ca.if_else(from_end, duration - elapsed, elapsed)
    speed = ca.if_else(ramping, cruise * (3.0 * tau**2 - 2.0 * tau**3), cruise)
    push = ca.if_else(ramping, cruise / ramp * 6.0 * tau * (1.0 - tau), 0.0)
    acceleration = ca.if_else(from_end, -push, push)
    inputs = [arc, total, *sx_parameters(task).values()]
    return ca.Function("ramp", inputs, [time, speed, acceleration])


def _smooth_norm(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector) + LENGTH_FLOOR**2)
