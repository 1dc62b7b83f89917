"""Both solvers on programs whose solutions are known, and the residuals of what they return."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
import pytest

from hybrid_opt.polishing.solvers.base import (
    FEASIBILITY_PATIENCE,
    FEASIBLE_ROW,
    Answer,
    NonlinearProgram,
    estimate_multipliers,
    native,
    optimality_residuals,
    residuals,
)
from hybrid_opt.polishing.solvers.dense import dense
from hybrid_opt.polishing.solvers.ipopt import ipopt
from symbolic.array import Array
from symbolic.errors import BridgeError
from tests.refusals import refused

Solver = Callable[[NonlinearProgram, int, float], Answer]

BARRIER, LONG = 3e-4, 200


SOLVERS = pytest.mark.parametrize("solve", [ipopt, dense])


@dataclass
class Written:
    """A program whose rows are written as one CasADi expression."""

    z: ca.SX
    h: ca.SX
    cost: Array
    start: Array
    low: Array
    high: Array

    def values(self, z: Array) -> Array:
        return self.rows(z)[0]

    def rows(self, z: Array) -> tuple[Array, Array]:
        found = ca.Function("h", [self.z], [self.h, ca.densify(ca.jacobian(self.h, self.z))])(z)
        return np.array(found[0]).ravel(), np.array(found[1])

    def curvature(self, z: Array, weights: Array) -> Array:
        hessian = ca.hessian(ca.dot(self.h, ca.DM(weights)), self.z)[0]
        return np.array(ca.Function("hessian", [self.z], [ca.densify(hessian)])(z))


def written(g: Callable[[ca.SX], ca.SX], cost: list[float], start: list[float]) -> Written:
    """Within a box of 5, g at most 0."""
    n = len(start)
    z = ca.SX.sym("z", n)
    return Written(z, -g(z), np.array(cost), np.array(start), np.full(n, -5.0), np.full(n, 5.0))


def disc() -> Written:
    """Minimise -z_0 - z_1 in the unit disc: both are sqrt(1/2), the multiplier is sqrt(1/2)."""
    return written(lambda z: ca.sumsqr(z) - 1.0, [-1.0, -1.0], [0.1, -0.3])


@SOLVERS
def test_it_finds_the_optimum_of_a_convex_program(solve: Solver) -> None:
    answer = solve(disc(), LONG, BARRIER)
    assert answer.converged
    np.testing.assert_allclose(answer.z, np.full(2, 0.5**0.5), atol=1e-5)
    found = optimality_residuals(disc(), answer.z)
    assert max(found.stationarity, found.feasibility, found.complementarity) < 1e-5


@SOLVERS
def test_bounds_hold_and_have_multipliers(solve: Solver) -> None:
    program = disc()
    program.high[0] = 0.5
    answer = solve(program, LONG, BARRIER)
    assert answer.converged
    np.testing.assert_allclose(answer.z, [0.5, 0.75**0.5], atol=1e-5)
    assert optimality_residuals(program, answer.z).stationarity < 1e-5


@SOLVERS
def test_it_finds_a_way_around_an_obstacle(solve: Solver) -> None:
    """Minimise -z_0 outside a disc and below a slope: not convex, the far side is optimal."""

    def rows(z: ca.SX) -> ca.SX:
        return ca.vertcat(1.0 - ca.sumsqr(z), z[1] + 0.5 * z[0] - 3.0)

    answer = solve(written(rows, [-1.0, -0.1], [-2.0, 0.7]), LONG, BARRIER)
    assert answer.converged
    np.testing.assert_allclose(answer.z, [5.0, 0.5], atol=1e-4)


@SOLVERS
def test_many_random_linear_programs_agree_with_simplex(solve: Solver) -> None:
    from scipy.optimize import linprog

    rng = np.random.default_rng(4)
    for _ in range(5):
        A, b = rng.normal(size=(12, 4)), rng.uniform(0.2, 1.0, 12)
        cost = rng.normal(size=4)
        rows = partial(_plane_values, A, b)
        program = written(rows, list(cost), [0.0] * 4)
        exact = linprog(cost, A, b, bounds=(-5.0, 5.0))
        answer = solve(program, LONG, BARRIER)
        assert answer.converged
        assert float(cost @ answer.z) == pytest.approx(exact.fun, abs=1e-4)


def _plane_values(A: Array, b: Array, z: ca.SX) -> ca.SX:
    return ca.mtimes(ca.DM(A), z) - ca.DM(b)


@SOLVERS
def test_an_impossible_program_is_told(solve: Solver) -> None:
    program = written(lambda z: ca.vertcat(z[0] + 1.0, 1.0 - z[0]), [1.0, 1.0], [0.0, 0.0])
    answer = solve(program, LONG, BARRIER)
    assert not answer.converged
    assert optimality_residuals(program, answer.z).feasibility > 0.5


def rough(z: ca.SX) -> ca.SX:
    """Rows that bend both ways, some of them violated at the start."""
    rng = np.random.default_rng(3)
    A, b = ca.DM(rng.normal(size=(30, 5))), ca.DM(rng.uniform(-0.1, 1.0, 30))
    return ca.mtimes(A, z) - b + 0.3 * ca.cos(3.0 * ca.mtimes(A, z)) - 0.2


def test_the_dense_method_agrees_with_ipopt() -> None:
    program = written(rough, [-1.0, 0.3, 0.0, 0.2, -0.1], [0.0] * 5)
    # One row of two sides.
    least = -program.values(program.start)[0] - 0.5
    program.h = ca.vertcat(program.h, -program.h[0] - least)
    answer, other = dense(program, LONG, BARRIER), ipopt(program, LONG, BARRIER)
    assert answer.converged
    assert other.converged
    assert optimality_residuals(program, answer.z).stationarity < 1e-5
    assert optimality_residuals(program, answer.z).feasibility < 1e-6
    assert float(program.cost @ answer.z) == pytest.approx(float(program.cost @ other.z), abs=1e-4)


def test_the_dense_method_goes_on_where_rows_are_no_numbers() -> None:
    """Beyond a ring: no trial is taken for a while."""

    def rows(z: ca.SX) -> ca.SX:
        return ca.vertcat(ca.sqrt(1.1 - ca.sumsqr(z)) - 2.0, ca.sumsqr(z) - 1.0)

    program = written(rows, [-1.0, -2.0], [0.1, 0.2])
    answer = dense(program, LONG, BARRIER)
    assert answer.converged
    np.testing.assert_allclose(answer.z, np.array([1.0, 2.0]) / 5.0**0.5, atol=1e-4)


def test_ipopt_is_not_cut_off_where_it_violates_something() -> None:
    """From outside into a thin curved strip, which steps along its tangent leave again."""
    z = ca.SX.sym("z", 2)
    program = Written(
        z,
        1e-2 + 100.0 * ca.vertcat(ca.sumsqr(z) - 1.0, 1.0 - ca.sumsqr(z)),
        np.array([-1.0, -2.0]),
        np.array([0.1, 2.0]),
        np.full(2, -5.0),
        np.full(2, 5.0),
    )
    cut = ipopt(program, 1, BARRIER)
    assert cut.iterations <= FEASIBILITY_PATIENCE
    assert optimality_residuals(program, cut.z).feasibility > FEASIBLE_ROW
    patient = ipopt(program, 3, BARRIER)
    assert 3 < patient.iterations < 3 * FEASIBILITY_PATIENCE
    assert optimality_residuals(program, patient.z).feasibility <= FEASIBLE_ROW


def test_the_dense_method_keeps_what_holds_wherever_it_is_cut_off() -> None:
    def rows(z: ca.SX) -> ca.SX:
        return ca.vertcat(1.0 - ca.sumsqr(z), z[1] + 0.5 * z[0] - 3.0)

    program = written(rows, [-1.0, -0.1], [-2.0, 0.7])
    costs = [float(program.cost @ program.start)]
    for iterations in (1, 2, 4, 8, 16):
        answer = dense(program, iterations, BARRIER)
        assert answer.iterations <= iterations
        assert optimality_residuals(program, answer.z).feasibility == 0.0
        costs.append(float(program.cost @ answer.z))
    assert costs[-1] < costs[1] < costs[0]


def test_residuals_of_the_optimum_vanish_and_of_others_do_not() -> None:
    program = disc()
    best, multiplier, none = np.full(2, 0.5**0.5), np.array([0.5**0.5]), np.zeros(2)
    told = partial(residuals, bounds=(program.low, program.high))
    exact = told(program, best, none, multiplier)
    assert exact.stationarity < 1e-12
    assert exact.feasibility < 1e-12
    assert exact.complementarity < 1e-12
    assert told(program, best, none, 2.0 * multiplier).stationarity == pytest.approx(1.0)
    assert told(program, 2.0 * best, none, multiplier).feasibility == pytest.approx(3.0)
    inside = told(program, 0.5 * best, none, multiplier)
    assert inside.complementarity == pytest.approx(0.75 * 0.5**0.5)


def test_multipliers_of_an_optimum_are_found() -> None:
    """Minimise -z_0 - 2 z_1 with z_0 + z_1 <= 1 (its slack is 1 - z_0 - z_1) and z_1 <= 0.25."""
    cost = np.array([-1.0, -2.0])
    A = np.array([[-1.0, -1.0], [1.0, 0.0]])
    slacks = (np.array([0.0, 3.0]), np.array([5.75, 5.25]), np.array([4.25, 0.0]))
    bounds, y = estimate_multipliers(cost, A, slacks)
    np.testing.assert_allclose(y, [1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(bounds, [0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(cost - A.T @ y + bounds, 0.0, atol=1e-9)


@pytest.fixture
def fresh_native() -> Iterator[None]:
    """Have the compiled part looked for again, during the test and after it."""
    native.cache_clear()
    yield
    native.cache_clear()


@pytest.mark.usefixtures("fresh_native")
def test_a_missing_module_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hybrid_opt.polishing._native", None)
    with refused(BridgeError, "not-loadable", "pip install -e ."):
        native()
