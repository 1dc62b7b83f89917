"""The knee against its definition, and what must not change it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.indicators.knee import knee
from symbolic.array import Array
from symbolic.errors import SettingsError


def front(n: int, still: float = 49.0) -> Array:
    """Durations and forces: nearer to the force at rest a carry takes ever longer."""
    force = still * (1.0 + np.linspace(0.004, 0.5, n))
    return np.column_stack([2.0 + np.sqrt(0.05 * still / (force - still)), force])


def test_beside_it_a_per_cent_buys_no_more_than_a_per_cent() -> None:
    points = np.log(front(400))
    at = knee(front(400))
    assert 0 < at < len(points) - 1
    duration, force = (points - points[at]).T
    assert (duration + force >= 0.0).all()
    # It is where the slope in logarithms passes through one.
    slopes = -np.diff(points[:, 0]) / np.diff(points[:, 1])
    assert slopes[at - 1] >= 1.0 >= slopes[at]


@given(st.integers(3, 40), st.tuples(st.floats(0.01, 100.0), st.floats(0.01, 100.0)))
def test_units_do_not_matter(n: int, scale: tuple[float, float]) -> None:
    points = front(n)
    product = points.prod(axis=1)
    found = knee(points * np.array(scale))
    assert product[found] == pytest.approx(product.min(), rel=1e-12)


@given(st.integers(10, 60), st.integers(0, 3), st.integers(0, 3))
def test_how_far_the_ends_were_explored_does_not_matter(n: int, low: int, high: int) -> None:
    points = front(n)
    at = knee(points)
    low, high = min(low, at), min(high, n - 1 - at)
    assert knee(points[low : n - high]) == at - low


def test_small_fronts() -> None:
    assert knee(np.array([[2.0, 5.0]])) == 0
    assert knee(np.array([[2.0, 5.0], [2.0, 4.0]])) == 1
    with pytest.raises(SettingsError, match="empty"):
        knee(np.zeros((0, 2)))
    with pytest.raises(SettingsError, match="above zero"):
        knee(np.array([[1.0, 0.0]]))
