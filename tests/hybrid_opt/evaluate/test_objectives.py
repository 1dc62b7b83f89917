"""The non-dominated points of a set."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hybrid_opt.evaluate.objectives import front_of, non_dominated
from symbolic.array import Array

points = st.integers(1, 12).flatmap(
    lambda n: arrays(np.float64, (n, 2), elements=st.floats(0.0, 1.25, width=32))
)


def dominates(a: Array, b: Array) -> bool:
    return bool((a <= b).all() and (a < b).any())


@given(points)
def test_non_dominated_is_the_definition(front: Array) -> None:
    feasible = front[:, 0] < 1.0
    mask = non_dominated(front, feasible)
    for index, point in enumerate(front):
        beaten = any(dominates(q, point) for q in front[feasible])
        repeated = any((q == point).all() for q in front[:index][feasible[:index]])
        assert mask[index] == (feasible[index] and not beaten and not repeated)


def test_non_dominated_refuses_what_is_not_finite() -> None:
    values = [[np.nan, 0.0], [-np.inf, 0.0], [1.0, 1.0], [np.inf, -1.0]]
    np.testing.assert_array_equal(non_dominated(values), [False, False, True, False])
    np.testing.assert_array_equal(front_of(values), [[1.0, 1.0]])
    assert len(front_of([[np.nan, 1.0]])) == 0
