"""Summaries, rank tests and attainment against brute force and published thresholds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import PermutationMethod, mannwhitneyu

from hybrid_opt.indicators.statistics import (
    attainment_surfaces,
    corrected,
    holm,
    magnitude_of,
    rank_test,
    summarise,
)
from symbolic.errors import SettingsError

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
    with pytest.raises(SettingsError, match="percent"):
        attainment_surfaces(fronts, percentiles)  # type: ignore[arg-type]
