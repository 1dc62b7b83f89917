"""The assembled program: values against the physics, all derivatives against differences."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest

from symbolic.array import Array
from symbolic.cell_model import build_cell_model
from symbolic.functions.candidate import candidate_function
from symbolic.physics.path import path_basis
from symbolic.smooth.forces import force_functions, pressure_functions
from symbolic.smooth.problem import SmoothProblem, smooth_problem
from symbolic.smooth.rows import RowFunctions, RowKind, solve_function
from symbolic.workcell.file import load
from tests.symbolic.workcell.samples import RACK

PLACES = np.array([0.11, 0.3, 0.56])

TARGET = np.array([0.42, 0.43, 0.01, 0.02, 1.0, 0.7, 0.0, 0.1, 1.0, 1e-4, 2e-4])


@cache
def parts() -> tuple[SmoothProblem, Array, Array]:
    """A program with rows of every kind at three places, its parameters and a point."""
    cell = load(RACK)
    model = build_cell_model(cell)
    names = model.geometry.pair_names
    payload = next(k for k, pair in enumerate(names) if "payload" in pair and "top board" in pair)
    both = next(
        k for k, (a, b) in enumerate(names) if a.startswith("left/") and b.startswith("right/")
    )
    own = next(
        k for k, (a, b) in enumerate(names) if a.startswith("left/") and b.startswith("left/")
    )
    kinds = [
        RowKind("clearance", payload),
        RowKind("separation", payload, direction=3),
        RowKind("passing", payload, direction=5, after=0),
        RowKind("clearance", both),
        RowKind("clearance", own),
        RowKind("lower", 2, 0),
        RowKind("upper", 4, 1),
        RowKind("singularity", -1, 1),
    ]
    solve = (solve_function(model, 0), solve_function(model, 1))
    problem = smooth_problem(
        cell,
        {**force_functions(cell), **pressure_functions(cell)},
        solve,
        RowFunctions(model),
        tuple((robot, branch, 3 * k) for k in range(30) for robot in (0, 1) for branch in (0, 3)),
        ((1, 0), (0, 40), (1, 40), (0, 99)),
        tuple((kind, place) for place in range(3) for kind in kinds),
        len(PLACES),
    )
    along_path = path_basis(len(cell.task.waypoints), PLACES)
    bases = (along_path.position, along_path.first / 100.0)
    waypoints = np.array([waypoint.lower for waypoint in cell.task.waypoints])
    waypoints[list(cell.task.free_indices)] = cell.task.initial
    joints = []
    for arm in (0, 1):
        q, along = model.start[arm], []
        for u in np.linspace(0.0, 1.0, 101):
            pose = path_basis(len(waypoints), np.array([u])).position[0] @ waypoints
            q = np.array(solve[arm](pose, q)).ravel()
            along.append(q)
        joints.append(np.array(along)[np.round(100 * PLACES).astype(int)])
    z = np.concatenate(
        [np.random.default_rng(0).uniform(-0.2, 0.2, cell.task.n_var), [0.43] * 2, [0.1]]
    )
    return problem, problem.parameters(TARGET, *bases, *joints), z


def constraints(z: Array) -> Array:
    problem, p, _ = parts()
    return np.array(problem.nlp(z, p)[1]).ravel()


def test_jacobian_is_that_of_the_constraints() -> None:
    problem, p, z = parts()
    step = 1e-6
    columns = [
        (constraints(z + step * d) - constraints(z - step * d)) / (2 * step) for d in np.eye(len(z))
    ]
    values, jacobian = problem.jac_g(z, p)
    np.testing.assert_allclose(np.array(values).ravel(), constraints(z), rtol=1e-12)
    exact = np.array(ca.DM(jacobian).full())
    np.testing.assert_allclose(np.array(columns).T, exact, rtol=1e-5, atol=1e-4)


def test_gradient_is_that_of_the_objective() -> None:
    problem, p, z = parts()
    step = 1e-6
    slopes = [
        float(problem.nlp(z + step * d, p)[0] - problem.nlp(z - step * d, p)[0]) / (2 * step)
        for d in np.eye(len(z))
    ]
    np.testing.assert_allclose(np.array(problem.grad_f(z, p)[1]).ravel(), slopes, atol=1e-9)


def test_hessian_is_that_of_the_lagrangian() -> None:
    problem, p, z = parts()
    multipliers = np.random.default_rng(1).normal(size=len(constraints(z)))

    def gradient(at: Array) -> Array:
        slope = np.array(problem.grad_f(at, p)[1]).ravel() * 0.7
        return slope + np.array(ca.DM(problem.jac_g(at, p)[1]).full()).T @ multipliers

    step = 1e-6
    rows = [(gradient(z + step * d) - gradient(z - step * d)) / (2 * step) for d in np.eye(len(z))]
    upper = np.array(ca.DM(problem.hess_lag(z, p, 0.7, multipliers)).full())
    exact = upper + np.triu(upper, 1).T
    np.testing.assert_allclose(np.array(rows), exact, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("kind", ["force", "place"])
def test_rows_are_in_the_order_they_were_asked_for(kind: str) -> None:
    problem, _, z = parts()
    found = constraints(z)
    n = len(problem.force_rows)
    if kind == "force":
        # N_1 and N_2 of one sample and branch differ by the same F_n in every branch.
        scaled = found[:n].reshape(-1, 2, 2) + z[-3:-1, None]
        forces = scaled * TARGET[2:4, None] + TARGET[:2, None]
        np.testing.assert_allclose(
            forces[:, 0, 0] - forces[:, 1, 0], forces[:, 0, 1] - forces[:, 1, 1], atol=1e-12
        )
    else:
        rows = found[n + 6 :].reshape(len(PLACES), -1)
        assert np.all(rows[:, 5:7] > 0.0)
        assert len({tuple(row) for row in rows.tolist()}) == len(PLACES)


def test_pressure_rows_are_what_the_evaluators_shifts_leave_of_the_patches() -> None:
    problem, _, z = parts()
    cell = load(RACK)
    evaluate = candidate_function(build_cell_model(cell))
    x = problem.centre + problem.scale * z[: cell.task.n_var]
    shift = np.array(evaluate(x)[evaluate.name_out().index("pressure_shift")])
    n = len(problem.force_rows) + 2
    found = constraints(z)[n : n + len(problem.pressure_rows)]
    expected = [
        1.0 - (shift[robot, sample] / cell.contacts[robot].patch_radius) ** 2
        for robot, sample in problem.pressure_rows
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
