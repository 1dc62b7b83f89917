"""Quadratic programs by their conditions and Clarabel; convex models by what they keep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.polishing.drivable import quadratic
from hybrid_opt.polishing.drivable.bordered import BorderedMatrix, BorderedRows
from hybrid_opt.polishing.drivable.compiled_interior import Method, interior_method
from hybrid_opt.polishing.drivable.interior import Answer, QuadraticProgram
from hybrid_opt.polishing.drivable.interior import solve as solve_inside
from hybrid_opt.polishing.drivable.point import DriveStart
from hybrid_opt.polishing.drivable.timed import Goal
from symbolic.array import Array
from tests.hybrid_opt.polishing.drivable.cells import polisher, start
from tests.hybrid_opt.polishing.drivable.test_bordered import matrix, rows

TOLERANCE = 1e-8


def program(seed: int) -> QuadraticProgram:
    """Of random size; some barely convex, with repeated rows, redundant ones, or a whole one."""
    rng = np.random.default_rng(seed)
    k, n = int(rng.integers(1, 20)), int(rng.integers(2, 100))
    m = int(rng.integers(1, 6 * n))
    H, A = matrix(rng, k, n), rows(rng, m, k, n)
    if seed % 3 == 0:  # no curvature but that of the border
        H = BorderedMatrix(H.corner, 0.0 * H.beside, 0.0 * H.diagonal, 0.0 * H.off)
    if seed % 4 == 0:
        twice = np.concatenate([np.arange(m), rng.integers(0, m, m)])
        A = A.of(twice)
    inside = 0.3 * rng.uniform(-1.0, 1.0, k + n)
    b = A.times(inside) + rng.exponential(0.2, len(A)) * (rng.random(len(A)) > 0.2)
    whole = rng.random(k + n) if seed % 5 == 0 else None
    most = 0.0 if whole is None else float(whole @ inside)
    low, high = np.full(k + n, -0.3), np.full(k + n, 0.4)
    return QuadraticProgram(H, rng.normal(size=k + n), A, b, low, high, whole, most)


def value(of: QuadraticProgram, d: Array) -> float:
    return float(d @ of.H.dense() @ d / 2.0 + of.g @ d)


def assert_optimal(of: QuadraticProgram, found: Answer | quadratic.Step) -> None:
    """By its own conditions, and no worse than Clarabel's answer."""
    slope = of.H.dense() @ found.d + of.g + of.pulled(found.rows) + found.bounds
    room = of.right - of.times(found.d)
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
    found = quadratic.solve(of)
    assert found.solved
    assert_optimal(of, found)


def test_clarabel_is_hardly_ever_needed() -> None:
    """But where a whole row's speeds have no curvature of their own, as none of a polish do."""
    tried = [seed for seed in range(60) if seed % 15]
    endings = [solve_inside(program(seed), TOLERANCE).ending for seed in tried]
    assert endings.count("solved") == len(tried)


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
    assert interior_method()(of, TOLERANCE).ending == "infeasible"
    found = solve_inside(of, TOLERANCE)
    assert found.ending == "infeasible"
    pull = of.pulled(found.rows)
    assert (found.rows >= 0.0).all()
    assert np.minimum(pull * of.low, pull * of.high).sum() > of.right @ found.rows
    assert not quadratic.solve(of).solved


def test_programs_of_a_polish_agree_with_clarabel(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[QuadraticProgram] = []
    own = quadratic.solve

    def recorded(of: QuadraticProgram, method: Method) -> quadratic.Step:
        asked.append(of)
        return own(of, method)

    monkeypatch.setattr(quadratic, "solve", recorded)
    solver = polisher(4).drivable
    solver.solve(DriveStart(start(52.0), Goal("duration", 52.0), 0.3))
    solver.solve(DriveStart(start(52.0), Goal("force", 3.0), 0.3))
    assert len(asked) > 15
    assert any(of.whole is not None for of in asked)
    compiled = interior_method()
    for of in asked:
        other = quadratic.solve_by_clarabel(of)
        for found in (solve_inside(of, TOLERANCE), compiled(of, TOLERANCE)):
            assert (found.ending == "solved") == (other.ending == "solved")
            if found.ending == "solved":
                assert quadratic.holds(of, found)
                assert value(of, found.d) == pytest.approx(value(of, other.d), abs=1e-6, rel=1e-6)


def test_compiled_and_interpreted_answers_agree() -> None:
    """But where a whole row's speeds have no curvature of their own: rounding decides there."""
    compiled = interior_method()
    assert compiled is not solve_inside
    for seed in (seed for seed in range(90) if seed % 15):
        of = program(seed)
        inner, outer = solve_inside(of, TOLERANCE), compiled(of, TOLERANCE)
        assert outer.ending == inner.ending
        np.testing.assert_allclose(outer.d, inner.d, atol=1e-6)
        assert value(of, outer.d) == pytest.approx(value(of, inner.d), abs=1e-8, rel=1e-8)


def test_clarabel_answers_where_the_own_method_does_not() -> None:
    of = program(1)
    whole = solve_inside(of, TOLERANCE)
    cut_off = replace(whole, d=whole.d + 1e-3, ending="failed")
    found = quadratic.solve(of, lambda *_: cut_off)
    assert found.solved
    np.testing.assert_allclose(found.d, whole.d, atol=1e-4)


def test_wrong_answers_are_not_believed() -> None:
    of = program(1)
    found = solve_inside(of, TOLERANCE)
    assert quadratic.holds(of, found)
    for wrong in (
        replace(found, d=found.d + 1e-3),
        replace(found, rows=found.rows + 1e-3),
        replace(found, rows=found.rows - 1e-3),
        replace(found, bounds=found.bounds + 1e-2),
        replace(found, d=np.full(len(found.d), np.nan)),
    ):
        assert not quadratic.holds(of, wrong)


@pytest.mark.parametrize("seed", range(5))
def test_a_convex_model_keeps_curvature_along_active_rows(seed: int) -> None:
    """Where the Lagrangian is definite on steps that keep active rows, the solution is its own."""
    rng = np.random.default_rng(seed)
    k, n, active = 4, 6, 5
    A, b = rows(rng, active, k, n), rng.normal(size=active)
    inside = matrix(rng, k, n)
    H = inside.plus(A.squares(np.full(active, -3.0)))
    g = rng.normal(size=k + n)
    model, shift = quadratic.convex(H, A, b)
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
