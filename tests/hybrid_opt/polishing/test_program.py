"""IPOPT on small programs with known answers, and the residuals of what it returns."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from hybrid_opt.polishing.program import FEASIBLE, PATIENCE, Program, ipopt, residuals, run
from hybrid_opt.polishing.records import PolishSettings
from symbolic.smooth.problem import SmoothProblem


def problem_of(objective: ca.SX, g: ca.SX, z: ca.SX, p: ca.SX) -> SmoothProblem:
    """A problem without physics, its functions written out by CasADi."""
    lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", g.shape[0])
    lagrangian = lam_f * objective + ca.dot(lam_g, g)
    names = ["x", "p"]
    return SmoothProblem(
        nlp=ca.Function("nlp", [z, p], [objective, g], names, ["f", "g"]),
        grad_f=ca.Function(
            "nlp_grad_f",
            [z, p],
            [objective, ca.densify(ca.gradient(objective, z))],
            names,
            ["f", "grad_f_x"],
        ),
        jac_g=ca.Function("nlp_jac_g", [z, p], [g, ca.jacobian(g, z)], names, ["g", "jac_g_x"]),
        hess_lag=ca.Function(
            "nlp_hess_l",
            [z, p, lam_f, lam_g],
            [ca.triu(ca.hessian(lagrangian, z)[0])],
            [*names, "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
        force_rows=(),
        pressure_rows=(),
        place_rows=(),
        row_scale=np.ones(0),
        n_places=0,
        scale=np.ones(2),
        centre=np.zeros(2),
    )


def corner() -> tuple[SmoothProblem, Program]:
    """Minimise (z_0 - 2)^2 + (z_1 - 2)^2 with z_0 + z_1 <= p and z_0 <= 0.5: (0.5, 0.5), p = 1."""
    z, p = ca.SX.sym("z", 2), ca.SX.sym("p")
    problem = problem_of(ca.sumsqr(z - 2.0), z[0] + z[1], z, p)
    return problem, Program(
        start=np.zeros(2),
        parameters=np.array([1.0]),
        low=np.array([-5.0, -5.0]),
        high=np.array([0.5, 5.0]),
        below=np.array([-np.inf]),
        above=np.array([1.0]),
    )


def test_a_corner_is_found_and_its_residuals_vanish() -> None:
    problem, program = corner()
    tighter = replace(program, high=np.array([0.3, 5.0]))
    answer = run(problem, ipopt(problem, PolishSettings()), tighter)
    assert answer.converged
    assert answer.usable
    np.testing.assert_allclose(answer.x, [0.3, 0.7], atol=1e-5)
    assert answer.residuals.stationarity < 1e-5
    assert answer.residuals.feasibility < 1e-6
    assert answer.residuals.complementarity < 1e-4


@pytest.mark.parametrize(
    ("z", "lam_x", "lam_g", "expected"),
    [
        # gradient (-3, -3) + multipliers: nothing left; everything on its bound
        ([0.5, 0.5], [0.0, 0.0], [3.0], (0.0, 0.0, 0.0)),
        # without multipliers the gradient is left over
        ([0.5, 0.5], [0.0, 0.0], [0.0], (3.0, 0.0, 0.0)),
        # violations of the constraint by 0.2 and of the bound by 0.1
        ([0.6, 0.6], [0.0, 0.0], [2.8], (0.0, 0.2, 0.56)),
        # a multiplier of a bound that is 5 away
        ([0.0, 0.0], [0.0, -1.0], [4.0], (1.0, 0.0, 5.0)),
    ],
)
def test_residuals_by_hand(
    z: list[float], lam_x: list[float], lam_g: list[float], expected: tuple[float, float, float]
) -> None:
    problem, program = corner()
    found = residuals(problem, program, np.array(z), np.array(lam_x), np.array(lam_g))
    values = (found.stationarity, found.feasibility, found.complementarity)
    np.testing.assert_allclose(values, expected, atol=1e-12)


def test_nan_in_a_derivative_is_told() -> None:
    z, p = ca.SX.sym("z", 2), ca.SX.sym("p")
    # At the start, (0, 0), the slope is zero over zero.
    objective = ca.sqrt(z[0] * z[1])
    problem = problem_of(objective, z[0] + z[1], z, p)
    _, program = corner()
    answer = run(problem, ipopt(problem, PolishSettings()), program)
    assert not answer.converged
    assert answer.message == "Invalid_Number_Detected"
    assert np.isnan(answer.residuals.stationarity)


def test_an_unbounded_program_diverges_without_harm() -> None:
    z, p = ca.SX.sym("z", 2), ca.SX.sym("p")
    problem = problem_of(-(z[0] ** 3), z[1] - z[0], z, p)
    wide = Program(
        start=np.ones(2),
        parameters=np.array([0.0]),
        low=np.full(2, -np.inf),
        high=np.full(2, np.inf),
        below=np.array([-np.inf]),
        above=np.array([0.0]),
    )
    answer = run(problem, ipopt(problem, PolishSettings(max_iterations=30)), wide)
    assert not answer.converged
    assert answer.message != "Solve_Succeeded"
    assert isinstance(answer.x, np.ndarray)


def test_an_infeasible_program_says_so() -> None:
    z, p = ca.SX.sym("z", 2), ca.SX.sym("p")
    problem = problem_of(ca.sumsqr(z), z[0] ** 2 + 1.0, z, p)
    _, program = corner()
    impossible = replace(program, start=program.start + 0.3, above=np.array([0.0]))
    answer = run(problem, ipopt(problem, PolishSettings(max_iterations=200)), impossible)
    assert not answer.converged
    assert answer.residuals.feasibility > 0.5


def curved() -> tuple[SmoothProblem, Program]:
    """From outside onto a thin ring, which steps along its tangent violate again and again."""
    z, p = ca.SX.sym("z", 2), ca.SX.sym("p")
    problem = problem_of(-z[0] - z[1] ** 3, 100.0 * (ca.sumsqr(z) - 1.0), z, p)
    return problem, Program(
        start=np.array([0.1, 2.0]),
        parameters=np.array([0.0]),
        low=np.full(2, -5.0),
        high=np.full(2, 5.0),
        below=np.array([-1e-3]),
        above=np.array([1e-3]),
    )


def test_a_solve_is_not_cut_off_where_it_violates_something() -> None:
    problem, program = curved()
    cut = run(problem, ipopt(problem, PolishSettings(max_iterations=1)), program)
    assert cut.residuals.feasibility > FEASIBLE
    assert cut.iterations == PATIENCE
    patient = run(problem, ipopt(problem, PolishSettings(max_iterations=2)), program)
    assert patient.message == "User_Requested_Stop"
    assert 2 < patient.iterations < PATIENCE * 2
    assert patient.residuals.feasibility <= FEASIBLE
