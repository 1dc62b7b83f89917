"""The box motion written plainly: spline, time laws and rotation, one sample at a time; and its
contact forces and centres of pressure."""

from __future__ import annotations

from itertools import combinations, pairwise
from math import factorial

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.path.time_law import STEP_TIME_FLOOR
from symbolic.records import Task, Workcell
from symbolic.records.poses import Orientation

NODES = 14
"""Number of nodes of Gauss's quadrature, which is then exact up to rounding for rotations up to a
full turn."""


def waypoints(task: Task, x: Array) -> Array:
    """Return all waypoints (n_waypoints, 6) [m, rad] of a decision vector x (n_var,), with
    unwrapped angles.
    """
    free = iter(np.reshape(x[: task.n_box], (-1, 6)))
    rows = np.array([w.lower if w.is_fixed else next(free) for w in task.waypoints])
    rows[:, 3:] = task.orientation.unwrapped(rows[:, 3:])
    return rows


def redundant_path(task: Task, x: Array) -> Array:
    """Return the positions (samples, m) of the redundant joints for a decision vector x (n_var,)
    [rad or m].
    """
    free = iter(x[task.n_box :])
    columns = [
        [low if low == high else next(free) for low, high in zip(j.lower, j.upper, strict=True)]
        for j in task.redundant
    ]
    coefficients = natural_quintic(np.array(columns).reshape(-1, len(task.waypoints)).T)
    u = np.linspace(0.0, 1.0, task.samples)
    return np.array([evaluate_spline(coefficients, value) for value in u])


def natural_quintic(points: Array) -> Array:
    """Compute the coefficients (segments, 6, n) of the natural quintic spline through points.

    The coefficients belong to the powers 0 to 5 of the local parameter s in [0, 1] of each segment.
    The conditions are: values at both ends of every segment; derivatives 1 to 4 continuous at inner
    points; derivatives 3 and 4 zero at both ends. Two points are joined by a straight line.

    Args:
        points: (segments + 1, n) points.
    """
    segments = len(points) - 1
    if segments == 1:
        line = np.zeros((1, 6, points.shape[1]))
        line[0, 0], line[0, 1] = points[0], points[1] - points[0]
        return line
    rows, values = [], []

    def require(value: Array, *terms: tuple[int, Array]) -> None:
        row = np.zeros(6 * segments)
        for segment, powers in terms:
            row[6 * segment : 6 * segment + 6] += powers
        rows.append(row)
        values.append(value)

    nothing = np.zeros(points.shape[1])
    for k in range(segments):
        require(points[k], (k, _powers(0.0, 0)))
        require(points[k + 1], (k, _powers(1.0, 0)))
    for k in range(segments - 1):
        for order in (1, 2, 3, 4):
            require(nothing, (k, _powers(1.0, order)), (k + 1, -_powers(0.0, order)))
    for order in (3, 4):
        require(nothing, (0, _powers(0.0, order)))
        require(nothing, (segments - 1, _powers(1.0, order)))
    solution: Array = np.linalg.solve(np.array(rows), np.array(values))
    return solution.reshape(segments, 6, -1)


def evaluate_spline(coefficients: Array, u: float, order: int = 0) -> Array:
    """Return a spline's value, or its derivative of a given order, at the parameter u.

    Args:
        coefficients: (segments, 6, n) coefficients of the quintic segments of equal length.
        u: parameter in [0, 1] over the whole spline.
        order: order of the derivative with respect to u.

    Returns:
        (n,) value or derivative.
    """
    segments = len(coefficients)
    k = min(int(u * segments), segments - 1)
    value: Array = _powers(u * segments - k, order) @ coefficients[k] * segments**order
    return value


def _powers(s: float, order: int) -> Array:
    """Return the derivative of a given order of the powers (1, s, ..., s^5), as (6,)."""
    return np.array(
        [
            factorial(p) / factorial(p - order) * s ** (p - order) if p >= order else 0.0
            for p in range(6)
        ]
    )


def rotation(rpy: Array) -> Array:
    """Compute R_world_box (3, 3) from roll, pitch, yaw `rpy` (3,) [rad]."""
    matrix: Array = Rotation.from_euler("xyz", rpy).as_matrix()
    return matrix


