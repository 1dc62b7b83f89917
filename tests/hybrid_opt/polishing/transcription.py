"""Path and speed profile of a drivable carry as one sparse nonlinear program, solved by IPOPT.

Independent of the polish and of the timing package: a direct transcription on a coarse grid whose
variables are the waypoints, the squared speeds, and at every grid point the joints with their first
and second derivatives along the path, held to the box by equations instead of by inverse
kinematics. The box's motion is written plainly, derivatives are CasADi's, and nothing is linearised
by hand. Shared are the arms' symbolic kinematics. Torques, pressure and obstacles are left out:
where they matter, the cell is another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from studies.research.plain.motion import evaluate_spline, natural_quintic
from symbolic.array import Array
from symbolic.cell_model import CellModel
from symbolic.records import Workcell
from symbolic.records.poses import inverse

INTERVALS = 30


@dataclass(frozen=True)
class Guess:
    """What the solver begins with: decision vector, speeds u', joints and derivatives by u at the
    grid points (intervals + 1, ...)."""

    x: Array
    speed: Array
    q: Array
    q_first: Array
    q_second: Array


@dataclass(frozen=True)
class TranscribedOptimum:
    """An optimum: the path's variables (n_path,), duration [s]."""

    path: Array
    duration: float


class Transcription:
    """The program of one cell of six-joint arms with equal friction, its payload's centre of mass
    in the middle."""

    def __init__(self, model: CellModel, intervals: int = INTERVALS) -> None:
        self._model, self._cell, self.intervals = model, model.workcell, intervals
        task, n = self._cell.task, len(self._cell.task.waypoints)
        each = natural_quintic(np.eye(n))
        grid = np.linspace(0.0, 1.0, intervals + 1)
        self._bases = [
            np.array([evaluate_spline(each, u, order) for u in grid]) for order in range(3)
        ]
        assert task.n_path == 6 * len(task.free_indices), "arms of six joints"
        assert not self._cell.payload.centre_of_mass.any()

    def solve(self, guess: Guess, force: float) -> TranscribedOptimum:
        """Least duration within a force limit [N]."""
        cell, n = self._cell, self.intervals
        task = cell.task
        x, w = ca.MX.sym("x", task.n_path), ca.MX.sym("w", n - 1)
        arms = ca.MX.sym("arms", 36, n + 1)
        front_attempts = ca.MX(np.array([waypoint.lower for waypoint in task.waypoints]))
        for k, row in enumerate(task.free_indices):
            front_attempts[row, :] = x[6 * k : 6 * k + 6].T
        along = ca.vertcat(*[ca.mtimes(basis, front_attempts).T for basis in self._bases])
        held = self._held.map(n + 1)(along, arms)
        squared = ca.vertcat(0.0, w, 0.0)
        second = (squared[1:] - squared[:-1]) * n / 2.0
        ends = ca.horzcat(along[:, :-1], along[:, 1:])
        arm_ends = ca.horzcat(arms[:, :-1], arms[:, 1:])
        speeds = ca.horzcat(squared[:-1].T, squared[1:].T)
        rows = self._limited.map(2 * n)(
            ends, arm_ends, ca.horzcat(second.T, second.T), speeds, np.full((1, 2 * n), force)
        )
        root = ca.sqrt(w)
        slowness = 1.0 / (ca.vertcat(0.0, root) + ca.vertcat(root, 0.0))
        total = 2.0 / n * ca.sum1(slowness)
        equal, below = ca.vec(held[:36, :]), ca.vertcat(ca.vec(rows), ca.vec(held[36:, :]))
        z = ca.vertcat(x, w, ca.vec(arms))
        g = ca.vertcat(equal, below)
        lower = np.concatenate([np.zeros(equal.numel()), np.full(below.numel(), -np.inf)])
        upper = np.concatenate([np.zeros(equal.numel()), np.ones(below.numel())])
        options = {
            "ipopt.print_level": 0,
            "print_time": False,
            "ipopt.max_iter": 600,
            "ipopt.tol": 1e-4,
            "ipopt.mu_init": 1e-3,
            # The rest is creeping along directions in which nothing matters.
            "ipopt.acceptable_tol": 1e-2,
            "ipopt.acceptable_iter": 10,
            "ipopt.acceptable_constr_viol_tol": 1e-6,
            "ipopt.acceptable_obj_change_tol": 1e-6,
        }
        solver = ca.nlpsol("joint", "ipopt", {"x": z, "f": total, "g": g}, options)
        starts = np.concatenate([guess.q, guess.q_first, guess.q_second], axis=1)
        free = np.full(24, np.inf)
        low, high = (
            np.concatenate([getattr(robot, name) for robot in cell.robots])
            for name in ("position_lower", "position_upper")
        )
        found = solver(
            x0=np.concatenate([guess.x[: task.n_path], guess.speed[1:-1] ** 2, starts.ravel()]),
            lbx=np.concatenate(
                [
                    task.lower[: task.n_path],
                    np.full(n - 1, 1e-6),
                    np.tile(np.concatenate([low, -free]), n + 1),
                ]
            ),
            ubx=np.concatenate(
                [
                    task.upper[: task.n_path],
                    np.full(n - 1, np.inf),
                    np.tile(np.concatenate([high, free]), n + 1),
                ]
            ),
            lbg=lower,
            ubg=upper,
        )
        assert solver.stats()["success"], solver.stats()["return_status"]
        return TranscribedOptimum(np.array(found["x"]).ravel()[: task.n_path], float(found["f"]))

    @cached_property
    def _held(self) -> ca.Function:
        """Pose with derivatives (18,), joints with derivatives (36,) -> what is to be zero (36,):
        both arms on their pads, that once and twice differentiated by u; then (2,) least
        manipulability over that of the posture."""
        along, arms, s = ca.SX.sym("along", 18), ca.SX.sym("arms", 36), ca.SX.sym("s")
        pose = along[:6] + s * along[6:12] + s**2 / 2.0 * along[12:]
        joints = arms[:12] + s * arms[12:24] + s**2 / 2.0 * arms[24:]
        gaps, room = [], []
        rotation = _rotation(pose[3:])
        for arm, robot in enumerate(self._cell.robots):
            own = self._model.robots[arm]
            q = joints[6 * arm : 6 * arm + 6]
            held = self._cell.contacts[arm].T_box_pad @ inverse(robot.T_flange_pad)
            T_base_box = ca.mtimes(
                ca.DM(inverse(robot.T_world_base)),
                ca.blockcat([[rotation, pose[:3]], [ca.DM.zeros(1, 3), 1.0]]),
            )
            target = ca.mtimes(T_base_box, ca.DM(held))
            R, p = own.placement(q)
            gaps += [target[:3, 3] - p, _axis(ca.mtimes(target[:3, :3], R.T))]
            room.append(robot.min_manipulability / ca.fabs(ca.det(own.jacobian(q))))
        gap = ca.vertcat(*gaps)
        first = ca.jacobian(gap, s)
        zero = ca.vertcat(gap, first, ca.jacobian(first, s))
        out = ca.substitute(ca.vertcat(zero, *room), s, 0.0)
        return ca.Function("held", [along, arms], [ca.cse(out)])

    @cached_property
    def _limited(self) -> ca.Function:
        """Pose, joints, both with derivatives, u'', u'^2 and the force limit -> shares of limits,
        at most 1."""
        cell, payload = self._cell, self._cell.payload
        along, arms, s = ca.SX.sym("along", 18), ca.SX.sym("arms", 36), ca.SX.sym("s")
        a, w, limit = ca.SX.sym("a"), ca.SX.sym("w"), ca.SX.sym("limit")
        velocity, acceleration = (
            ca.DM(np.concatenate([getattr(robot, name) for robot in cell.robots]))
            for name in ("velocity_max", "acceleration_max")
        )
        q_first, q_second = arms[12:24], arms[24:]
        joint = (q_first * a + q_second * w) / acceleration
        rotation = _rotation(along[3:6] + s * along[9:12] + s**2 / 2.0 * along[15:])
        slope = ca.reshape(ca.jacobian(rotation, s), 3, 3)
        turning = _skew_part(ca.mtimes(slope, rotation.T))
        turned = ca.substitute(ca.jacobian(turning, s), s, 0.0)
        turning = ca.substitute(turning, s, 0.0)
        linear = along[6:9] * a + along[12:15] * w
        # The least squeeze of equal friction, and the larger of both normal forces.
        mu = cell.contacts[0].friction
        assert mu == cell.contacts[1].friction
        normal = ca.mtimes(_rotation(along[3:6]), ca.DM(cell.contacts[0].T_box_pad[:3, 2]))
        force = payload.mass * (linear + ca.DM([0.0, 0.0, 9.81]))
        push = ca.dot(force, normal)
        across = ca.sqrt(ca.sumsqr(force - push * normal))
        squeezes = [across / mu, push, -push]
        squeezes += [(mu * across + mu**2 * sign * push) / (1.0 + mu**2) for sign in (1.0, -1.0)]
        normals = [(each + sign * push) / 2.0 for each in squeezes for sign in (1.0, -1.0)]
        rows = [
            q_first**2 * w / velocity**2,
            joint,
            -joint,
            ca.sumsqr(along[6:9]) * w / payload.velocity_max**2,
            ca.sumsqr(turning) * w / payload.angular_velocity_max**2,
            ca.sumsqr(linear) / payload.acceleration_max**2,
            ca.sumsqr(turning * a + turned * w) / payload.angular_acceleration_max**2,
            *[each / limit for each in normals],
        ]
        return ca.Function("limited", [along, arms, a, w, limit], [ca.cse(ca.vertcat(*rows))])


def _rotation(rpy: ca.SX) -> ca.SX:
    """Of roll, pitch and yaw about the world's x, y and z, in this order."""
    (cr, cp, cy), (sr, sp, sy) = ([f(rpy[k]) for k in range(3)] for f in (ca.cos, ca.sin))
    x = ca.blockcat([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = ca.blockcat([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = ca.blockcat([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return ca.mtimes([z, y, x])


def _skew_part(matrix: ca.SX) -> ca.SX:
    return ca.vertcat(matrix[2, 1], matrix[0, 2], matrix[1, 0])


def _axis(matrix: ca.SX) -> ca.SX:
    return (_skew_part(matrix) - _skew_part(matrix.T)) / 2.0


def without_obstacles(cell: Workcell) -> Workcell:
    """The cell with nothing but its robots and the payload."""
    return replace(cell, environment=(), task=replace(cell.task, allowed_contacts=()))
