"""Statistics over the replicas of a campaign: summaries, rank tests with effect sizes, attainment
surfaces.

An empirical attainment surface bounds the region of objectives that a given share of the replicas
attained or bettered. Source: Fonseca, Guerreiro, Lopez-Ibanez and Paquete 2011, through moocore's
`eaf`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import moocore
import numpy as np
from numpy.typing import ArrayLike

from symbolic.array import Array, Count, Figure
from symbolic.errors import SettingsError

Magnitude = Literal["negligible", "small", "medium", "large"]


@dataclass(frozen=True)
class Summary:
    """Summary of one figure over the replicas of a campaign. NaN and infinite values are left out.

    Attributes:
        count: number of finite values.
        missing: number of values that are not finite.
        mean: arithmetic mean, NaN without values.
        std: sample standard deviation (divisor count - 1), NaN for fewer than two values.
        minimum, quartile1, median, quartile3, maximum: order statistics, quartiles by linear
            interpolation (Hyndman and Fan 1996, type 7); NaN without values.
    """

    count: Count
    missing: Count
    mean: Figure
    std: Figure
    minimum: Figure
    quartile1: Figure
    median: Figure
    quartile3: Figure
    maximum: Figure


def summarise(values: ArrayLike) -> Summary:
    """Summarise (n,) values, one per replica."""
    sample, missing = _finite(values)
    if len(sample) == 0:
        return Summary(0, missing, *[float("nan")] * 7)
    spread = float(np.std(sample, ddof=1)) if len(sample) > 1 else float("nan")
    five = (float(q) for q in np.quantile(sample, [0.0, 0.25, 0.5, 0.75, 1.0]))
    return Summary(len(sample), missing, float(sample.mean()), spread, *five)


@dataclass(frozen=True)
class RankTest:
    """Mann-Whitney's comparison of two independent samples.

    Attributes:
        first, second: names of the samples.
        count_first, count_second: numbers of values compared (infinite values take part, NaN do
            not).
        u: Mann-Whitney's U of the first sample.
        p: exact two-sided p-value, NaN where a sample is empty.
        p_holm: p-value after Holm's correction over a family of tests; `p` for a single test.
        a12: Vargha and Delaney's effect size, the chance that a value of the first sample
            exceeds one of the second, ties counting half; 0.5 is no effect.
        magnitude: word for the distance of `a12` from 0.5: small from 0.06, medium from 0.14,
            large from 0.21.
        figure: name of the compared figure, '' if stated elsewhere.
    """

    first: str
    second: str
    count_first: Count
    count_second: Count
    u: Figure
    p: Figure
    p_holm: Figure
    a12: Figure
    magnitude: Magnitude
    figure: str = ""


def rank_test(
    first: ArrayLike, second: ArrayLike, names: tuple[str, str] = ("first", "second")
) -> RankTest:
    """Compare two independent samples by Mann-Whitney's rank test, which assumes no distribution.

    The p-value is exact, also with ties. Sources: Mann and Whitney 1947; with ties the exact
    permutation distribution of the midrank sum (Streitberg and Roehmel 1986); Vargha and Delaney
    2000 for the effect size.

    Args:
        first, second: (n,) and (m,) values; NaN are left out.
        names: names of both samples.
    """
    # Not imported at the top: it takes half a second, and the workers of a study rank nothing.
    from scipy.stats import mannwhitneyu, rankdata

    x, y = _ranked(first), _ranked(second)
    if len(x) == 0 or len(y) == 0:
        nan = float("nan")
        return RankTest(*names, len(x), len(y), nan, nan, nan, nan, "negligible")
    pooled = np.concatenate([x, y])
    if len(np.unique(pooled)) == len(pooled):
        outcome = mannwhitneyu(x, y, alternative="two-sided", method="exact")
        u, p = float(outcome.statistic), float(outcome.pvalue)
    else:
        u, p = _exact_with_ties(rankdata(pooled), len(x))
    a12 = u / (len(x) * len(y))
    return RankTest(*names, len(x), len(y), u, p, p, a12, magnitude_of(a12))


def magnitude_of(a12: float) -> Magnitude:
    """Return Vargha and Delaney's (2000) word for the effect size `a12`, such as 'small'."""
    effect = abs(a12 - 0.5)
    # The limits 0.56, 0.64, 0.71 are two-decimal figures; the margin keeps them inclusive.
    for limit, word in ((0.21, "large"), (0.14, "medium"), (0.06, "small")):
        if effect >= limit - 1e-12:
            return word  # type: ignore[return-value]
    return "negligible"


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Adjust p-values of several tests by Holm's (1979) step-down correction.

    NaN values stay NaN and do not count as tests.

    Returns:
        Adjusted p-values in the order of `p_values`.
    """
    p = np.asarray(p_values, dtype=np.float64)
    adjusted = np.full(len(p), np.nan)
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * factors), 1.0)
    return tuple(float(value) for value in adjusted)


def corrected(tests: Sequence[RankTest]) -> tuple[RankTest, ...]:
    """Return rank tests with `p_holm` set by Holm's correction over all of them."""
    adjusted = holm([test.p for test in tests])
    return tuple(replace(test, p_holm=p_holm) for test, p_holm in zip(tests, adjusted, strict=True))


