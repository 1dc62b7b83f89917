"""Quadratic programs by their conditions and Clarabel; convex models by what they keep."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.polishing.solvers import quadratic
from hybrid_opt.polishing.solvers.base import native
from hybrid_opt.polishing.solvers.quadratic import (
    BorderedMatrix,
    BorderedRows,
    QuadraticAnswer,
    QuadraticProgram,
    convexify,
    solve_interior_point,
    solve_quadratic,
)
from symbolic.array import Array
from symbolic.errors import BridgeError
from tests.hybrid_opt.polishing.cells import drive_method, solved, start
from tests.refusals import refused


def matrix(rng: np.random.Generator, k: int, n: int) -> BorderedMatrix:
    """Positive definite."""
    root = rng.normal(size=(k, k))
    off = rng.normal(size=n - 1)
    size = 1.0 + np.abs(np.append(off, 0.0)) + np.abs(np.append(0.0, off))
    return BorderedMatrix(
        root @ root.T + 0.1 * k * n * np.eye(k), 0.3 * rng.normal(size=(n, k)), size, off
    )


def rows(rng: np.random.Generator, m: int, k: int, n: int) -> BorderedRows:
    """Some without the border, some without the chain."""
    border, left, right = rng.normal(size=(m, k)), *rng.normal(size=(2, m))
    border[: m // 4], left[m // 2 :], right[m // 3 :] = 0.0, 0.0, 0.0
    return BorderedRows(border, rng.integers(0, n - 1, m), left, right, n)


def program(seed: int) -> QuadraticProgram:
    """Of random size; some barely convex, with repeated rows or redundant ones."""
    rng = np.random.default_rng(seed)
    k, n = int(rng.integers(1, 20)), int(rng.integers(2, 100))
    m = int(rng.integers(1, 6 * n))
    H, A = matrix(rng, k, n), rows(rng, m, k, n)
    if seed % 3 == 0:  # no curvature but that of the border
        H = BorderedMatrix(H.corner, 0.0 * H.beside, 0.0 * H.diagonal, 0.0 * H.off)
    if seed % 4 == 0:
        twice = np.concatenate([np.arange(m), rng.integers(0, m, m)])
        A = A.select(twice)
    inside = 0.3 * rng.uniform(-1.0, 1.0, k + n)
    b = A.times(inside) + rng.exponential(0.2, len(A)) * (rng.random(len(A)) > 0.2)
    low, high = np.full(k + n, -0.3), np.full(k + n, 0.4)
    return QuadraticProgram(H, rng.normal(size=k + n), A, b, low, high)


def value(of: QuadraticProgram, d: Array) -> float:
    return float(d @ of.H.dense() @ d / 2.0 + of.g @ d)


def assert_optimal(of: QuadraticProgram, found: QuadraticAnswer) -> None:
    """By its own conditions, and no worse than Clarabel's answer."""
    slope = of.H.dense() @ found.d + of.g + of.A.transpose_times(found.rows) + found.bounds
    room = of.b - of.A.times(found.d)
    size = 1.0 + np.abs(of.H.dense()).max()
    assert np.abs(slope).max() < 1e-6 * size
    assert room.min() > -1e-6
    assert found.rows.min() > -1e-9
    assert np.abs(found.rows * room).max() < 1e-6
    assert (found.d >= of.low - 1e-7).all()
    assert (found.d <= of.high + 1e-7).all()
    other = quadratic.solve_by_clarabel(of)
    assert other.ending == "solved"
    assert value(of, found.d) == pytest.approx(value(of, other.d), abs=2e-6, rel=1e-6)


@pytest.mark.parametrize("seed", range(40))
def test_random_programs_agree_with_clarabel(seed: int) -> None:
    of = program(seed)
    found = solve_quadratic(of)
    assert found is not None
    assert_optimal(of, found)


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
        solve_quadratic(program(1))


def test_clarabel_is_hardly_ever_needed() -> None:
    endings = [solve_interior_point(program(seed)).ending for seed in range(60)]
    assert endings.count("solved") == 60


