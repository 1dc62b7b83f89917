from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_opt.proposing.bounds import Sampling, find_bounds
from symbolic.array import Array


def sampling(n: int, seed: int) -> Sampling:
    """Feasible is what lies in a ball about (0.3, ...)."""

    def feasible(x: Array) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(x - 0.3, axis=1) < 0.5)

    limits = np.array([np.full(n, -10.0), np.full(n, 10.0)])
    rng = np.random.default_rng(seed)

    def certain(x: Array) -> bool:
        return bool(feasible(x[None])[0])

    return Sampling(feasible, certain, np.full(n, 0.1), limits, rng, 0.02, 0.20, lambda: False)


@pytest.mark.parametrize("n", [3, 6, 12])
def test_the_wanted_share_of_candidates_is_feasible(n: int) -> None:
    how = sampling(n, 1)
    found = find_bounds(np.zeros(n) + 0.2, how)
    assert 0.02 <= found.share <= 0.20
    fresh = np.random.default_rng(7).uniform(found.lower, found.upper, (20_000, n))
    assert 0.015 <= how.feasible(fresh).mean() <= 0.25
    assert how.feasible(found.centre[None])[0]
    assert np.all(found.lower < found.centre)
    assert np.all(found.centre < found.upper)


def test_bounds_move_to_where_feasible_candidates_lie() -> None:
    edge = np.full(6, 0.3) - 0.45 / np.sqrt(6.0)
    found = find_bounds(edge, sampling(6, 2))
    assert np.linalg.norm(found.centre - 0.3) < 0.7 * np.linalg.norm(edge - 0.3)


def test_bounds_keep_to_limits() -> None:
    how = sampling(3, 3)
    how.limits[1] = 0.35
    found = find_bounds(np.full(3, 0.2), how)
    assert np.all(found.upper <= 0.35)
