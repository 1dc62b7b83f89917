"""Starts in other basins: random changes of a few decision variables, judged before they are used.

From the end of a front that a local solver reached, a better one may be a tilt of the box away.
Thousands of candidates cost less than one attempt, so many are drawn, and the best of those that
are feasible and far away is where the next attempt starts.
"""

from __future__ import annotations

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.feasible import first_feasible
from hybrid_opt.polishing.settings import KickSettings
from symbolic.array import Array


def kicked(
    evaluator: CandidateEvaluator,
    settings: KickSettings,
    x: Array,
    objective: int,
    rng: np.random.Generator,
) -> tuple[Array, Array] | None:
    """The best feasible candidate that differs from another in a few variables, and its objectives.

    Args:
        x: (n_var,) where it starts from.
        objective: the one that is to be low.
        rng: draws the candidates.

    Returns:
        The candidate (n_var,) and its objectives (2,); None where no other one is feasible.
    """
    low, high = evaluator.lower, evaluator.upper
    shape = settings.candidates, len(x)
    fresh = rng.uniform(low, high, shape)
    candidates = np.where(rng.random(shape) < settings.share, fresh, x)
    far = (np.abs(candidates - x) / (high - low)).max(axis=1) > settings.distance
    if not far.any():
        return None
    rows, objectives = first_feasible(evaluator, candidates[far], 1, objective)
    return (candidates[far][rows[0]], objectives[0]) if len(rows) else None
