"""Time-optimal timing as one convex program, solved by an interior-point method.

Independent of the timing package in formulation and solver: all intervals at once, norms as
second-order cones, times through rotated cones (after Verscheure et al., 2009). It shares only
the geometry along the path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import clarabel
import numpy as np
from scipy import sparse

from hybrid_opt.timing.model import REFINEMENT, PathMotion, TimingModel
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array

Terms = dict[int, float]
Affine = Callable[[float, float], Terms]


class Program:
    """Rows A z + s = b with s in cones, gathered one cone at a time."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.rows: list[tuple[Terms, float]] = []
        self.cones: list[object] = []

    def fresh(self, count: int) -> int:
        """The first of some more variables."""
        self.n += count
        return self.n - count

    def at_most(self, terms: Terms, bound: float) -> None:
        """terms . z <= bound, which is positive."""
        self.rows.append(({k: v / bound for k, v in terms.items()}, 1.0))
        self.cones.append(clarabel.NonnegativeConeT(1))

    def equals(self, index: int, value: float) -> None:
        self.rows.append(({index: 1.0}, value))
        self.cones.append(clarabel.ZeroConeT(1))

    def norm(self, parts: list[tuple[Terms, float]]) -> None:
        """First part at least the length of the others; a part is (terms, constant)."""
        for terms, constant in parts:
            self.rows.append(({k: -v for k, v in terms.items()}, constant))
        self.cones.append(clarabel.SecondOrderConeT(len(parts)))

    def zero(self, parts: list[tuple[Terms, float]]) -> None:
        """Every part is zero."""
        self.rows += [({k: -v for k, v in terms.items()}, constant) for terms, constant in parts]
        self.cones.append(clarabel.ZeroConeT(len(parts)))

    def solve(self, cost: Array) -> Array:
        """The optimum; that of semidefinite cones to what the solver reaches."""
        semidefinite = any(isinstance(cone, clarabel.PSDTriangleConeT) for cone in self.cones)
        tolerated = ("AlmostSolved",) if semidefinite else ()
        entries = [(i, k, v) for i, (terms, _) in enumerate(self.rows) for k, v in terms.items()]
        i, k, v = (np.array(column) for column in zip(*entries, strict=True))
        matrix = sparse.csc_matrix((v, (i, k)), shape=(len(self.rows), self.n))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_rel = settings.tol_gap_abs = settings.tol_feas = 1e-7
        solution = clarabel.DefaultSolver(
            sparse.csc_matrix((self.n, self.n)),
            cost,
            matrix,
            np.array([bound for _, bound in self.rows]),
            self.cones,
            settings,
        ).solve()
        assert str(solution.status) in ("Solved", *tolerated), solution.status
        return np.array(solution.x)


def shortest_duration(
    model: TimingModel, x: Array, limits: TimingLimits, limit_force: LimitForce | None = None
) -> float:
    """Shortest duration [s] from rest to rest; torque and pressure limits are left out.

    Args:
        limit_force: what limits forces at a point of an interval; by default the planned ones.
    """
    n, cell = model.intervals, model.workcell
    motion = model.path_motion(x).at(np.arange(0, REFINEMENT * model.intervals + 1, REFINEMENT))
    scale = 5.0  # around the duration [s], so that variables are around one
    delta = scale / n
    program = Program(3 * n + 2)
    root, inverse = n + 1, 2 * n + 2  # z = (u'^2 at n + 1, its root at n + 1, 1 / sums at n)
    program.equals(0, 0.0)
    program.equals(n, 0.0)
    for i in range(n + 1):
        program.norm([({i: 1.0}, 1.0), ({root + i: 2.0}, 0.0), ({i: 1.0}, -1.0)])
        for speed, bound in _speeds(model, motion, i, limits):
            program.at_most({i: speed**2 / scale**2}, bound**2)
    for interval, (i, k) in enumerate(pairwise(range(n + 1))):
        total = {inverse + interval: 1.0, root + i: 1.0, root + k: 1.0}
        difference = {inverse + interval: 1.0, root + i: -1.0, root + k: -1.0}
        program.norm([(total, 0.0), ({}, 2.0), (difference, 0.0)])
        for point in (i, k):

            def affine(
                first: float, second: float, i: int = i, k: int = k, point: int = point
            ) -> Terms:
                """Terms of first u'' + second u'^2 at a point of the interval."""
                slope = first / scale / (2.0 * delta)
                terms = {i: -slope, k: slope}
                terms[point] += second / scale**2
                return terms

            for first, second, bound in _joints(model, motion, point):
                program.at_most(affine(first, second), bound)
                program.at_most(affine(-first, -second), bound)
            for linear, curved, bound in (
                (
                    motion.pose_first[point, :3],
                    motion.pose_second[point, :3],
                    cell.payload.acceleration_max,
                ),
                (
                    motion.angular_first[point],
                    motion.angular_second[point],
                    cell.payload.angular_acceleration_max,
                ),
            ):
                rows = [
                    (affine(f / bound, s / bound), 0.0) for f, s in zip(linear, curved, strict=True)
                ]
                program.norm([({}, 1.0), *rows])
            if limits.force is not None:
                (limit_force or _limit_force)(program, model, motion, point, limits.force, affine)
    cost = np.zeros(program.n)
    cost[inverse : inverse + n] = 2.0 * delta
    z = program.solve(cost)
    path_speed = np.sqrt(np.maximum(z[: n + 1], 0.0))
    return float(np.sum(2.0 * delta / (path_speed[:-1] + path_speed[1:])))


