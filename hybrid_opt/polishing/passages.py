"""How the payload passes an obstacle: which single direction separates them where along the path.

Between a box and a box, the clearance bound is the largest of a few gaps along single directions.
A row that holds one of these gaps is smooth. Where the largest gap changes from one that falls
to one that rises, the payload passes an edge, and the height of that kink gets a row of its own
(`symbolic.smooth.rows`).
"""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.smooth.rows import RowKind

Row = tuple[RowKind, int]
"""What is kept, and at which place."""

KINK_ACTIVITY = 0.06
"""Kinks lower than this get a row [m]."""

ACTIVITY = ((0.03, 8), (0.08, 16))
"""Gaps below each distance [m] get a row at every so many places: they are cheap, because they
need no joints, and decide where the path may go."""

FARTHEST = max(distance for distance, _ in ACTIVITY)
"""Obstacles that stay farther away get no rows [m]."""

BESIDE_KINK = 12
"""Places on either side of a kink without rows of a gap: they would hold the kink in its place."""


def passage_rows(index: int, gaps: Array) -> list[Row]:
    """Rows that keep the payload from one obstacle.

    Args:
        index: of the active pair.
        gaps: (m, n) of every place along every direction [m].
    """
    best, height = gaps.argmax(axis=1), gaps.max(axis=1)
    kinks = [
        k
        for k in np.flatnonzero(best[1:] != best[:-1]).tolist()
        if height[k : k + 2].min() < KINK_ACTIVITY
        and gaps[k + 1, best[k]] < gaps[k, best[k]]
        and gaps[k + 1, best[k + 1]] > gaps[k, best[k + 1]]
    ]
    rows = [
        (
            RowKind("passing", index, direction=int(best[k]), after=int(best[k + 1])),
            k + int(height[k + 1] < height[k]),
        )
        for k in kinks
    ]
    places = {
        place
        for distance, stride in ACTIVITY
        for place in lowest(height, distance, None) + lowest(height, distance, stride)
        if all(abs(place - k) >= BESIDE_KINK for k in kinks)
    }
    return rows + [separation_row(index, gaps, place) for place in sorted(places)]


def separation_row(index: int, gaps: Array, place: int) -> Row:
    """The row of the largest gap at a place."""
    return RowKind("separation", index, direction=int(gaps[place].argmax())), place


def lowest(values: Array, limit: float, stride: int | None) -> list[int]:
    """Of every stretch of places below the limit the lowest, and those by the stride from it."""
    below = values < limit
    starts = np.flatnonzero(below & ~np.concatenate([[False], below[:-1]]))
    ends = np.flatnonzero(below & ~np.concatenate([below[1:], [False]]))
    places: list[int] = []
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        least = start + int(np.argmin(values[start : end + 1]))
        if stride is None:
            places.append(least)
        else:
            places += range(least - (least - start) // stride * stride, end + 1, stride)
    return places


def dipped(clearance: Array) -> Array:
    """Clearances (n, k) with the dips between places: where an edge is passed, the clearance falls
    steadily up to a kink and rises steadily from there, so the lines from both sides meet at the
    least value in between, which then counts at both places."""
    low = clearance.copy()
    if len(clearance) < 4:
        return low
    before, left, right, after = (clearance[i : len(clearance) - 3 + i] for i in range(4))
    falling, rising = before - left, after - right
    both = (falling > 0.0) & (rising > 0.0)
    slopes = np.where(both, falling + rising, 1.0)
    share = np.where(both, (left - right + rising) / slopes, 0.0)
    kink = np.where((share > 0.0) & (share < 1.0), left - falling * share, np.inf)
    low[1:-2] = np.minimum(low[1:-2], kink)
    low[2:-1] = np.minimum(low[2:-1], kink)
    return low