def _finite(values: ArrayLike) -> tuple[Array, int]:
    sample = np.asarray(values, dtype=np.float64).ravel()
    usable = sample[np.isfinite(sample)]
    return usable, len(sample) - len(usable)


def _ranked(values: ArrayLike) -> Array:
    sample = np.asarray(values, dtype=np.float64).ravel()
    return np.asarray(sample[~np.isnan(sample)])


def _exact_with_ties(ranks: Array, count: int) -> tuple[float, float]:
    """Compute Mann-Whitney's U and its exact two-sided p-value.

    The distribution is over all choices of `count` out of the midranks. It is found by counting the
    subsets of each size by the sum of their doubled (hence whole) midranks.

    Args:
        ranks: midranks of all values, those of the first sample first.
        count: size of the first sample.
    """
    doubled = np.rint(2.0 * ranks).astype(np.int64)
    total = int(doubled.sum())
    # Python integers: the number of subsets outgrows 64 bits for large samples.
    ways = np.zeros((count + 1, total + 1), dtype=object)
    ways[0, 0] = 1
    for rank in doubled:
        ways[1:, rank:] = ways[1:, rank:] + ways[:-1, : total + 1 - rank]
    observed = int(doubled[:count].sum())
    subsets = ways[count]
    lower, upper = sum(subsets[: observed + 1]), sum(subsets[observed:])
    p = min(1.0, 2 * min(lower, upper) / sum(subsets))
    return (observed / 2.0) - count * (count + 1) / 2.0, float(p)


def attainment_surfaces(
    fronts: Sequence[ArrayLike], percentiles: Sequence[float] = (25.0, 50.0, 75.0)
) -> dict[float, Array]:
    """Compute the attainment surfaces of replicas' fronts.

    The surface of percentile p bounds the region of objectives that at least p percent of the
    fronts attain (dominate or touch). An empty front counts as a replica that attains nothing.

    Args:
        fronts: one (k_i, n_obj) front per replica, n_obj 2 or 3.
        percentiles: percentiles in (0, 100].

    Returns:
        By percentile the corners (k, n_obj) of the surface, by increasing first objective. There
        are none if too few fronts hold any point.

    Raises:
        SettingsError: no fronts, or a percentile out of range.
    """
    if len(fronts) == 0 or not all(0.0 < percentile <= 100.0 for percentile in percentiles):
        raise SettingsError(
            f"attainment of {len(fronts)} fronts at {list(percentiles)} percent; needed are at "
            "least one front and percentiles above 0 and up to 100",
            code="percentiles",
        )
    sets = [np.asarray(front, dtype=np.float64) for front in fronts]
    filled = [points for points in sets if len(points) > 0]
    width = filled[0].shape[1] if filled else 2
    surfaces = {}
    for percentile in percentiles:
        # Rounded first, so that 30 % of 10 fronts is 3 in spite of binary fractions.
        needed = max(1, int(np.ceil(np.round(percentile / 100.0 * len(sets), 9))))
        points = np.empty((0, width))
        if needed <= len(filled):
            labels = np.repeat(np.arange(len(filled)), [len(points) for points in filled])
            levels = moocore.eaf(
                np.concatenate(filled), labels, percentiles=[100.0 * needed / len(filled)]
            )
            points = levels[:, :-1]
            points = points[np.lexsort(points.T[::-1])]
        points.setflags(write=False)
        surfaces[float(percentile)] = points
    return surfaces
