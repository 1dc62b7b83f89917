"""Eliminated unknowns against dense solves."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from symbolic.contact.patches import Elimination


@pytest.mark.parametrize("k", [1, 3, 5])
def test_agrees_with_a_dense_solve(k: int) -> None:
    rng = np.random.default_rng(k)
    root, right = rng.normal(size=(5, 5)), rng.normal(size=5)
    matrix = root @ root.T + np.eye(5)
    symbols, side = ca.SX.sym("A", 5, 5), ca.SX.sym("b", 5)
    elimination = Elimination([[symbols[i, j] for j in range(5)] for i in range(5)], k)
    reduced = elimination.reduced(ca.vertsplit(side))
    expected = np.linalg.solve(matrix, right)
    first = elimination.first(reduced, [ca.SX(float(x)) for x in expected[k:]])
    left = [ca.horzcat(*row) for row in elimination.left]
    found = ca.Function(
        "found", [symbols, side], [ca.vertcat(*first), ca.vertcat(*left), ca.vertcat(*reduced[k:])]
    )(matrix, right)
    np.testing.assert_allclose(np.array(found[0]).ravel(), expected[:k], rtol=1e-9)
    if k < 5:
        schur, rest = np.array(found[1]), np.array(found[2]).ravel()
        np.testing.assert_allclose(np.linalg.solve(schur, rest), expected[k:], rtol=1e-9)
