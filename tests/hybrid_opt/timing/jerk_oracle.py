"""Jerk-limited timings by other means: a closed form on a line, a direct transcription in time.

The transcription is independent of the timing package in everything but the geometry at samples:
time is the independent variable, the third derivative of the path parameter is constant on
intervals, the path between samples is CasADi's own splines, all limits stand at the ends of the
intervals, and IPOPT begins with a slow smooth motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import JerkLimits, TimingLimits
from symbolic.array import Array

INTERVALS = 80
STARTS = (1.0, 1.4, 2.0)
"""Durations of the motions to begin with over the given one, until the solver arrives from one."""

EVERY = 20
"""Of the model's samples that the splines go through."""


def s_curve(length: float, speed: float, acceleration: float, jerk: float) -> float:
    """Least duration [s] of a straight way from rest to rest, without acceleration at its ends.

    Jerk, acceleration and speed at their limits one after the other as far as they are reached
    (Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, 3.4).
    """
    reached = acceleration**2 / jerk  # the speed at which the acceleration's limit is met
    if speed >= reached:
        rise = speed / acceleration + acceleration / jerk
    else:
        rise = 2.0 * np.sqrt(speed / jerk)
    if speed * rise <= length:
        return float(length / speed + rise)
    # The speed's limit is not met: v (v / A + A / J) = length.
    half = acceleration / jerk
    peak = acceleration * (np.sqrt(half**2 + 4.0 * length / acceleration) - half) / 2.0
    if peak >= reached:
        return float(2.0 * (peak / acceleration + half))
    return float(4.0 * np.cbrt(length / (2.0 * jerk)))


@dataclass(frozen=True)
class _Path:
    """Geometry by u, as functions: joints and box by u, forces' coefficients, normal."""

    joints: ca.Function
    box: ca.Function
    turning: ca.Function
    force: ca.Function


def _path(model: TimingModel, x: Array) -> _Path:
    motion = model.path_motion(x)
    u = ca.MX.sym("u")
    grid = motion.parameter[::EVERY].tolist()

    def spline(name: str, values: Array) -> ca.MX:
        table = np.ascontiguousarray(values[::EVERY]).ravel()
        return ca.interpolant(name, "bspline", [grid], table, {"degree": [5]})(u)

    def derivatives(name: str, values: Array) -> ca.Function:
        first = spline(name, values)
        second = ca.jacobian(first, u)
        return ca.Function(name, [u], [first, second, ca.jacobian(second, u)])

    forces = (motion.force_by_acceleration, motion.force_by_speed, motion.normal)
    turns = (motion.angular_first, motion.angular_second)
    turning = [spline(f"turning_{k}", v) for k, v in enumerate(turns)]
    return _Path(
        derivatives("joints", motion.q_first),
        derivatives("box", motion.pose_first[:, :3]),
        ca.Function("turning", [u], turning),
        ca.Function("force", [u], [spline(f"force_{k}", v) for k, v in enumerate(forces)]),
    )


