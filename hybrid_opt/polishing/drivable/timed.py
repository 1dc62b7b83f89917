"""The judge of a path: its fastest timing within a force, or the least force for a duration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hybrid_opt.robust.path_force import PathPoints, robust_path
from hybrid_opt.timing.drive import Driver
from symbolic.array import Array
from symbolic.records.task import waypoints_of

DriveAim = Literal["duration", "force"]
"""Least duration within a force limit, or least force limit within a duration."""

STILL = 1e-3
"""The least force limit is this share above the force that holds the box at rest."""

FORCE_STEPS = 14
"""Timings that the least force of a path may take."""

FORCE_TOLERANCE = 2e-6
"""Of the least force, as a share of it."""


@dataclass(frozen=True)
class Goal:
    """What a polish of one point wants.

    Attributes:
        aim: what is minimised.
        limit: force limit [N] of 'duration', duration [s] of 'force'.
    """

    aim: DriveAim
    limit: float


@dataclass(frozen=True)
class TimedPath:
    """A path with the timing that serves a goal best.

    Attributes:
        duration: [s], infinite where there is none.
        force: force limit [N].
        squared: (intervals + 1,) u'^2 at the grid points.
        joints: of both arms at the grid points (intervals + 1, n) [rad].
    """

    duration: float
    force: float
    squared: Array
    joints: tuple[Array, Array]

    def level(self, goal: Goal) -> float:
        """What the goal minimises, infinite without a timing."""
        if not np.isfinite(self.duration):
            return float("inf")
        return self.duration if goal.aim == "duration" else self.force


class PathJudge:
    """Times paths by the compiled passes.

    Attributes:
        force_limit: least and largest [N].
    """

    def __init__(self, driver: Driver, force_limit: tuple[float, float]) -> None:
        """force_limit: least and largest [N]."""
        self._timer, self._limits, self.force_limit = driver.timer, driver.limits, force_limit

    def timed(self, path: Array, goal: Goal) -> TimedPath:
        """The best timing of free waypoints (n_path,) for a goal."""
        known = self._timer.path_limits(path[None])
        if goal.aim == "duration":
            return self._at(path, known, goal.limit)
        return self._least_force(path, known, goal.limit)

    def durations(self, paths: Array, force: float) -> Array:
        """(n,) [s] of paths (n, n_path) within a force, infinite where there is none."""
        limits = [self._limits(force)] * len(paths)
        found = self._timer.time_all(np.ascontiguousarray(paths), limits)
        return np.array([t.duration if t.ok else np.inf for t in found])

    def _at(self, path: Array, known: dict[str, Array], force: float) -> TimedPath:
        (found,) = self._timer.time_known(path[None], known, [self._limits(force)])
        duration = found.duration if found.ok else float("inf")
        joints = [np.ascontiguousarray(known[f"q_{arm}"][0][::2]) for arm in (1, 2)]
        return TimedPath(duration, force, found.grid_speed**2, (joints[0], joints[1]))

    def _least_force(self, path: Array, known: dict[str, Array], duration: float) -> TimedPath:
        """By regula falsi (Illinois) in the logarithm of force and duration."""
        low, high = (self._at(path, known, force) for force in self.force_limit)
        if not high.duration <= duration:
            return (
                self._at(path, known, self.force_limit[0])
                if low.duration <= duration
                else (TimedPath(float("inf"), high.force, high.squared, high.joints))
            )
        if low.duration <= duration:
            return low
        below, above = np.log(low.force), np.log(high.force)
        miss_below = np.log(min(low.duration, 10.0 * duration) / duration)
        miss_above = np.log(high.duration / duration)
        for _ in range(FORCE_STEPS):
            share = miss_below / (miss_below - miss_above)
            middle = below + min(max(share, 0.02), 0.98) * (above - below)
            found = self._at(path, known, float(np.exp(middle)))
            miss = np.log(min(found.duration, 10.0 * duration) / duration)
            if miss <= 0.0:
                above, miss_above, high, miss_below = middle, miss, found, miss_below / 2.0
            else:
                below, miss_below, miss_above = middle, miss, miss_above / 2.0
            if above - below <= FORCE_TOLERANCE or -FORCE_TOLERANCE < miss <= 0.0:
                break
        return high


def force_range(driver: Driver) -> tuple[float, float]:
    """The task's least and largest force limit [N]; of robust forces the least is at least what
    holds the box at both ends of every path."""
    workcell = driver.timer.workcell
    least, most = workcell.task.force_limit
    if driver.robust:
        ends = waypoints_of(workcell.task, workcell.task.lower)[[0, -1]]
        (first, second), (a, w) = np.zeros((2, 2, 6)), np.zeros((2, 2))
        held, _ = robust_path(workcell).at(PathPoints(ends, first, second, a, w))
        least = max(least, (1.0 + STILL) * float(held.max()))
    return least, most
