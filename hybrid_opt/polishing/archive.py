"""The points of a front in the course of its polish."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hybrid_opt.indicators import metrics
from symbolic.array import Array

LEAST_SPAN = 2e-3
"""Least scale of an objective: of a front of one point, or one that is nearly flat."""


class GrowingFront:
    """The points that stand so far: rows of the given front, and new ones."""

    def __init__(self, x: Array, objectives: Array, parent: list[int]) -> None:
        self.x, self.objectives = list(x), list(objectives)
        self.parent, self.polished = list(parent), [False] * len(x)

    def replace(self, parent: int, x: Array, objectives: Array) -> None:
        """Put a polished point in the place of a row of the given front."""
        index = self.parent.index(parent)
        self.x[index], self.objectives[index], self.polished[index] = x, objectives, True

    def dominates(self, objectives: Array) -> bool:
        """Whether a point is as good in both objectives."""
        return bool(np.any(np.all(np.array(self.objectives) <= objectives, axis=1)))

    def add(self, x: Array, objectives: Array) -> None:
        """Take in a new point."""
        self.x.append(x)
        self.objectives.append(objectives)
        self.parent.append(-1)
        self.polished.append(True)

    def drop(self, indices: Sequence[int]) -> None:
        """Take out points; the others' indices change."""
        lists: tuple[list[Any], ...] = (self.x, self.objectives, self.parent, self.polished)
        for values in lists:
            values[:] = [value for k, value in enumerate(values) if k not in indices]

    def rows(self) -> list[int]:
        """Indices of the non-dominated points by increasing first objective."""
        values = np.array(self.objectives)
        kept = np.flatnonzero(metrics.non_dominated(values))
        return [int(k) for k in kept[np.lexsort(values[kept].T[::-1])]]

    def best(self, objective: int | None) -> tuple[int, float]:
        """The point that is the lowest in an objective, or in the sum of both, and its value."""
        wanted = np.ones(2) if objective is None else np.eye(2)[objective]
        values = {k: float(wanted @ self.objectives[k]) for k in self.rows()}
        index = min(values, key=lambda k: values[k])
        return index, values[index]

    def span(self) -> Array:
        """(2,) the scale of each objective."""
        values = np.array(self.objectives)[self.rows()]
        return np.asarray(np.maximum(np.ptp(values, axis=0), LEAST_SPAN))
