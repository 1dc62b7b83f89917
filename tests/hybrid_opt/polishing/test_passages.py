"""Which rows keep the payload from an obstacle: by direction, at kinks, and in between."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.polishing.passages import (
    BESIDE_KINK,
    KINK_ACTIVITY,
    dipped,
    lowest,
    passage_rows,
    separation_row,
)
from symbolic.array import Array

PLACES = 120


def v_shape(kink: float, height: float, slope: float = 3e-3) -> Array:
    """(PLACES, 2) gaps that cross at a place: one falls, the other rises."""
    away = np.arange(PLACES) - kink
    return np.column_stack([height - slope * away, height + slope * away])


@given(
    kink=st.floats(20.0, 100.0),
    height=st.floats(-0.02, KINK_ACTIVITY - 0.01),
)
def test_where_an_edge_is_passed_the_kink_gets_the_only_row_nearby(
    kink: float, height: float
) -> None:
    rows = passage_rows(7, v_shape(kink, height))
    passing = [(kind, place) for kind, place in rows if kind.kind == "passing"]
    assert len(passing) == 1
    kind, place = passing[0]
    assert (kind.index, kind.direction, kind.after) == (7, 0, 1)
    assert abs(place - kink) <= 1.0
    others = [(kind, place) for kind, place in rows if kind.kind == "separation"]
    assert len(others) == len(rows) - 1
    for kind, place in others:
        assert abs(place - kink) >= BESIDE_KINK - 1
        assert kind.direction == int(place > kink)


def test_an_obstacle_that_stays_away_gets_no_rows() -> None:
    assert passage_rows(0, np.full((PLACES, 3), 0.2)) == []
    assert passage_rows(0, v_shape(50.0, 0.2)) == []


def test_a_change_of_direction_that_is_no_dip_is_no_kink() -> None:
    away = np.arange(PLACES) - 60.0
    both_rise = np.column_stack([0.02 + 1e-4 * away, 0.02 + 2e-4 * away])
    assert all(kind.kind == "separation" for kind, _ in passage_rows(0, both_rise))


def test_a_smooth_minimum_gets_a_row_of_its_direction() -> None:
    away = np.arange(PLACES) - 60.0
    gaps = np.column_stack([np.full(PLACES, -0.1), 0.01 + 1e-5 * away**2])
    rows = passage_rows(3, gaps)
    assert separation_row(3, gaps, 60) in rows
    assert {kind.direction for kind, _ in rows} == {1}


@given(st.integers(1, 40), st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60))
def test_strided_places_are_below_the_limit_and_hold_the_lowest(
    stride: int, values: list[float]
) -> None:
    array = np.array(values)
    least, strided = lowest(array, 0.0, None), lowest(array, 0.0, stride)
    assert np.all(array[strided] < 0.0)
    assert set(least) <= set(strided)
    assert bool(least) == bool((array < 0.0).any())
    if least:
        assert array[least].min() == array.min()


def test_the_dip_between_two_places_is_that_of_the_lines_from_both_sides() -> None:
    height = v_shape(50.4, 0.001).max(axis=1)
    low = dipped(height[:, None])[:, 0]
    np.testing.assert_allclose(low[50:52], 0.001, atol=1e-12)
    # Next to the kink the estimate errs to the safe side.
    assert np.all(low <= height)
    np.testing.assert_array_equal(low[:49], height[:49])
    np.testing.assert_array_equal(low[53:], height[53:])
