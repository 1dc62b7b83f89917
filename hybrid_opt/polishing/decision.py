"""The decision vector in its unit box, and the waypoints that it stands for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symbolic.array import Array
from symbolic.records import Task


@dataclass(frozen=True)
class UnitBox:
    """Scales the decision vector to [-1, 1] by its bounds.

    Attributes:
        centre, half: (n_var,) x = centre + half * xi; 1 where a variable is fixed.
    """

    centre: Array
    half: Array

    @classmethod
    def of(cls, task: Task) -> UnitBox:
        """That of a task's decision vector."""
        half = (task.upper - task.lower) / 2.0
        return cls((task.upper + task.lower) / 2.0, np.where(half > 0.0, half, 1.0))

    def scaled(self, x: Array) -> Array:
        """From x to xi."""
        return (x - self.centre) / self.half

    def unscaled(self, xi: Array) -> Array:
        """From xi to x."""
        return self.centre + self.half * xi

    def step(self, start: Array, end: Array) -> float:
        """Largest change of a scaled variable between two decision vectors."""
        return float(np.max(np.abs(end - start) / self.half))
