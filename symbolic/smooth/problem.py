"""The polish as a nonlinear program with exact first and second derivatives.

Variables z = (xi, phi, a): the decision vector scaled to [-1, 1] by its bounds, both robots' peak
forces f (the epigraph of the paper's Eq. 60) as phi = (f - anchor) / range, and a level. With the
anchor and the range among the parameters of the program,

    minimise    cost . (a, phi_1, phi_2)
    subject to  (N_i,k(x) / N_ref,i - anchor_i) / range_i <= phi_i   chosen samples k, robot i
                phi_j <= direction_j a + offset_j                    both objectives
                1 - (shift_i,k(x) / patch radius_i)^2 >= 0           chosen robots and samples
                c_r(x) / scale_r >= required_r / scale_r             chosen rows at chosen places.

That covers the scalarisation of Pascoletti and Serafini (direction of ones), the epsilon
constraint (a zero in the direction) and normal boundary intersection (the normal as direction).
All derivatives are assembled from small functions that may be compiled; none is approximated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.physics.contact_forces import normal_force_branches
from symbolic.smooth.blocks import PlaceRow, PlaceValues, SampleValues
from symbolic.smooth.forces import sample_blocks
from symbolic.smooth.rows import RowFunctions
from symbolic.workcell.records import Workcell

N_TARGET = 11
"""Length of the parameters anchor (2,), range (2,), direction (2,), offset (2,), cost (3,)."""

SCALES = {
    "clearance": 0.01,
    "separation": 0.01,
    "passing": 0.01,
    "lower": 0.1,
    "upper": 0.1,
    "singularity": 1.0,
}
"""What rows of each kind are divided by [m, rad, 1]: a solver that sees metres takes a centimetre
for a trifle."""

ForceRow = tuple[int, int, int]
"""Robot, branch of `normal_force_branches`, sample."""

PressureRow = tuple[int, int]
"""Robot, sample."""


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
        pressure_rows: the next, at least 0.
        place_rows: the last constraints, each at least its required value.
        row_scale: what these are divided by, as their required values have to be.
        n_places: number of places.
        scale, centre: (n_var,) x = centre + scale * xi.
    """

    nlp: ca.Function
    grad_f: ca.Function
    jac_g: ca.Function
    hess_lag: ca.Function
    force_rows: tuple[ForceRow, ...]
    pressure_rows: tuple[PressureRow, ...]
    place_rows: tuple[PlaceRow, ...]
    row_scale: Array
    n_places: int
    scale: Array
    centre: Array

    def parameters(
        self, target: Array, basis: Array, rate_basis: Array, q_1: Array, q_2: Array
    ) -> Array:
        """The parameter vector p.

        Args:
            target: (N_TARGET,).
            basis, rate_basis: (n_places, n_waypoints) basis rows of the places, and of the change
                from place to place.
            q_1, q_2: (n_places, 6) joints near those that hold the box there [rad].
        """
        bases = (basis.ravel(), rate_basis.ravel())
        return np.concatenate([target, *bases, q_1.ravel(), q_2.ravel()])


def branch_coefficients(workcell: Workcell) -> Array:
    """(2, 5, 2): per robot and branch the coefficients of F_n and F_t in the normal force."""
    f_n, f_t = ca.SX.sym("f_n"), ca.SX.sym("f_t")
    friction = (workcell.contacts[0].friction, workcell.contacts[1].friction)
    second = normal_force_branches(f_n, f_t, friction)
    split = ca.vertcat(f_n, f_t)
    return np.array([ca.DM(ca.jacobian(second + own * f_n, split)).full() for own in (1.0, 0.0)])