def shortest_duration(
    model: TimingModel, x: Array, limits: TimingLimits, jerk: JerkLimits, slow: float
) -> float:
    """Shortest duration [s] found; torques and pressure are left out.

    Args:
        slow: duration [s] of the motion to begin with.
    """
    cell, path, n = model.workcell, _path(model, x), INTERVALS
    total = ca.MX.sym("total")
    jerks, states = ca.MX.sym("jerks", n), ca.MX.sym("states", 3, n + 1)
    step = total / n
    rows: list[ca.MX] = []
    gaps: list[ca.MX] = []
    limit = {
        name: ca.DM(np.concatenate([getattr(robot, name) for robot in cell.robots]))
        for name in ("velocity_max", "acceleration_max")
    }
    for k in range(n):
        u, v, a = (states[i, k] for i in range(3))
        j = jerks[k]
        gaps += [
            states[0, k + 1] - (u + v * step + a * step**2 / 2.0 + j * step**3 / 6.0),
            states[1, k + 1] - (v + a * step + j * step**2 / 2.0),
            states[2, k + 1] - (a + j * step),
        ]
        for end in (k, k + 1):
            u, v, a = (states[i, end] for i in range(3))
            q, qq, qqq = path.joints(u)
            p, pp, ppp = path.box(u)
            rows.append((qqq * v**3 + 3.0 * qq * v * a + q * j) / ca.DM(jerk.joints))
            rows.append(ca.sumsqr(ppp * v**3 + 3.0 * pp * v * a + p * j) / jerk.payload**2)
    for k in range(n + 1):
        u, v, a = (states[i, k] for i in range(3))
        q, qq, _ = path.joints(u)
        p, pp, _ = path.box(u)
        turn, turned = path.turning(u)
        rows += [
            q * v / limit["velocity_max"],
            (qq * v**2 + q * a) / limit["acceleration_max"],
            ca.sumsqr(p * v) / cell.payload.velocity_max**2,
            ca.sumsqr(pp * v**2 + p * a) / cell.payload.acceleration_max**2,
            ca.sumsqr(turn * v) / cell.payload.angular_velocity_max**2,
            ca.sumsqr(turned * v**2 + turn * a) / cell.payload.angular_acceleration_max**2,
        ]
        if limits.force is not None:
            rows.append(_normal_forces(model, path, u, v**2, a) / limits.force)
    g = ca.vertcat(*gaps, states[:, 0], states[:, n] - ca.DM([1.0, 0.0, 0.0]), *rows)
    equal = len(gaps) + 6
    low = np.full(g.shape[0], -1.0)
    high = np.ones(g.shape[0])
    low[:equal] = high[:equal] = 0.0
    z = ca.vertcat(total, jerks, ca.vec(states))
    options = {
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.max_iter": 800,
        "ipopt.tol": 1e-6,
        "ipopt.hessian_approximation": "exact",
    }
    solver = ca.nlpsol("jerk", "ipopt", {"x": z, "f": total, "g": g}, options)
    low_x = np.full(z.shape[0], -np.inf)
    high_x = np.full(z.shape[0], np.inf)
    low_x[0] = 1e-2
    low_x[1 + n :: 3], high_x[1 + n :: 3] = 0.0, 1.0
    low_x[2 + n :: 3] = 0.0
    for factor in STARTS:
        start = _smooth_start(factor * slow)
        found = solver(x0=start, lbx=low_x, ubx=high_x, lbg=low, ubg=high)
        if solver.stats()["success"]:
            return float(found["f"])
    raise AssertionError(solver.stats()["return_status"])


def _smooth_start(duration: float) -> Array:
    """The variables of a motion by the polynomial of degree five."""
    t = np.linspace(0.0, 1.0, INTERVALS + 1)
    smooth = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
    states = [smooth.deriv(k)(t) / duration**k if k else smooth(t) for k in range(3)]
    third = smooth.deriv(3)((t[1:] + t[:-1]) / 2.0) / duration**3
    return np.concatenate([[duration], third, np.array(states).T.ravel()])


def _normal_forces(model: TimingModel, path: _Path, u: ca.MX, w: ca.MX, a: ca.MX) -> ca.MX:
    """All that the larger normal force is the largest of, for equal friction [N].

    The least squeeze S = N_1 + N_2 is max(F_t / mu, |F_n|, (mu F_t + mu^2 |F_n|) / (1 + mu^2)),
    and the larger force (S + |F_n|) / 2.
    """
    cell = model.workcell
    mu = cell.contacts[0].friction
    assert mu == cell.contacts[1].friction
    by_a, by_w, normal = path.force(u)
    force = by_a * a + by_w * w - cell.payload.mass * ca.DM([0.0, 0.0, -9.81])
    along = ca.dot(force, normal)
    across = ca.sqrt(ca.sumsqr(force - along * normal) + 1e-8)
    squeezes = [
        across / mu,
        *[(mu * across + mu**2 * sign * along) / (1.0 + mu**2) for sign in (1.0, -1.0)],
        along,
        -along,
    ]
    return ca.vertcat(*[(s + sign * along) / 2.0 for s in squeezes for sign in (1.0, -1.0)])
