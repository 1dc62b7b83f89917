"""Questions to a checker that only tests ask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.collision.between import (
    SEARCH_DEPTH,
    MotionVerdict,
    SampledMotions,
    check_all_between,
)
from hybrid_opt.collision.checker import CollisionChecker
from symbolic.array import Array


def collision_mask(
    checker: CollisionChecker, pose: Array, q_1: Array, q_2: Array
) -> NDArray[np.bool_]:
    """(n, n_pairs) FCL's answer for every pair of every sample, without any screening."""
    n, n_pairs = len(pose), len(checker.geometry.active)
    rows, pairs = np.divmod(np.arange(n * n_pairs), n_pairs)
    found = checker.collisions(pose, q_1, q_2, rows.tolist(), pairs.tolist())
    return np.array(found, dtype=bool).reshape(n, n_pairs)


def check_between(
    checker: CollisionChecker, configuration: Array, depth: int = SEARCH_DEPTH
) -> MotionVerdict:
    """One motion by its samples (n, 6 + all joints), without a margin."""
    clearance = checker.bounds(*checker.split(configuration))
    sampled = SampledMotions(configuration, clearance, (len(configuration),), np.zeros(1))
    return check_all_between(checker, sampled, depth)[0]
