"""Quadratic programs by their optimality conditions; convex models by what they must keep."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.polishing.drivable import quadratic


@pytest.mark.parametrize("seed", range(5))
def test_steps_satisfy_the_optimality_conditions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = 12, 20
    root = rng.normal(size=(n, n))
    H, g = root @ root.T + 0.1 * np.eye(n), rng.normal(size=n)
    A, b = rng.normal(size=(m, n)), rng.random(m)
    low, high = np.full(n, -0.3), np.full(n, 0.4)
    low[0] = high[0] = 0.05
    step = quadratic.solve(H, g, A, b, low, high)
    assert step.solved
    assert step.d[0] == 0.05
    assert (A @ step.d <= b + 1e-7).all()
    assert (step.d >= low - 1e-7).all()
    assert (step.d <= high + 1e-7).all()
    assert (step.rows >= -1e-9).all()
    slope = H @ step.d + g + A.T @ step.rows + step.bounds
    assert np.abs(slope[1:]).max() < 1e-6
    assert np.abs(step.rows * (b - A @ step.d)).max() < 1e-6


def test_impossible_rows_are_told() -> None:
    A, b = np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0])
    step = quadratic.solve(np.eye(1), np.zeros(1), A, b, np.full(1, -9.0), np.full(1, 9.0))
    assert not step.solved


@pytest.mark.parametrize("seed", range(5))
def test_a_convex_model_keeps_curvature_along_active_rows(seed: int) -> None:
    """Where the Lagrangian is definite on steps that keep active rows, the solution is its own."""
    rng = np.random.default_rng(seed)
    n, n_path, active = 9, 4, 3
    A, b = rng.normal(size=(active, n)), rng.normal(size=active)
    null = np.linalg.svd(A)[2][active:].T
    root = rng.normal(size=(n - active, n - active))
    inside = null @ (root @ root.T + np.eye(n - active)) @ null.T
    H = inside - 5.0 * A.T @ A / np.linalg.norm(A, 2) ** 2
    g = rng.normal(size=n)
    model, shift = quadratic.convex(H, A, b, n_path)
    assert np.linalg.eigvalsh(model)[0] > 0.0

    def stationary(matrix: np.ndarray, slope: np.ndarray) -> np.ndarray:
        kkt = np.block([[matrix, A.T], [A, np.zeros((active, active))]])
        return np.asarray(np.linalg.solve(kkt, np.concatenate([-slope, b])))

    np.testing.assert_allclose(stationary(model, g + shift), stationary(H, g), atol=1e-6)
