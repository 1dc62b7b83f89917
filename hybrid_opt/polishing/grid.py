"""Places along the path: the task's samples and some between them, closer than either matters."""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.path.spline import path_basis
from symbolic.records import Task

PLACE_SPACING = 0.0025
"""Wanted distance of neighbouring places in the path parameter. What dips between two places is
covered by the distance kept from obstacles, and in the end certified."""


class Grid:
    """The places of one task's path.

    Widths are given in the path parameter (the whole path is 1), so that nothing here depends on
    the number of samples.

    Attributes:
        per_sample: places per interval between samples.
        parameter: (m,) of all places, in [0, 1].
        sample_parameter: (n,) of the samples.
        basis, rate_basis: (m, n_waypoints): poses = basis @ waypoints, and their first
            derivative with respect to the path parameter.
    """

    def __init__(self, task: Task) -> None:
        intervals = task.samples - 1
        self.per_sample = max(1, round(1.0 / (intervals * PLACE_SPACING)))
        self.sample_parameter = np.linspace(0.0, 1.0, task.samples)
        self.parameter = np.linspace(0.0, 1.0, intervals * self.per_sample + 1)
        along = path_basis(len(task.waypoints), self.parameter)
        self.basis, self.rate_basis = along.position, along.first

    def places(self, width: float) -> int:
        """How many places lie in a width of the path parameter, at least one."""
        return max(1, round(width * (len(self.parameter) - 1)))

    def samples(self, width: float) -> int:
        """How many samples lie in a width of the path parameter, at least one."""
        return max(1, round(width * (len(self.sample_parameter) - 1)))

    def between(self, values: Array) -> Array:
        """Values (n, k) on samples, interpolated to all places (m, k)."""
        return np.column_stack(
            [np.interp(self.parameter, self.sample_parameter, column) for column in values.T]
        )


def lowest(values: Array, limit: float, stride: int | None = None) -> list[int]:
    """Of every stretch of places below the limit the lowest, and those by the stride from it."""
    below = values < limit
    if not below.any():
        return []
    edges = np.diff(np.concatenate([[0], below.astype(np.int8), [0]]))
    places: list[int] = []
    for start, stop in zip(
        np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True
    ):
        least = start + int(np.argmin(values[start:stop]))
        if stride is None:
            places.append(least)
        else:
            places += range(least - (least - start) // stride * stride, stop, stride)
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
