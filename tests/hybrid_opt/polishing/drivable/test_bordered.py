"""Matrices of a border and a chain against dense ones."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.polishing.drivable.bordered import BorderedMatrix, BorderedRows, Factors


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


@pytest.mark.parametrize(("k", "n"), [(1, 2), (18, 99), (5, 7)])
def test_products_and_factors_are_those_of_the_dense_matrix(k: int, n: int) -> None:
    rng = np.random.default_rng(k)
    M, A = matrix(rng, k, n), rows(rng, 4 * n, k, n)
    d, y, raised = rng.normal(size=k + n), rng.random(4 * n), rng.random(k + n)
    np.testing.assert_allclose(M.times(d), M.dense() @ d, atol=1e-11)
    np.testing.assert_allclose(A.times(d), A.dense() @ d, atol=1e-12)
    np.testing.assert_allclose(A.pulled(y), A.dense().T @ y, atol=1e-12)
    total = M.plus(A.squares(y), 0.5).raised(raised)
    wanted = M.dense() + 0.5 * A.dense().T @ np.diag(y) @ A.dense() + np.diag(raised)
    np.testing.assert_allclose(total.dense(), wanted, atol=1e-10)
    assert total.largest == pytest.approx(np.abs(wanted).max())
    factors = Factors(total)
    assert factors.ok
    np.testing.assert_allclose(factors.solve(d), np.linalg.solve(wanted, d), atol=1e-10)


def test_indefinite_matrices_are_told() -> None:
    rng = np.random.default_rng(0)
    M = matrix(rng, 3, 5)
    lowest = np.linalg.eigvalsh(M.dense())[0]
    for entry in (0, 6):
        down = np.zeros(8)
        down[entry] = -50.0
        assert np.linalg.eigvalsh(M.raised(down).dense())[0] < 0.0 < lowest
        assert not Factors(M.raised(down)).ok
