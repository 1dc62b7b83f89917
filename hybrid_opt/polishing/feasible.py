"""The first feasible ones of many candidates, most of which need no verdict on collisions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from symbolic.array import Array

TOGETHER = 16
"""Candidates whose collisions are judged together: two batches of the widest lanes."""


def first_feasible(
    evaluator: CandidateEvaluator, x: Array, count: int, objective: int | None = None
) -> tuple[NDArray[np.intp], Array]:
    """Of candidates the first feasible ones: their rows (k,) and objectives (k, m).

    Args:
        x: (n, n_var) candidates.
        count: at most so many.
        objective: they come in its order, the lowest first; None for theirs.
    """
    but_collisions = evaluator.evaluate(x, with_collisions=False)
    rows = np.flatnonzero(but_collisions.feasible)
    if objective is not None:
        rows = rows[np.argsort(but_collisions.objectives[rows, objective], kind="stable")]
    found = np.empty(0, dtype=np.intp)
    for first in range(0, len(rows), TOGETHER):
        some = rows[first : first + TOGETHER]
        found = np.concatenate([found, some[evaluator.evaluate(x[some]).feasible]])[:count]
        if len(found) == count:
            break
    return found, but_collisions.objectives[found]
