"""The polish as a nonlinear program with exact first and second derivatives.

Variables z = (xi, f, a): the decision vector scaled to [-1, 1] by its bounds, both robots' peak
forces over their references (the epigraph of the paper's Eq. 60), and a level. With the scaled
objectives phi = (f - anchor) / range, parameters of the program,

    minimise    cost . (a, phi_1, phi_2)
    subject to  N_i,k(x) / N_ref,i <= f_i           every sample k, robot i
                phi_j <= direction_j a + offset_j   both objectives
                c_r(x) >= required_r                chosen rows at chosen places of the path.

That covers the scalarisation of Pascoletti and Serafini (direction of ones), the epsilon
constraint (a zero in the direction) and normal boundary intersection (the normal as direction).
All derivatives are assembled from small functions that may be compiled; none is approximated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from symbolic.contact_forces import normal_force_branches
from symbolic.path import waypoint_matrix
from symbolic.smooth_forces import ForceBlock, force_blocks
from symbolic.smooth_rows import RowFunctions, RowKind
from symbolic.workcell import Array, Workcell

N_TARGET = 11
"""Length of the parameters anchor (2,), range (2,), direction (2,), offset (2,), cost (3,)."""

ForceRow = tuple[int, int, int]
"""Robot, branch of `normal_force_branches`, sample."""

PlaceRow = tuple[RowKind, int]
"""What is kept, and at which place."""


@dataclass(frozen=True)
class SmoothProblem:
    """The functions of one nonlinear program, in CasADi's conventions for `nlpsol`.

    Attributes:
        nlp: z, p -> objective, constraints.
        grad_f: z, p -> objective, its gradient.
        jac_g: z, p -> constraints, their Jacobian.
        hess_lag: z, p, multiplier of the objective and of the constraints -> upper triangle of
            the Hessian of the Lagrangian.
        force_rows: the first constraints, each at most 0; two for the objectives follow.
        place_rows: the last constraints, each at least its required value.
        n_places: number of places.
        scale, centre: (n_var,) x = centre + scale * xi.
    """

    nlp: ca.Function
    grad_f: ca.Function
    jac_g: ca.Function
    hess_lag: ca.Function
    force_rows: tuple[ForceRow, ...]
    place_rows: tuple[PlaceRow, ...]
    n_places: int
    scale: Array
    centre: Array

    def parameters(self, target: Array, basis: Array, q_1: Array, q_2: Array) -> Array:
        """The parameter vector p.

        Args:
            target: (N_TARGET,).
            basis: (n_places, n_waypoints) basis rows of the places.
            q_1, q_2: (n_places, 6) joints near those that hold the box there [rad].
        """
        return np.concatenate([target, basis.ravel(), q_1.ravel(), q_2.ravel()])


def branch_coefficients(workcell: Workcell) -> Array:
    """(2, 5, 2): per robot and branch the coefficients of F_n and F_t in the normal force."""
    f_n, f_t = ca.SX.sym("f_n"), ca.SX.sym("f_t")
    friction = (workcell.contacts[0].friction, workcell.contacts[1].friction)
    second = normal_force_branches(f_n, f_t, friction)
    split = ca.vertcat(f_n, f_t)
    return np.array([ca.DM(ca.jacobian(second + own * f_n, split)).full() for own in (1.0, 0.0)])


def smooth_problem(
    workcell: Workcell,
    forces: Mapping[str, ca.Function],
    solve: tuple[ca.Function, ca.Function],
    rows: RowFunctions,
    force_rows: tuple[ForceRow, ...],
    place_rows: tuple[PlaceRow, ...],
    n_places: int,
) -> SmoothProblem:
    """Assemble a program.

    Args:
        forces: those of `force_functions`, as they are or compiled.
        solve: `solve_function` of both arms, likewise.
        rows: makes the functions of `place_rows`.
    """
    task = workcell.task
    half = (task.upper - task.lower) / 2.0
    scale, centre = np.where(half > 0.0, half, 1.0), (task.upper + task.lower) / 2.0
    n = task.n_var
    z, p = ca.MX.sym("z", n + 3), ca.MX.sym("p", N_TARGET + n_places * (len(task.waypoints) + 12))
    x = z[:n] * ca.DM(scale) + ca.DM(centre)
    f, a = z[n : n + 2], z[n + 2]
    phi = (f - p[:2]) / p[2:4]

    payload = _Payload(workcell, forces, x)
    places = _Places(workcell, solve, rows, place_rows, n_places, x, p[N_TARGET:])
    owner = ca.DM(np.eye(2)[[robot for robot, _, _ in force_rows]])
    mix = _mix(workcell, payload.order, force_rows)

    objective = ca.dot(p[8:11], ca.vertcat(a, phi))
    g = ca.vertcat(
        ca.mtimes(mix, payload.split()) - ca.mtimes(owner, f),
        phi - p[4:6] * a - p[6:8],
        places.values(),
    )
    n_forces, n_rows = len(force_rows), len(place_rows)
    jacobian_x = ca.vertcat(ca.mtimes(mix, payload.jacobian()), ca.MX(2, n), places.jacobian())
    jacobian = ca.horzcat(
        ca.mtimes(jacobian_x, ca.DM(np.diag(scale))),
        ca.vertcat(-owner, ca.diag(1.0 / p[2:4]), ca.MX(n_rows, 2)),
        ca.vertcat(ca.MX(n_forces, 1), -p[4:6], ca.MX(n_rows, 1)),
    )
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.shape[0])
    curvature = payload.hessian(ca.mtimes(mix.T, lam_g[:n_forces]))
    curvature += places.hessian(lam_g[n_forces + 2 :])
    hessian = ca.diagcat(curvature * ca.DM(np.outer(scale, scale)), ca.MX(3, 3))
    gradient = ca.vertcat(ca.MX(ca.DM.zeros(n)), p[9:11] / p[2:4], p[8])
    names = ["x", "p"]
    return SmoothProblem(
        nlp=ca.Function("nlp", [z, p], [objective, g], names, ["f", "g"]),
        grad_f=ca.Function("nlp_grad_f", [z, p], [objective, gradient], names, ["f", "grad_f_x"]),
        jac_g=ca.Function("nlp_jac_g", [z, p], [g, jacobian], names, ["g", "jac_g_x"]),
        hess_lag=ca.Function(
            "nlp_hess_l",
            [z, p, lam_f, lam_g],
            [ca.triu(hessian)],
            [*names, "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
        force_rows=force_rows,
        place_rows=place_rows,
        n_places=n_places,
        scale=scale,
        centre=centre,
    )


def _mix(workcell: Workcell, order: NDArray[np.int64], force_rows: tuple[ForceRow, ...]) -> ca.DM:
    """Sparse (rows, 2 samples) matrix from F_n and F_t to forces over their references."""
    coefficients = branch_coefficients(workcell)
    column = np.empty(len(order), dtype=int)
    column[order] = np.arange(len(order))
    robots, branches, samples = np.array(force_rows, dtype=int).T
    values = coefficients[robots, branches] / workcell.task.reference_force[robots, None]
    rows = np.repeat(np.arange(len(force_rows)), 2)
    columns = (2 * column[samples][:, None] + np.arange(2)).ravel()
    return ca.DM.triplet(
        rows.tolist(), columns.tolist(), ca.DM(values.ravel()), len(force_rows), 2 * len(order)
    )


class _Payload:
    """F_n and F_t of all samples, in the order of the blocks, from the decision vector x."""

    def __init__(self, workcell: Workcell, forces: Mapping[str, ca.Function], x: ca.MX) -> None:
        self._forces, self._x = forces, x
        self._blocks = force_blocks(workcell.task)
        self.order = np.concatenate([block.samples.ravel() for block in self._blocks])

    def _call(self, block: ForceBlock, what: str, *further: ca.MX) -> ca.MX:
        calls = len(block.samples)
        basis = ca.DM(np.hstack([window.T for window in block.basis]))
        function = self._forces[f"{block.name}_{what}"]
        return function.map(calls)(ca.repmat(self._x, 1, calls), basis, *further)

    def split(self) -> ca.MX:
        return ca.vertcat(*[ca.vec(self._call(block, "value")) for block in self._blocks])

    def jacobian(self) -> ca.MX:
        return ca.horzcat(*[self._call(block, "gradient") for block in self._blocks]).T

    def hessian(self, weight: ca.MX) -> ca.MX:
        n = self._x.shape[0]
        total, start = ca.MX(ca.DM.zeros(n, n)), 0
        for block in self._blocks:
            calls, served = block.samples.shape
            own = ca.reshape(weight[start : start + 2 * calls * served], 2 * served, calls)
            start += 2 * calls * served
            each = self._call(block, "hessian", own)
            total += ca.reshape(ca.sum2(ca.reshape(each, n * n, calls)), n, n)
        return total


class _Places:
    """Rows at places of the path, from the decision vector x."""

    def __init__(
        self,
        workcell: Workcell,
        solve: tuple[ca.Function, ca.Function],
        rows: RowFunctions,
        place_rows: tuple[PlaceRow, ...],
        n_places: int,
        x: ca.MX,
        p: ca.MX,
    ) -> None:
        task = workcell.task
        n_waypoints = len(task.waypoints)
        self._rows, self._place_rows, self._n = rows, place_rows, x.shape[0]
        # Alike rows are evaluated by one map.
        self._groups: dict[RowKind, list[int]] = {}
        for row, (kind, _) in enumerate(place_rows):
            self._groups.setdefault(kind, []).append(row)
        self._order = [row for members in self._groups.values() for row in members]
        if not place_rows:
            return
        basis = ca.reshape(p[: n_places * n_waypoints], n_waypoints, n_places)
        start = n_places * n_waypoints
        self._pose = ca.mtimes(waypoint_matrix(task, x), basis)
        self._free = basis[list(task.free_indices), :]
        self._q = []
        for arm in (0, 1):
            reference = ca.reshape(p[start : start + 6 * n_places], 6, n_places)
            start += 6 * n_places
            needed = sorted({at for kind, at in place_rows if arm in rows.arms(kind)})
            joints = ca.MX(6, n_places)
            if needed:
                inputs = (self._pose[:, needed], reference[:, needed])
                joints[:, needed] = solve[arm].map(len(needed))(*inputs)
            self._q.append(ca.densify(joints))

    def _call(
        self, make: Callable[[RowKind], ca.Function], weight: ca.MX | None = None
    ) -> list[ca.MX]:
        """The function of every group, mapped over its rows."""
        results, start = [], 0
        for kind, members in self._groups.items():
            at = [self._place_rows[row][1] for row in members]
            inputs = [self._pose[:, at], self._q[0][:, at], self._q[1][:, at]]
            if weight is not None:
                inputs.append(weight[self._order[start : start + len(at)]].T)
            start += len(at)
            results.append(make(kind).map(len(at))(*inputs))
        return results

    def _restored(self, grouped: ca.MX) -> ca.MX:
        """Rows from the groups' order back into their own."""
        position = np.argsort(self._order)
        return grouped[[int(k) for k in position], :]

    def values(self) -> ca.MX:
        if not self._place_rows:
            return ca.MX(0, 1)
        return self._restored(ca.horzcat(*self._call(self._rows.value)).T)

    def jacobian(self) -> ca.MX:
        if not self._place_rows:
            return ca.MX(0, self._n)
        gradients = ca.horzcat(*self._call(self._rows.gradient))
        free = self._free_of_rows()
        by_waypoint = [gradients * ca.repmat(free[k, :], 6, 1) for k in range(free.shape[0])]
        return self._restored(ca.vertcat(*by_waypoint).T)

    def hessian(self, weight: ca.MX) -> ca.MX:
        if not self._place_rows:
            return ca.MX(ca.DM.zeros(self._n, self._n))
        each = ca.horzcat(*self._call(self._rows.hessian, weight))
        stacked = ca.reshape(each, 36, len(self._order))
        free = self._free_of_rows()
        blocks = [
            [
                ca.reshape(ca.mtimes(stacked, (free[k, :] * free[m, :]).T), 6, 6)
                for m in range(free.shape[0])
            ]
            for k in range(free.shape[0])
        ]
        return ca.vertcat(*[ca.horzcat(*row) for row in blocks])

    def _free_of_rows(self) -> ca.MX:
        """(n_free, rows) basis of the free waypoints, in the groups' order."""
        return self._free[:, [self._place_rows[row][1] for row in self._order]]
