"""Places along the path: lowest stretches, dips between places, and widths in the parameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.polishing.grid import PLACE_SPACING, Grid, dipped, lowest
from tests.symbolic.cells import hand_cell


@given(st.integers(1, 40), st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60))
def test_strided_places_are_below_the_limit_and_hold_the_lowest(
    stride: int, values: list[float]
) -> None:
    array = np.array(values)
    least, strided = lowest(array, 0.0), lowest(array, 0.0, stride)
    assert np.all(array[strided] < 0.0)
    assert set(least) <= set(strided)
    assert bool(least) == bool((array < 0.0).any())
    if least:
        assert array[least].min() == array.min()


def test_the_dip_between_two_places_is_that_of_the_lines_from_both_sides() -> None:
    height = 0.001 + 3e-3 * np.abs(np.arange(120) - 50.4)
    low = dipped(height[:, None])[:, 0]
    np.testing.assert_allclose(low[50:52], 0.001, atol=1e-12)
    # Next to the kink the estimate errs to the safe side.
    assert np.all(low <= height)
    np.testing.assert_array_equal(low[:49], height[:49])
    np.testing.assert_array_equal(low[53:], height[53:])


@pytest.mark.parametrize("samples", [20, 50, 100, 200, 400])
def test_widths_do_not_depend_on_the_number_of_samples(samples: int) -> None:
    cell = hand_cell()
    grid = Grid(replace(cell.task, samples=samples))
    spacing = grid.parameter[1]
    assert spacing == pytest.approx(PLACE_SPACING, rel=0.35)
    for width in (0.015, 0.04, 0.08):
        assert grid.places(width) * spacing == pytest.approx(width, abs=spacing)
    np.testing.assert_allclose(grid.parameter[:: grid.per_sample], grid.sample_parameter)


def test_rates_are_derivatives_of_positions() -> None:
    grid = Grid(hand_cell().task)
    slope = np.gradient(grid.basis, grid.parameter, axis=0)
    np.testing.assert_allclose(slope[1:-1], grid.rate_basis[1:-1], atol=1e-2)
