"""The knee of a front of two objectives: where giving up a little of one stops paying."""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.errors import SettingsError


def knee(points: Array) -> int:
    """Index of the point (k, 2) farthest below the line between the front's ends.

    Distances are taken with both objectives scaled to the front's own ranges, as in Das (1999), 'On
    characterizing the knee of the Pareto curve based on Normal-Boundary Intersection'. A front
    without a range in one objective has its knee where the other is least.

    Raises:
        SettingsError: there are no points.
    """
    points = np.asarray(points, dtype=float)
    if len(points) == 0:
        raise SettingsError("the front is empty: it has no knee")
    low, high = points.min(axis=0), points.max(axis=0)
    flat = high <= low
    scaled = (points - low) / np.where(flat, 1.0, high - low)
    # On the line between the ends (0, 1) and (1, 0) both shares add up to one.
    return int(np.argmin(scaled.sum(axis=1)))
