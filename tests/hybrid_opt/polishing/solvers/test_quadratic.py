"""Quadratic programs by their conditions and Clarabel; convex models by what they keep."""

from __future__ import annotations

from dataclasses import replace

import clarabel
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from hybrid_opt.polishing import drive
from hybrid_opt.polishing.solvers import quadratic
from hybrid_opt.polishing.solvers.quadratic import (
    QuadraticAnswer,
    QuadraticProgram,
    convexify,
    solve_quadratic,
)
from symbolic.array import Array
from tests.hybrid_opt.polishing.cells import drive_method, solved, start

Seeds = st.integers(0, 2**32 - 1)
MANY = settings(max_examples=60, deadline=None)


def matrix(rng: np.random.Generator, n: int) -> Array:
    """Positive definite."""
    root = rng.normal(size=(n, n))
    return np.asarray(root @ root.T / n + 0.01 * np.eye(n))


def program(seed: int) -> QuadraticProgram:
    """Of random size, feasible; some hardly convex, some with repeated or empty rows, some without
    rows."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 60))
    m = int(rng.integers(0, 6 * n))
    H, A = matrix(rng, n), rng.normal(size=(m, n)) * (rng.random((m, n)) < 0.3)
    if rng.random() < 0.3:
        H = np.diag(np.where(rng.random(n) < 0.5, 1e-6, 1.0))
    if rng.random() < 0.3:
        A = np.concatenate([A, A[rng.random(m) < 0.5]])
    inside = 0.3 * rng.uniform(-1.0, 1.0, n)
    b = A @ inside + rng.exponential(0.2, len(A)) * (rng.random(len(A)) > 0.2)
    return QuadraticProgram(H, rng.normal(size=n), A, b, np.full(n, -0.3), np.full(n, 0.4))


def value(of: QuadraticProgram, d: Array) -> float:
    return float(d @ of.H @ d / 2.0 + of.g @ d)


def by_clarabel(of: QuadraticProgram) -> tuple[Array, str]:
    """The solution and the status of another method."""
    n, m = len(of.g), len(of.b)
    eye = np.eye(n)
    options = clarabel.DefaultSettings()
    options.verbose = False
    options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = 1e-8
    found = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(of.H)),
        of.g,
        sparse.csc_matrix(np.vstack([of.A, eye, -eye])),
        np.concatenate([of.b, of.high, -of.low]),
        [clarabel.NonnegativeConeT(m + 2 * n)],
        options,
    ).solve()
    return np.array(found.x), str(found.status)


def assert_optimal(of: QuadraticProgram, found: QuadraticAnswer) -> None:
    slope = of.H @ found.d + of.g + of.A.T @ found.rows + found.bounds
    room = of.b - of.A @ found.d
    assert np.abs(slope).max() < 1e-6
    assert room.min(initial=0.0) > -1e-6
    assert found.rows.min(initial=0.0) > -1e-9
    assert np.abs(found.rows * room).max(initial=0.0) < 1e-6
    assert (found.d >= of.low - 1e-6).all()
    assert (found.d <= of.high + 1e-6).all()
    to_bound = np.where(found.bounds > 0.0, of.high - found.d, found.d - of.low)
    assert np.abs(found.bounds * to_bound).max() < 1e-6


def cold(of: QuadraticProgram) -> Array:
    return np.zeros(len(of.g) + len(of.b))


@MANY
@given(Seeds)
def test_answers_are_optimal_and_no_worse_than_those_of_clarabel(seed: int) -> None:
    of = program(seed)
    found = solve_quadratic(of, cold(of))
    assert found is not None
    assert_optimal(of, found)
    other, status = by_clarabel(of)
    assert status == "Solved"
    assert value(of, found.d) == pytest.approx(value(of, other), abs=1e-5, rel=1e-5)


@MANY
@given(Seeds, st.booleans())
def test_answers_do_not_depend_on_the_active_set_of_the_start(seed: int, near: bool) -> None:
    of, rng = program(seed), np.random.default_rng(seed + 1)
    found = solve_quadratic(of, cold(of))
    assert found is not None
    begin = rng.normal(size=len(cold(of))) * (rng.random(len(cold(of))) < 0.3)
    begin[len(of.g) :] = np.abs(begin[len(of.g) :])
    if near:
        beside = solve_quadratic(replace(of, g=of.g + 0.01), cold(of))
        assert beside is not None
        begin = np.concatenate([beside.bounds, beside.rows])
    warm = solve_quadratic(of, begin)
    assert warm is not None
    assert value(of, warm.d) == pytest.approx(value(of, found.d), abs=1e-6, rel=1e-6)


@MANY
@given(Seeds)
def test_infeasible_programs_have_no_answer(seed: int) -> None:
    of, rng = program(seed), np.random.default_rng(seed + 1)
    if not of.A.any():
        return
    # The opposite of a row, by a share of what the box has room for.
    row = of.A[rng.choice(np.flatnonzero(of.A.any(axis=1)))]
    short = float(rng.uniform(1e-3, 0.3)) * np.abs(row).sum()
    least = np.minimum(row * of.low, row * of.high).sum() + short
    of = replace(of, A=np.vstack([of.A, row, -row]), b=np.append(of.b, [least, -least - short]))
    assert by_clarabel(of)[1] == "PrimalInfeasible"
    assert solve_quadratic(of, cold(of)) is None


def test_a_solve_without_iterations_left_has_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    of = program(1)
    monkeypatch.setattr(quadratic, "MOST_ITERATIONS", 1)
    assert solve_quadratic(of, cold(of)) is None


def test_programs_of_a_polish_agree_with_clarabel(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[QuadraticProgram, QuadraticAnswer | None]] = []

    def recorded(of: QuadraticProgram, begin: Array) -> QuadraticAnswer | None:
        asked.append((of, solve_quadratic(of, begin)))
        return asked[-1][1]

    monkeypatch.setattr(drive, "solve_quadratic", recorded)
    solved(drive_method(), start(52.0), 4)
    assert len(asked) > 10
    for of, found in asked:
        other, status = by_clarabel(of)
        assert (found is not None) == (status == "Solved")
        if found is not None:
            assert found.satisfies_optimality(of)
            assert value(of, found.d) == pytest.approx(value(of, other), abs=1e-5, rel=1e-5)


def test_wrong_answers_are_not_believed() -> None:
    of = program(1)
    found = solve_quadratic(of, cold(of))
    assert found is not None
    for wrong in (
        replace(found, d=found.d + 1e-3),
        replace(found, rows=found.rows + 1e-3),
        replace(found, rows=found.rows - 1e-3),
        replace(found, bounds=found.bounds + 1e-2),
        replace(found, d=np.full(len(found.d), np.nan)),
    ):
        assert not wrong.satisfies_optimality(of)


@MANY
@given(Seeds)
def test_a_convex_model_keeps_curvature_along_active_rows(seed: int) -> None:
    """Where the Lagrangian is definite on steps that keep active rows, the solution is its own."""
    rng = np.random.default_rng(seed)
    n, active = 10, 5
    A, b = rng.normal(size=(active, n)), rng.normal(size=active)
    # Far from convex across the active rows.
    H = matrix(rng, n) - 0.1 * A.T @ A
    g = rng.normal(size=n)
    model, shift = convexify(H, A, b)
    assert np.linalg.eigvalsh(model)[0] > 0.0
    null = np.linalg.svd(A)[2][active:].T
    anywhere = np.linalg.lstsq(A, b, rcond=None)[0]

    def stationary(of: Array, slope: Array) -> Array:
        reduced = null.T @ of @ null
        step = np.linalg.solve(reduced, -null.T @ (slope + of @ anywhere))
        return np.asarray(anywhere + null @ step)

    np.testing.assert_allclose(stationary(model, g + shift), stationary(H, g), rtol=1e-5, atol=1e-6)


@MANY
@given(Seeds)
def test_a_convex_model_bends_wherever_a_lagrangian_does_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(10, 10))
    model, _ = convexify(H + H.T, rng.normal(size=(2, 10)), np.zeros(2))
    assert np.linalg.eigvalsh(model)[0] > 0.0
    np.testing.assert_allclose(model, model.T, atol=1e-9)
