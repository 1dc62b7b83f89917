"""Which rows keep the payload from an obstacle: at kinks, by direction in between."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.polishing.constraints.distances import Gaps, edges, passing, separation
from hybrid_opt.polishing.rows import PlaceRow
from symbolic.smooth.passage import Passing, Separation

PLACES, LOW = 120, 0.06


def v_shape(kink: float, height: float, slope: float = 3e-3) -> Gaps:
    """Two gaps that cross at a place: one falls, the other rises."""
    away = np.arange(PLACES) - kink
    return Gaps.of(np.column_stack([height - slope * away, height + slope * away]))


@given(kink=st.floats(20.0, 100.0), height=st.floats(-0.02, LOW - 0.01))
def test_where_an_edge_is_passed_there_is_one_kink(kink: float, height: float) -> None:
    gaps = v_shape(kink, height)
    ((before, place),) = edges(gaps, LOW)
    assert abs(place - kink) <= 1.0
    assert before <= kink <= before + 1
    row = passing(7, gaps, before, place)
    assert row == PlaceRow(Passing(7, 0, 1), place)


def test_a_separation_is_of_the_largest_gap() -> None:
    gaps = v_shape(50.4, 0.01)
    assert separation(3, gaps, 20) == PlaceRow(Separation(3, 0), 20)
    assert separation(3, gaps, 80) == PlaceRow(Separation(3, 1), 80)
