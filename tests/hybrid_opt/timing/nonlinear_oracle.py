"""Torque-limited timing as one nonlinear program, solved by IPOPT with exact contact forces.

Independent of the timing package's sequence of linear problems: all intervals at once, joint
torques straight from the symbolic load and the arms' coefficients, nothing linearised by hand.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from hybrid_opt.timing.model import REFINEMENT, TimingModel
from hybrid_opt.timing.programs import squared_speed_limit
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.contact.load import LOAD_OUTPUTS, load_function


def shortest_duration(model: TimingModel, x: Array, start: Array) -> float:
    """Shortest duration [s] with joint speed, acceleration and torque and payload limits.

    Args:
        start: (intervals + 1,) path speed u' [1/s] to begin the search from.
    """
    cell, n = model.workcell, model.intervals
    motion = model.path_motion(x).at(np.arange(0, REFINEMENT * n + 1, REFINEMENT))
    w = ca.MX.sym("w", n - 1)  # u'^2 at the inner grid points
    squared = ca.vertcat(0.0, w, 0.0)
    acceleration = (squared[1:] - squared[:-1]) * n / 2.0
    constraints = []
    joint_limit = np.concatenate([robot.acceleration_max for robot in cell.robots])
    torque_limit = np.concatenate([robot.torque_max for robot in cell.robots])
    load = load_function(cell)
    for i in range(n):
        for k in (i, i + 1):
            a, s = acceleration[i], squared[k]
            constraints.append((motion.q_first[k] * a + motion.q_second[k] * s) / joint_limit)
            linear = motion.pose_first[k] * a + motion.pose_second[k] * s
            # The load is quadratic in the rate, so its sign and root need no care at rest.
            rate = motion.pose_first[k] * ca.sqrt(s + 1e-12)
            out = dict(zip(LOAD_OUTPUTS, load(motion.pose[k], rate, linear), strict=True))
            n_first = len(cell.robots[0].torque_max)
            split = (motion.wrench_torque[k, :n_first], motion.wrench_torque[k, n_first:])
            contact = [
                ca.mtimes(ca.DM(matrix), out[f"wrench_{arm + 1}"])
                for arm, matrix in enumerate(split)
            ]
            own = motion.torque_by_acceleration[k] * a + motion.torque_by_speed[k] * s
            torque = ca.vertcat(*contact) + own + motion.torque_at_rest[k]
            constraints.append(torque / torque_limit)
            for vector, limit in (
                (linear[:3], cell.payload.acceleration_max),
                (out["angular_acceleration"], cell.payload.angular_acceleration_max),
            ):
                constraints.append(ca.sumsqr(vector) / limit**2)
    speed = ca.sqrt(squared + 1e-12)
    duration = ca.sum1(2.0 / n / (speed[1:] + speed[:-1]))
    rows = ca.vertcat(*constraints)
    solver = ca.nlpsol(
        "timing",
        "ipopt",
        {"x": w, "f": duration, "g": rows},
        {"ipopt.print_level": 0, "print_time": False, "ipopt.max_iter": 500, "ipopt.tol": 1e-6},
    )
    result = solver(
        x0=start[1:-1] ** 2,
        lbx=1e-9,
        ubx=squared_speed_limit(model, motion, TimingLimits())[1:-1],
        lbg=-1.0,
        ubg=1.0,
    )
    assert solver.stats()["success"], solver.stats()["return_status"]
    return float(result["f"])