def smooth_problem(
    workcell: Workcell,
    samples: Mapping[str, ca.Function],
    solve: tuple[ca.Function, ca.Function],
    rows: RowFunctions,
    force_rows: tuple[ForceRow, ...],
    pressure_rows: tuple[PressureRow, ...],
    place_rows: tuple[PlaceRow, ...],
    n_places: int,
) -> SmoothProblem:
    """Assemble a program.

    Args:
        samples: those of `force_functions` and `pressure_functions`, as they are or compiled.
        solve: `solve_function` of both arms, likewise.
        rows: makes the functions of `place_rows`.
    """
    task = workcell.task
    half = (task.upper - task.lower) / 2.0
    scale, centre = np.where(half > 0.0, half, 1.0), (task.upper + task.lower) / 2.0
    n = task.n_var
    z = ca.MX.sym("z", n + 3)
    p = ca.MX.sym("p", N_TARGET + n_places * (2 * len(task.waypoints) + 12))
    x = z[:n] * ca.DM(scale) + ca.DM(centre)
    phi, a = z[n : n + 2], z[n + 2]

    ruling = {sample for _, _, sample in force_rows}
    payload = SampleValues(sample_blocks(workcell.task, ruling), samples, "force", x)
    wanted = {sample for _, sample in pressure_rows}
    patches = SampleValues(sample_blocks(workcell.task, wanted), samples, "pressure", x)
    pick = patches.chosen(pressure_rows)
    places = PlaceValues(workcell, solve, rows, place_rows, n_places, x, p[N_TARGET:])
    owner = ca.DM(np.eye(2)[[robot for robot, _, _ in force_rows]])
    mix = _mix(workcell, payload.order, force_rows)

    objective = ca.dot(p[8:11], ca.vertcat(a, phi))
    anchor, span = ca.mtimes(owner, p[:2]), ca.mtimes(owner, p[2:4])
    row_scale = np.array([SCALES[kind.kind] for kind, _ in place_rows])
    g = ca.vertcat(
        (ca.mtimes(mix, payload.values()) - anchor) / span - ca.mtimes(owner, phi),
        phi - p[4:6] * a - p[6:8],
        ca.mtimes(pick, patches.values()),
        places.values() / ca.DM(row_scale),
    )
    n_forces, n_patches = len(force_rows), len(pressure_rows)
    n_rows = n_patches + len(place_rows)
    first = n_forces + 2 + n_patches
    jacobian_x = ca.vertcat(
        ca.mtimes(mix, payload.jacobian()) / ca.repmat(span, 1, n),
        ca.MX(2, n),
        ca.mtimes(pick, patches.jacobian()),
        places.jacobian() / ca.DM(np.repeat(row_scale[:, None], n, axis=1)),
    )
    jacobian = ca.horzcat(
        ca.mtimes(jacobian_x, ca.DM(np.diag(scale))),
        ca.vertcat(-owner, ca.MX(ca.DM.eye(2)), ca.MX(n_rows, 2)),
        ca.vertcat(ca.MX(n_forces, 1), -p[4:6], ca.MX(n_rows, 1)),
    )
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.shape[0])
    curvature = payload.hessian(ca.mtimes(mix.T, lam_g[:n_forces] / span))
    curvature += patches.hessian(ca.mtimes(pick.T, lam_g[n_forces + 2 : first]))
    curvature += places.hessian(lam_g[first:] / ca.DM(row_scale))
    hessian = ca.diagcat(curvature * ca.DM(np.outer(scale, scale)), ca.MX(3, 3))
    gradient = ca.vertcat(ca.MX(ca.DM.zeros(n)), p[9:11], p[8])
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
        pressure_rows=pressure_rows,
        place_rows=place_rows,
        row_scale=row_scale,
        n_places=n_places,
        scale=scale,
        centre=centre,
    )


def _mix(workcell: Workcell, order: NDArray[np.int64], force_rows: tuple[ForceRow, ...]) -> ca.DM:
    """Sparse (rows, 2 samples) matrix from F_n and F_t to forces over their references."""
    coefficients = branch_coefficients(workcell)
    column = np.full(workcell.task.samples, -1)
    column[order] = np.arange(len(order))
    robots, branches, samples = np.array(force_rows, dtype=int).T
    values = coefficients[robots, branches] / workcell.task.reference_force[robots, None]
    rows = np.repeat(np.arange(len(force_rows)), 2)
    columns = (2 * column[samples][:, None] + np.arange(2)).ravel()
    return ca.DM.triplet(
        rows.tolist(), columns.tolist(), ca.DM(values.ravel()), len(force_rows), 2 * len(order)
    )