def box_rotation(orientation: Orientation, numbers: Array) -> Array:
    """Compute R_world_box (3, 3) of a pose.

    Args:
        orientation: the cell's convention for orientations.
        numbers: (3,) last three entries of the pose [rad].
    """
    if not orientation.is_vector:
        return rotation(numbers)
    turn: Array = Rotation.from_rotvec(numbers).as_matrix()
    return turn @ orientation.reference


def euler_axes(rpy: Array) -> tuple[Array, Array, Array]:
    """Return the axes (3,), in the world, of the rotations by roll, pitch and yaw, in this
    order."""
    yaw = Rotation.from_euler("z", rpy[2])
    pitch = Rotation.from_euler("ZY", [rpy[2], rpy[1]])
    return pitch.apply([1.0, 0.0, 0.0]), yaw.apply([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def angular_rates(rpy: Array, rate: Array, second: Array) -> tuple[Array, Array]:
    """Compute angular velocity and acceleration, (3,) each, in the world frame from roll, pitch,
    yaw.

    Each axis is rotated by the rotations outside it: d axis / dt = omega_outer x axis.

    Args:
        rpy: (3,) roll, pitch, yaw [rad].
        rate, second: (3,) their first and second time derivative.
    """
    roll_axis, pitch_axis, yaw_axis = euler_axes(rpy)
    yaw_rate, pitch_rate, roll_rate = rate[2] * yaw_axis, rate[1] * pitch_axis, rate[0] * roll_axis
    acceleration = (
        second[2] * yaw_axis
        + second[1] * pitch_axis
        + np.cross(yaw_rate, pitch_rate)
        + second[0] * roll_axis
        + np.cross(yaw_rate + pitch_rate, roll_rate)
    )
    return yaw_rate + pitch_rate + roll_rate, acceleration


def vector_rates(vector: Array, rate: Array, second: Array) -> tuple[Array, Array]:
    """Compute angular velocity and acceleration, (3,) each, in the world frame from a rotation
    vector.

    The angular velocity of the rotation exp(s v) is the integral of exp(r v) v' over r in [0, s],
    with v' the time derivative of v (Chirikjian, Stochastic Models, Information Theory, and Lie
    Groups 2, 2012, 10.7). The box has s = 1.

    Args:
        vector: (3,) rotation vector v [rad].
        rate, second: (3,) its first and second time derivative.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    shares, weights = (nodes + 1.0) / 2.0, weights / 2.0
    turned = Rotation.from_rotvec(np.outer(shares, vector))
    moved = turned.apply(rate)
    inner = Rotation.from_rotvec(np.outer(np.outer(shares, shares).ravel(), vector)).apply(rate)
    own = shares[:, None] * np.einsum("j,ijk->ik", weights, inner.reshape(NODES, NODES, 3))
    return weights @ moved, weights @ (turned.apply(second) + np.cross(own, moved))


def box_rates(
    orientation: Orientation, numbers: Array, rate: Array, second: Array
) -> tuple[Array, Array]:
    """Compute angular velocity and acceleration of the box, (3,) each, in the world frame.

    Args:
        orientation: the cell's convention for orientations.
        numbers: (3,) last three entries of the pose [rad].
        rate, second: (3,) their first and second time derivative.
    """
    return (vector_rates if orientation.is_vector else angular_rates)(numbers, rate, second)


def timed_motion(task: Task, x: Array) -> tuple[Array, Array, Array, Array]:
    """Return the motion of a candidate over time.

    Args:
        task: task of the cell.
        x: (n_var,) decision vector.

    Returns:
        Time (n,) [s]; pose, its first and its second time derivative, (n, 6) each.
    """
    coefficients = natural_quintic(waypoints(task, x))
    u = np.linspace(0.0, 1.0, task.samples)
    pose = np.array([evaluate_spline(coefficients, value) for value in u])
    if task.law.has_differences:
        time = _constant_time(task, pose)
        rate = np.gradient(pose, time, axis=0, edge_order=2)
        return time, pose, rate, np.gradient(rate, time, axis=0, edge_order=2)
    first = np.array([evaluate_spline(coefficients, value, 1) for value in u])
    second = np.array([evaluate_spline(coefficients, value, 2) for value in u])
    return _ramped(task, u, pose, first, second)


def _constant_time(task: Task, pose: Array) -> Array:
    time = [0.0]
    for here, there in pairwise(pose):
        step, middle = there - here, (here + there) / 2.0
        turn, _ = box_rates(task.orientation, middle[3:], step[3:], np.zeros(3))
        needed = max(
            float(np.linalg.norm(step[:3])) / task.reference_speed,
            float(np.linalg.norm(turn)) / task.reference_angular_speed,
            STEP_TIME_FLOOR,
        )
        time.append(time[-1] + needed)
    return np.array(time)


def _ramped(
    task: Task, u: Array, pose: Array, first: Array, second: Array
) -> tuple[Array, Array, Array, Array]:
    lever = task.reference_speed / task.reference_angular_speed
    slope, curvature = [], []
    for here, d, dd in zip(pose, first, second, strict=True):
        omega, alpha = box_rates(task.orientation, here[3:], d[3:], dd[3:])
        linear, angular = float(np.linalg.norm(d[:3])), lever * float(np.linalg.norm(omega))
        if linear >= angular:
            slope.append(linear)
            curvature.append(float(d[:3] @ dd[:3]) / linear)
        else:
            slope.append(angular)
            curvature.append(lever**2 * float(omega @ alpha) / angular)
    arc = CubicHermiteSpline(u, slope, curvature).antiderivative()(u)
    time, rate, second_rate = [], [], []
    for k, length in enumerate(arc):
        t, speed, acceleration = drive(task, float(length), float(arc[-1]))
        u_rate = speed / slope[k]
        u_second = (acceleration - curvature[k] * u_rate**2) / slope[k]
        time.append(t)
        rate.append(first[k] * u_rate)
        second_rate.append(second[k] * u_rate**2 + first[k] * u_second)
    return np.array(time), pose, np.array(rate), np.array(second_rate)


def drive(task: Task, length: float, total: float) -> tuple[float, float, float]:
    """Compute time [s], speed [m/s] and acceleration [m/s^2] at a point of a motion from rest to
    rest.

    Args:
        task: task with the reference speed and the time of the ramps.
        length: length covered at this point [m].
        total: length of the whole path [m].
    """
    ramp, cruise = task.ramp_time, min(task.reference_speed, total / task.ramp_time)
    duration = ramp + total / cruise
    if length > total / 2.0:
        t, speed, acceleration = drive(task, total - length, total)
        return duration - t, speed, -acceleration
    if length >= cruise * ramp / 2.0:
        return ramp / 2.0 + length / cruise, cruise, 0.0
    share = length / (cruise * ramp)
    tau = brentq(lambda tau: tau**3 - tau**4 / 2.0 - share, 0.0, 1.0, xtol=1e-15, rtol=1e-14)
    speed = cruise * (3.0 * tau**2 - 2.0 * tau**3)
    return ramp * tau, speed, cruise / ramp * (6.0 * tau - 6.0 * tau**2)


PLAIN_GRAVITY = np.array([0.0, 0.0, -9.81])


def sample_load(workcell: Workcell, pose: Array, rate: Array, second: Array) -> dict[str, Array]:
    """Compute the loads on the contacts at one sample, by the names in `LOAD_OUTPUTS`.

    Args:
        workcell: the cell.
        pose: (6,) pose of the box [m, rad].
        rate, second: (6,) first and second time derivative of the pose.
    """
    payload, contacts = workcell.payload, workcell.contacts
    orientation = workcell.task.orientation
    R = box_rotation(orientation, pose[3:])
    omega, alpha = box_rates(orientation, pose[3:], rate[3:], second[3:])
    to_com = R @ payload.centre_of_mass
    acceleration = second[:3] + np.cross(alpha, to_com) + np.cross(omega, np.cross(omega, to_com))
    force = payload.mass * (acceleration - PLAIN_GRAVITY)

    normal = R @ contacts[0].T_box_pad[:3, 2]
    f_n = float(force @ normal)
    tangent = force - f_n * normal
    f_t = float(np.linalg.norm(tangent))
    direction = tangent / f_t if f_t > 0.0 else np.zeros(3)
    n, t = allocate(f_n, f_t, (contacts[0].friction, contacts[1].friction))
    forces = (n[0] * normal + t[0] * direction, -n[1] * normal + t[1] * direction)

    inertia = R @ payload.inertia @ R.T
    moment = inertia @ alpha + np.cross(omega, inertia @ omega)
    points = [R @ (contact.T_box_pad[:3, 3] - payload.centre_of_mass) for contact in contacts]
    missing = moment - sum(np.cross(r, f) for r, f in zip(points, forces, strict=True))
    planes = [R @ contact.T_box_pad[:3, :2] for contact in contacts]
    A = np.column_stack([np.cross(planes[i][:, k], forces[i]) for i in (0, 1) for k in (0, 1)])
    d = np.linalg.pinv(A, rcond=1e-6) @ missing
    shifts = (planes[0] @ d[:2], planes[1] @ d[2:])
    return {
        "angular_velocity": omega,
        "angular_acceleration": alpha,
        "normal_force": n,
        "tangential_force": t,
        "contact_force": np.concatenate(forces),
        "pressure_shift": np.array([np.linalg.norm(shift) for shift in shifts]),
        "shift_vector": np.concatenate(shifts),
        "required_moment": moment,
        "point_moment_residual": missing,
        "moment_residual": missing - A @ d,
        "wrench_1": np.concatenate([forces[0], np.cross(shifts[0], forces[0])]),
        "wrench_2": np.concatenate([forces[1], np.cross(shifts[1], forces[1])]),
    }


def allocate(f_n: float, f_t: float, friction: tuple[float, float]) -> tuple[Array, Array]:
    """Compute the normal and tangential forces of both pads with the least effort.

    Args:
        f_n: component of the required force along contact 1's normal [N].
        f_t: magnitude of its tangential part [N].
        friction: friction coefficient of each contact.

    Returns:
        Normal forces (2,) and tangential forces (2,) of the pads [N].
    """
    if friction[0] == friction[1]:
        return _equal_friction(f_n, f_t, friction[0])
    return _small_program(f_n, f_t, friction)


def _equal_friction(f_n: float, f_t: float, mu: float) -> tuple[Array, Array]:
    total = max(f_t / mu, abs(f_n), (mu * f_t + mu**2 * abs(f_n)) / (1.0 + mu**2))
    light = min(mu * (total - abs(f_n)) / 2.0, f_t / 2.0)
    normal = np.array([total + f_n, total - f_n]) / 2.0
    tangential = np.array([light, f_t - light] if f_n < 0.0 else [f_t - light, light])
    return normal, tangential


def _small_program(f_n: float, f_t: float, friction: tuple[float, float]) -> tuple[Array, Array]:
    """Solve the quadratic program of `allocate` for unequal friction.

    The unknowns are N_1, N_2, t_1, t_2. All sets of active constraints are tried.

    Args:
        f_n: component of the required force along contact 1's normal [N].
        f_t: magnitude of its tangential part [N].
        friction: friction coefficient of each contact.

    Returns:
        Normal forces (2,) and tangential forces (2,) of the pads [N].
    """
    equal = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    # Rows that must not be positive: both friction cones, both normal forces.
    bounds = np.array(
        [
            [-friction[0], 0.0, 1.0, 0.0],
            [0.0, -friction[1], 0.0, 1.0],
            [-1.0, 0.0, 0.0, 0.0],
            [0.0, -1.0, 0.0, 0.0],
        ]
    )
    best, least = np.zeros(4), np.inf
    for active in (set_ for size in (0, 1, 2) for set_ in combinations(range(4), size)):
        rows = np.vstack([equal, bounds[list(active)]])
        right = np.concatenate([[f_n, f_t], np.zeros(len(active))])
        # The shortest vector that satisfies the active rows.
        candidate = np.linalg.lstsq(rows, right, rcond=None)[0]
        slack = 1e-12 * (abs(f_n) + f_t)
        solves = bool(np.all(np.abs(rows @ candidate - right) <= slack))
        if solves and np.all(bounds @ candidate <= slack) and candidate @ candidate < least:
            best, least = candidate, float(candidate @ candidate)
    return best[:2], best[2:]
