"""Fronts and what is said of them: indicators, and statistics over replicas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import PermutationMethod, mannwhitneyu

from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.metrics import binding_bounds
from hybrid_opt.indicators.statistics import (
    attainment_surfaces,
    corrected,
    holm,
    magnitude_of,
    rank_test,
    summarise,
)
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import Waypoint
from symbolic.records.task import variable_names
from tests.refusals import refused
from tests.symbolic.read.samples import RACK

points = st.integers(1, 12).flatmap(
    lambda n: arrays(np.float64, (n, 2), elements=st.floats(0.0, 1.25, width=32))
)


def test_hypervolume_by_hand() -> None:
    # Two rectangles: 0.9 x 0.3 below (0.2, 0.8) and 0.5 x 0.6 more down to (0.6, 0.2).
    assert metrics.hypervolume([[0.2, 0.8], [0.6, 0.2]]) == pytest.approx(0.27 + 0.30)
    assert metrics.hypervolume([[0.0, 0.0]]) == pytest.approx(1.21)
    assert metrics.hypervolume([[1.1, 0.0], [2.0, -5.0]]) == 0.0
    assert metrics.hypervolume(np.empty((0, 2))) == 0.0
    assert metrics.hypervolume([[1.0, 2.0, 3.0]], (2.0, 4.0, 6.0)) == pytest.approx(6.0)


@given(points, arrays(np.float64, 2, elements=st.floats(0.0, 1.25, width=32)))
def test_hypervolume_grows_by_points_not_dominated_only(front: Array, extra: Array) -> None:
    before = metrics.hypervolume(front)
    after = metrics.hypervolume(np.vstack([front, extra]))
    assert after >= before - 1e-12
    if any((p <= extra).all() for p in front):
        assert after == pytest.approx(before, abs=1e-12)


def test_igd_is_the_mean_euclidean_distance() -> None:
    reference = [[0.0, 0.0], [3.0, 4.0], [0.0, 2.0]]
    # Distances to (0, 0): 0, 5, 2.
    assert metrics.igd([[0.0, 0.0]], reference) == pytest.approx(7.0 / 3.0)
    # Only excess counts: (3, 4) and (0, 2) are dominated by (0, 0).
    assert metrics.igd_plus([[0.0, 0.0]], reference) == 0.0
    # From (1, 3): to (0, 0) sqrt(10), to (3, 4) nothing, to (0, 2) sqrt(2).
    expected = (math.sqrt(10.0) + math.sqrt(2.0)) / 3.0
    assert metrics.igd_plus([[1.0, 3.0]], reference) == pytest.approx(expected)
    assert metrics.igd(np.empty((0, 2)), reference) == math.inf
    assert metrics.igd_plus(np.empty((0, 2)), reference) == math.inf


@given(points, points)
def test_igd_against_its_formula(front: Array, reference: Array) -> None:
    difference = front[None] - reference[:, None]
    distance = np.linalg.norm(difference, axis=2).min(axis=1).mean()
    excess = np.linalg.norm(np.maximum(difference, 0.0), axis=2).min(axis=1).mean()
    assert metrics.igd(front, reference) == pytest.approx(distance, abs=1e-12)
    assert metrics.igd_plus(front, reference) == pytest.approx(excess, abs=1e-12)


def test_spacing_by_hand() -> None:
    # L1 distances to the nearest neighbour: 2, 2, 4; mean 8/3; squares 4/9 + 4/9 + 16/9; n - 1.
    front = [[0.0, 4.0], [1.0, 3.0], [3.0, 1.0]]
    assert metrics.spacing(front) == pytest.approx(math.sqrt(24.0 / 9.0 / 2.0))
    assert metrics.spacing([[0.0, 2.0], [1.0, 1.0], [2.0, 0.0]]) == 0.0


@pytest.mark.parametrize("count", [0, 1, 2])
def test_spacing_needs_three_points(count: int) -> None:
    assert math.isnan(metrics.spacing(np.zeros((count, 2))))


def test_feasible_figures() -> None:
    assert metrics.feasible_count([True, False, True]) == 2
    assert metrics.feasible_share([True, False, True, False]) == 0.5
    assert math.isnan(metrics.feasible_share([]))


def test_best_so_far() -> None:
    objectives = [[1.0, 1.0], [5.0, 9.0], [7.0, 3.0], [4.0, np.nan], [6.0, 6.0]]
    history = metrics.best_so_far(objectives, [False, True, True, True, True])
    nan = np.nan
    np.testing.assert_array_equal(history, [[nan, nan], [5, 9], [5, 3], [5, 3], [5, 3]])


def test_excess_above_static() -> None:
    np.testing.assert_allclose(
        metrics.excess_above_static([[0.55, 0.5], [0.5, 0.75]], [0.5, 0.5]), [[10, 0], [0, 50]]
    )


TASK = load(RACK).task
MIDDLE = (TASK.lower + TASK.upper) / 2.0


def test_variables_have_the_names_of_their_waypoints() -> None:
    names = variable_names(TASK)
    assert len(names) == TASK.n_var
    assert names[0] == "waypoint 1, x"
    assert names[-1] == "waypoint 3, yaw"
    assert variable_names(replace(TASK, time_law="optimal"))[-1] == "force limit"


def test_only_bounds_that_are_touched_are_told_with_how_many() -> None:
    x = np.tile(MIDDLE, (5, 1))
    assert binding_bounds(TASK, x) == ()
    x[0, 7] = TASK.lower[7]
    x[1:3, 17] = TASK.upper[17] - 5e-4 * (TASK.upper[17] - TASK.lower[17])
    x[4, 17] = TASK.upper[17] - 5e-3 * (TASK.upper[17] - TASK.lower[17])
    found = binding_bounds(TASK, x)
    assert [(b.variable, b.side, b.solutions) for b in found] == [
        ("waypoint 2, y", "lower", 1),
        ("waypoint 3, yaw", "upper", 2),
    ]
    assert found[0].value == TASK.lower[7]


def test_what_has_no_range_does_not_bind() -> None:
    waypoint = TASK.waypoints[1]
    upper = waypoint.upper.copy()
    upper[0] = waypoint.lower[0]
    waypoints = (TASK.waypoints[0], Waypoint(waypoint.lower, upper), *TASK.waypoints[2:])
    task = replace(TASK, waypoints=waypoints)
    assert binding_bounds(task, (task.lower + task.upper) / 2.0) == ()
    optimal = replace(TASK, time_law="optimal", force_limit=(50.0, 100.0))
    assert binding_bounds(optimal, np.append(MIDDLE, 50.0)) == ()


samples = st.lists(st.integers(0, 6).map(float), min_size=1, max_size=7)


def test_summary_by_hand() -> None:
    summary = summarise([4.0, 1.0, np.nan, 3.0, 2.0, np.inf])
    assert (summary.count, summary.missing) == (4, 2)
    assert summary.mean == 2.5
    assert summary.std == pytest.approx(math.sqrt(5.0 / 3.0))
    assert (summary.minimum, summary.median, summary.maximum) == (1.0, 2.5, 4.0)
    assert (summary.quartile1, summary.quartile3) == (1.75, 3.25)


def test_summary_of_little() -> None:
    one = summarise([2.0])
    assert one.mean == one.median == 2.0
    assert math.isnan(one.std)
    nothing = summarise([np.nan])
    assert (nothing.count, nothing.missing) == (0, 1)
    assert math.isnan(nothing.mean)
    assert math.isnan(nothing.maximum)


def separated(u: int) -> tuple[list[float], list[float]]:
    """Ten against ten values without ties whose U of the first is `u`."""
    second = [float(k) for k in range(10)]
    first = []
    for k in range(10):
        above = min(u, 10)
        u -= above
        first.append(above - 0.5 + k * 1e-3)
    return first, second


@pytest.mark.parametrize(("u", "level", "significant"), [(77, 0.05, 1), (76, 0.05, 0)])
def test_ten_against_ten_at_five_percent(u: int, level: float, significant: int) -> None:
    test = rank_test(*separated(u))
    assert test.a12 == pytest.approx(u / 100)
    assert (test.p < level) == bool(significant)


@given(samples.filter(lambda x: len(x) > 1), samples.filter(lambda x: len(x) > 1))
def test_exact_p_with_ties_is_that_of_all_permutations(x: list[float], y: list[float]) -> None:
    test = rank_test(x, y)
    oracle = mannwhitneyu(x, y, method=PermutationMethod(n_resamples=5000))
    assert test.u == oracle.statistic
    assert test.p == pytest.approx(oracle.pvalue, rel=1e-9)


@given(samples, samples)
def test_a12_is_its_definition(x: list[float], y: list[float]) -> None:
    wins = sum((a > b) + 0.5 * (a == b) for a in x for b in y)
    assert rank_test(x, y).a12 == pytest.approx(wins / (len(x) * len(y)))
    assert rank_test(x, y).a12 + rank_test(y, x).a12 == pytest.approx(1.0)
    assert rank_test(x, y).p == pytest.approx(rank_test(y, x).p)


def test_infinite_values_rank_and_nan_do_not() -> None:
    test = rank_test([1.0, np.inf, np.nan], [0.0, 2.0])
    assert (test.count_first, test.count_second) == (2, 2)
    assert test.a12 == 0.75
    assert math.isnan(rank_test([np.nan], [1.0]).p)


@pytest.mark.parametrize(
    ("a12", "word"),
    [(0.5, "negligible"), (0.56, "small"), (0.36, "medium"), (0.71, "large"), (0.0, "large")],
)
def test_magnitudes(a12: float, word: str) -> None:
    assert magnitude_of(a12) == word


def test_holm_by_hand() -> None:
    # Sorted .01 .02 .03 .04 times 4 3 2 1: .04 .06 .06 .06, made monotone.
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx((0.06, 0.04, 0.06, 0.06))
    assert holm([0.9, 0.8]) == (1.0, 1.0)
    adjusted = holm([0.01, math.nan, 0.02])
    assert adjusted[0] == 0.02
    assert math.isnan(adjusted[1])


def test_a_family_is_corrected_together() -> None:
    tests = [rank_test(*separated(u)) for u in (100, 77)]
    family = corrected(tests)
    assert family[0].p_holm == pytest.approx(2.0 * tests[0].p)
    assert family[1].p_holm == pytest.approx(tests[1].p)
    assert family[0].p == tests[0].p


@given(
    st.lists(
        st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=0, max_size=5),
        min_size=1,
        max_size=6,
    ),
    st.tuples(st.integers(0, 9), st.integers(0, 9)),
    st.sampled_from([10.0, 25.0, 50.0, 75.0, 100.0]),
)
def test_attainment_is_its_definition(
    fronts: list[list[tuple[int, int]]], goal: tuple[int, int], percentile: float
) -> None:
    sets = [np.array(front, dtype=float).reshape(-1, 2) for front in fronts]
    points = attainment_surfaces(sets, [percentile])[percentile]
    reached = sum(bool((front <= goal).all(axis=1).any()) for front in sets)
    on_surface = bool((points <= goal).all(axis=1).any())
    assert on_surface == (100.0 * reached >= percentile * len(sets) - 1e-9)


@pytest.mark.parametrize(
    ("fronts", "percentiles"),
    [([], [50.0]), ([np.zeros((1, 2))], [0.0]), ([np.zeros((1, 2))], [101.0])],
)
def test_attainment_needs_fronts_and_percentiles(fronts: list[object], percentiles: object) -> None:
    with refused(SettingsError, "percentiles"):
        attainment_surfaces(fronts, percentiles)  # type: ignore[arg-type]