LimitForce = Callable[[Program, TimingModel, PathMotion, int, float, Affine], None]


def _speeds(
    model: TimingModel, motion: PathMotion, i: int, limits: TimingLimits
) -> Iterator[tuple[float, float]]:
    cell = model.workcell
    velocity = np.concatenate([robot.velocity_max for robot in cell.robots])
    yield from zip(motion.q_first[i], velocity, strict=True)
    linear = float(np.linalg.norm(motion.pose_first[i, :3]))
    angular = float(np.linalg.norm(motion.angular_first[i]))
    yield linear, cell.payload.velocity_max
    yield angular, cell.payload.angular_velocity_max
    if limits.reference_speed:
        yield linear, cell.task.reference_speed
        yield angular, cell.task.reference_angular_speed


def _joints(model: TimingModel, motion: PathMotion, i: int) -> Iterator[tuple[float, float, float]]:
    limit = np.concatenate([robot.acceleration_max for robot in model.workcell.robots])
    yield from zip(motion.q_first[i], motion.q_second[i], limit, strict=True)


def _limit_force(
    program: Program,
    model: TimingModel,
    motion: PathMotion,
    i: int,
    force: float,
    affine: Affine,
) -> None:
    """Both normal forces at most `force`, with contact forces as free variables eliminated.

    For equal friction mu the least squeeze S = N_1 + N_2 is max(F_t / mu, |F_n|,
    (mu F_t + mu^2 |F_n|) / (1 + mu^2)), and N = (S +- F_n) / 2.
    """
    mu = model.workcell.contacts[0].friction
    assert mu == model.workcell.contacts[1].friction
    weight = model.workcell.payload.mass * np.array([0.0, 0.0, -9.81])
    n = motion.normal[i]
    project = np.eye(3) - np.outer(n, n)
    first, second = motion.force_by_acceleration[i], motion.force_by_speed[i]
    tangent = [
        (affine(project[r] @ first, project[r] @ second), -project[r] @ weight) for r in range(3)
    ]

    def cone(by_tangent: float, by_normal: float) -> None:
        """by_tangent F_t + by_normal F_n <= 2 force."""
        a, b = by_normal / (2.0 * force), by_tangent / (2.0 * force)
        rest = affine(-a * (n @ first), -a * (n @ second))
        parts = [({k: b * v for k, v in terms.items()}, b * value) for terms, value in tangent]
        program.norm([(rest, 1.0 + a * (n @ weight)), *parts])

    for sign in (1.0, -1.0):  # 2 N = S + sign F_n
        for share in (mu, -mu):
            cone(mu / (1.0 + mu**2), sign + mu * share / (1.0 + mu**2))
        cone(1.0 / mu, sign)
        for absolute in (1.0, -1.0):
            c = sign + absolute
            program.at_most(affine(c * n @ first, c * n @ second), 2.0 * force + c * n @ weight)
