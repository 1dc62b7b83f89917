"""The knee of a front of two objectives: where giving up a little of one stops paying."""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.errors import SettingsError


def knee(points: Array) -> int:
    """Index of the point (k, 2) whose objectives, both positive, have the least product.

    Beside it one per cent of either objective buys at most one per cent of the other. The distance
    from the line between the front's ends (Das 1999) would depend on how far the ends were
    explored: one long carry at almost the least force moves it by a newton.

    Raises:
        SettingsError: there are no points, or an objective is not positive.
    """
    points = np.asarray(points, dtype=float)
    if len(points) == 0:
        raise SettingsError("the front is empty: it has no knee")
    if not (points > 0.0).all():
        raise SettingsError("the knee needs objectives above zero")
    return int(np.argmin(np.log(points).sum(axis=1)))
