"""A candidate on points as if all had been measured, and what programs of a cell share."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybrid_opt.polishing.cell import (
    POINT_SPACING,
    CarryReader,
    Distances,
    Grid,
    interpolate_minima,
    local_minima_below,
)
from hybrid_opt.polishing.constraints.kinds import RowSelector
from symbolic.array import Array
from symbolic.records.task import initial_decision
from tests.hybrid_opt.polishing.cells import smooth_cell
from tests.hybrid_opt.polishing.test_force_front import evaluator
from tests.symbolic.cells import hand_cell

PLACES, PAIRS, LIMIT = 60, 4, 0.02


@dataclass
class DistanceOracle:
    """Bounds and the distances that a judge finds, and how many it was asked for."""

    seed: int
    bounds: Array = field(init=False)
    truth: Array = field(init=False)
    asked: int = 0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        wave = np.sin(np.linspace(0.0, 9.0, PLACES))[:, None] * rng.uniform(0.0, 0.03, PAIRS)
        self.bounds = 0.02 + wave + rng.uniform(-2e-3, 2e-3, (PLACES, PAIRS))
        self.truth = self.bounds + rng.uniform(0.0, 0.01, (PLACES, PAIRS))

    def measure(self, rows: NDArray[np.intp], raised: Array, wanted: NDArray[np.bool_]) -> None:
        self.asked += int(wanted.sum())
        raised[wanted] = self.truth[rows][wanted]

    def distances(self) -> Distances:
        return Distances(self.bounds, self.measure, [np.arange(PLACES)])


@given(seed=st.integers(0, 1000))
def test_the_least_of_a_stretch_is_that_of_all_its_distances(seed: int) -> None:
    judge, lazy = DistanceOracle(seed), DistanceOracle(seed)
    rng = np.random.default_rng(seed)
    drawn = rng.integers(0, (PLACES - 9, PAIRS), (6, 2)).tolist()
    stretches = [(slice(first, first + 9), pair) for first, pair in drawn]
    low = np.zeros((PLACES, PAIRS), dtype=np.bool_)
    for where in stretches:
        low[where] = judge.bounds[where] < LIMIT
    raised = np.where(low, judge.truth - judge.bounds, 0.0)
    every = judge.distances().interpolated_clearance + raised
    assert lazy.distances().least(stretches, LIMIT) == [every[where].min() for where in stretches]
    assert lazy.asked <= low.sum()


@given(seed=st.integers(0, 1000), limit=st.floats(-0.02, 0.03))
def test_limits_are_kept_as_all_distances_say(seed: int, limit: float) -> None:
    judge, lazy = DistanceOracle(seed), DistanceOracle(seed)
    limits = np.full(PAIRS, limit)
    close = judge.distances().closer_than(limits)
    kept = all((own >= limit).all() for own in close.values())
    assert lazy.distances().exceed(limits) == kept
    assert lazy.asked <= judge.asked


@pytest.mark.parametrize("spread", [0.01, 0.05, 0.2])
def test_a_step_violates_something_where_violated_rows_say_so(spread: float) -> None:
    cell = smooth_cell(evaluator())
    task, active, reader = cell.task, RowSelector(cell), CarryReader(cell)
    known, rng = reader.read(initial_decision(task)), np.random.default_rng(7)
    verdicts = set()
    for _ in range(12):
        away = rng.uniform(-spread, spread, task.n_var) * (task.upper - task.lower)
        x = np.clip(initial_decision(task) + away, task.lower, task.upper)
        step = reader.read(x)
        if step.is_reachable:
            violates = active.has_violation(step, known, ())
            assert violates == bool(active.violated_rows(reader.read(x), known, ()))
            verdicts.add(violates)
    assert verdicts


@given(st.integers(1, 40), st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60))
def test_strided_points_are_below_the_limit_and_hold_the_lowest(
    stride: int, values: list[float]
) -> None:
    array = np.array(values)
    least, strided = local_minima_below(array, 0.0), local_minima_below(array, 0.0, stride)
    assert np.all(array[strided] < 0.0)
    assert set(least) <= set(strided)
    assert bool(least) == bool((array < 0.0).any())
    if least:
        assert array[least].min() == array.min()


def test_the_dip_between_two_points_is_that_of_the_lines_from_both_sides() -> None:
    height = 0.001 + 3e-3 * np.abs(np.arange(120) - 50.4)
    low = interpolate_minima(height[:, None])[:, 0]
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
    numbers = np.arange(1, 50)
    nearest = numbers[np.argmin(np.abs(numbers * (samples - 1) - 1.0 / POINT_SPACING))]
    assert grid.per_sample == nearest
    for width in (0.015, 0.04, 0.08):
        assert grid.points(width) * spacing == pytest.approx(width, abs=spacing)
    np.testing.assert_allclose(grid.parameter[:: grid.per_sample], grid.sample_parameter)
