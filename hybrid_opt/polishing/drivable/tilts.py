"""Starts in other basins: a known path on which the box is turned all the way.

How the box is tilted while it is carried decides which basin a path lies in, and a local solver
seldom turns it over. So it is turned about one axis at every waypoint, by a share of what the
bounds leave. Such a path may touch something: the first step of a polish puts that right.
"""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.drivable.timed import PathJudge
from symbolic.array import Array
from symbolic.records import POSE_SIZE, Task

SHARES = (0.8, 0.6, 0.4)
"""Of what the bounds leave, the first one with which the path can be driven. Less turned paths fall
back to where they came from."""

LEAST_TURN = 0.1
"""Turns below this, in the mean of the waypoints, lead nowhere else [rad]."""


def turned(task: Task, judge: PathJudge, path: Array, force: float) -> list[Array]:
    """Paths (n_path,) that are driven within a force limit [N], at most one per axis and sense.

    Args:
        path: (n_path,) that is turned.
    """
    found = []
    columns = task.free_entries[1]
    for axis in range(3, POSE_SIZE):
        own = np.flatnonzero(columns == axis)
        for bound in (task.lower[own], task.upper[own]):
            by = bound - path[own]
            if not len(own) or np.abs(by).mean() < LEAST_TURN:
                continue
            candidates = np.repeat(path[None], len(SHARES), axis=0)
            candidates[:, own] += np.outer(SHARES, by)
            driven = np.isfinite(judge.durations(candidates, force))
            if driven.any():
                found.append(candidates[int(np.argmax(driven))])
    return found
