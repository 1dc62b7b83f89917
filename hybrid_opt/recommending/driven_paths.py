"""Paths that are timed anew at any force, or so that they take a given time."""

from __future__ import annotations

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.timing.path_timer import PathTimer, PathTiming
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array

BISECTIONS = 30
LEAST_ABOVE_STILL = 1e-4
"""Where the search for a force begins, as a share above that of holding still."""


class DrivenPaths:
    """Paths of one cell with their geometry, so that each further timing is cheap.

    Attributes:
        x: (k, n_path) free waypoints.
        highest_force: the largest force limit that is tried [N].
    """

    def __init__(
        self, timer: PathTimer, x: Array, highest_force: float, robust: bool = False
    ) -> None:
        """Compute the geometry of the paths.

        Args:
            timer: of the cell.
            x: (k, n_path) free waypoints.
            highest_force: the largest force limit that is tried [N].
            robust: whether limits hold in every case of the cell's uncertainty.
        """
        self.x = np.atleast_2d(np.asarray(x, dtype=float))
        self.highest_force = highest_force
        self._timer, self._robust = timer, robust
        self._known = timer.path_limits(self.x)
        self._failures = timer.failures(self._known)

    @classmethod
    def of(cls, cell: Cell, x: Array) -> DrivenPaths:
        """Paths of a cell within the limits of its drivable carries."""
        highest = cell.workcell.task.force_limit[1]
        return cls(cell.path_timer, x, highest, cell.force_kind.robust)

    def __len__(self) -> int:
        return len(self.x)

    def timings(self, force: Array | float) -> list[PathTiming]:
        """The fastest timing of every path within force limits (k,) or one for all [N]."""
        limits = np.broadcast_to(np.asarray(force, dtype=float), (len(self),))
        return self._timer.time_known(
            self.x,
            self._known,
            [TimingLimits(force=float(limit), robust=self._robust) for limit in limits],
            self._failures,
        )

    def durations(self, force: Array | float) -> Array:
        """(k,) durations [s], infinite where nothing moves within the limit."""
        return np.array([timing.duration for timing in self.timings(force)])

    def forces(self, duration: float) -> Array:
        """(k,) least force limits with which the paths take at most a duration, inf for none [N].

        Durations fall as the limit rises, so bisection finds it.
        """
        still = np.array([timing.limited_force for timing in self.timings(1e-6)])
        low = np.where(np.isfinite(still), still, 1.0) * (1.0 + LEAST_ABOVE_STILL)
        high = np.full(len(self), max(self.highest_force, float(low.max())))
        possible = self.durations(high) <= duration
        for _ in range(BISECTIONS):
            middle = (low + high) / 2.0
            enough = self.durations(middle) <= duration
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return np.where(possible, high, np.inf)