@pytest.mark.parametrize("seed", range(20))
def test_what_is_impossible_is_proven_so(seed: int) -> None:
    of = program(seed)
    # Somewhere, the opposite of a row by a share of what the box has room for.
    rng = np.random.default_rng(seed)
    row = int(rng.integers(len(of.A)))
    entries = of.A.dense()[row]
    if not entries.any():
        return
    against = BorderedRows(
        np.vstack([of.A.border, -of.A.border[row]]),
        np.append(of.A.column, of.A.column[row]),
        np.append(of.A.left, -of.A.left[row]),
        np.append(of.A.right, -of.A.right[row]),
        of.A.n_chain,
    )
    short = float(rng.uniform(1e-4, 0.3)) * np.abs(entries).sum()
    of = replace(of, A=against, b=np.append(of.b, -of.b[row] - short))
    assert quadratic.solve_by_clarabel(of).ending == "failed"
    found = solve_interior_point(of)
    assert found.ending == "infeasible"
    pull = of.A.transpose_times(found.rows)
    assert (found.rows >= 0.0).all()
    assert np.minimum(pull * of.low, pull * of.high).sum() > of.b @ found.rows
    assert solve_quadratic(of) is None


def test_programs_of_a_polish_agree_with_clarabel(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[QuadraticProgram] = []

    def recorded(of: QuadraticProgram) -> QuadraticAnswer:
        asked.append(of)
        return solve_interior_point(of)

    monkeypatch.setattr(quadratic, "solve_interior_point", recorded)
    solved(drive_method(), start(52.0), 4)
    assert len(asked) > 10
    for of in asked:
        found, other = solve_interior_point(of), quadratic.solve_by_clarabel(of)
        assert (found.ending == "solved") == (other.ending == "solved")
        if found.ending == "solved":
            assert found.satisfies_optimality(of)
            assert value(of, found.d) == pytest.approx(value(of, other.d), abs=1e-6, rel=1e-6)


def test_clarabel_answers_where_the_own_method_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    of = program(1)
    whole = solve_interior_point(of)
    cut_off = replace(whole, d=whole.d + 1e-3, ending="failed")
    monkeypatch.setattr(quadratic, "solve_interior_point", lambda *_: cut_off)
    found = solve_quadratic(of)
    assert found is not None
    np.testing.assert_allclose(found.d, whole.d, atol=1e-4)


def test_wrong_answers_are_not_believed() -> None:
    of = program(1)
    found = solve_interior_point(of)
    assert found.satisfies_optimality(of)
    for wrong in (
        replace(found, d=found.d + 1e-3),
        replace(found, rows=found.rows + 1e-3),
        replace(found, rows=found.rows - 1e-3),
        replace(found, bounds=found.bounds + 1e-2),
        replace(found, d=np.full(len(found.d), np.nan)),
    ):
        assert not wrong.satisfies_optimality(of)


@pytest.mark.parametrize("seed", range(5))
def test_a_convex_model_keeps_curvature_along_active_rows(seed: int) -> None:
    """Where the Lagrangian is definite on steps that keep active rows, the solution is its own."""
    rng = np.random.default_rng(seed)
    k, n, active = 4, 6, 5
    A, b = rows(rng, active, k, n), rng.normal(size=active)
    inside = matrix(rng, k, n)
    H = inside.plus(A.squares(np.full(active, -3.0)))
    g = rng.normal(size=k + n)
    model, shift = convexify(H, A, b)
    assert np.linalg.eigvalsh(model.dense())[0] > 0.0
    matrix_of_rows = A.dense()
    null = np.linalg.svd(matrix_of_rows)[2][np.linalg.matrix_rank(matrix_of_rows) :].T
    assert np.linalg.eigvalsh(null.T @ H.dense() @ null)[0] > 0.0
    anywhere = np.linalg.lstsq(matrix_of_rows, b, rcond=None)[0]

    def stationary(of: Array, slope: Array) -> Array:
        reduced = null.T @ of @ null
        step = np.linalg.solve(reduced, -null.T @ (slope + of @ anywhere))
        return np.asarray(anywhere + null @ step)

    if np.allclose(matrix_of_rows @ anywhere, b):
        np.testing.assert_allclose(
            stationary(model.dense(), g + shift), stationary(H.dense(), g), atol=1e-6
        )
