"""Rows of the programs of timings within jerk limits: few coefficients each, none left out."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from hybrid_opt.timing.jerk_program import Point, Rows
from hybrid_opt.timing.path_motion import PathMotion
from symbolic.array import Array

K = 9


def spline_point() -> Point:
    """Places of a uniform cubic spline, its knots and both ends among them; no geometry."""
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, K - 2), np.ones(3)])
    spline, s = BSpline(knots, np.eye(K), 3), np.linspace(0.0, 1.0, 4 * (K - 3) + 1)
    basis = [spline(s), spline.derivative(1)(s), spline.derivative(2)(s)]
    jerk = np.random.default_rng(0).normal(size=(len(s), 3, 1)) * (basis[0] + basis[2])[:, None]
    return Point(
        s=s,
        value=basis[0],
        squared_by=basis[1],
        acceleration_by=basis[2],
        motion=cast("PathMotion", None),
        joint_jerk_by=jerk,
        box_jerk_by=jerk,
        keep=np.ones(len(s)),
    )


def spread(local: Array, first: NDArray[np.intp]) -> Array:
    """(..., n, K) rows from those of few columns."""
    found = np.zeros((*local.shape[:-1], K))
    for row, column in enumerate(first):
        found[row, ..., column : column + local.shape[-1]] = local[row]
    return found


def test_rows_are_those_of_full_matrices() -> None:
    at, rng = spline_point(), np.random.default_rng(1)
    rows, n = Rows(K), len(at.s)
    b, head = rng.uniform(0.5, 1.0, n), at.local(at.value)
    rows.below(at.local(at.squared_by), b, at.first_basis)
    rows.below(-np.ones((K, 1)), -np.full(K, 0.1), np.arange(K))
    rows.within(at.local(at.joint_jerk_by), np.ones((n, 3)), head, b, at.first_basis)
    program = rows.assembled()
    np.testing.assert_array_equal(program.A.toarray(), np.vstack([at.squared_by, -np.eye(K)]))
    np.testing.assert_array_equal(program.b, [*b, *[-0.1] * K])
    cones = np.concatenate([at.value[:, None], -at.joint_jerk_by], axis=1)
    np.testing.assert_array_equal(program.cone_A.toarray(), cones.reshape(-1, K))
    c = rng.uniform(0.0, 1.0, K)
    linear, cone = program.used(c, 0.5)
    np.testing.assert_array_equal(linear[:n], at.squared_by @ c > 0.5 * b)
    inside = np.linalg.norm(1.0 + at.joint_jerk_by @ c, axis=1)
    np.testing.assert_array_equal(cone, inside > 0.5 * (b - at.value @ c))
