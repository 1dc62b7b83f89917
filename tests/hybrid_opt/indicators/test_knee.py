"""The knee against its definition, and what must not change it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.indicators.knee import knee
from symbolic.array import Array
from symbolic.errors import SettingsError


def distance_below_chord(points: Array) -> Array:
    """Signed distances by the cross product, in the front's own ranges."""
    low, high = points.min(axis=0), points.max(axis=0)
    scaled = (points - low) / (high - low)
    first, last = np.array([0.0, 1.0]), np.array([1.0, 0.0])
    along = (last - first) / np.linalg.norm(last - first)
    offset = scaled - first
    return np.asarray(along[1] * offset[:, 0] - along[0] * offset[:, 1])


def hyperbola(n: int) -> Array:
    x = np.linspace(0.1, 3.0, n)
    return np.column_stack([x, 1.0 / x])


def test_it_is_the_point_farthest_below_the_line_between_the_ends() -> None:
    points = hyperbola(60)
    assert knee(points) == int(np.argmax(distance_below_chord(points)))


@given(
    st.integers(3, 40),
    st.tuples(st.floats(0.01, 100.0), st.floats(0.01, 100.0)),
    st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0)),
)
def test_units_do_not_matter(
    n: int, scale: tuple[float, float], shift: tuple[float, float]
) -> None:
    points = hyperbola(n)
    best = distance_below_chord(points)
    moved = knee(points * np.array(scale) + np.array(shift))
    assert best[moved] == pytest.approx(best.max(), abs=1e-9)


def test_small_fronts() -> None:
    assert knee(np.array([[2.0, 5.0]])) == 0
    assert knee(np.array([[2.0, 5.0], [2.0, 4.0]])) == 1
    with pytest.raises(SettingsError, match="empty"):
        knee(np.zeros((0, 2)))
