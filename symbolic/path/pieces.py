"""Refinement of a task's path: free waypoints between those of the file, on the same spline.

A piece is the path between two stated waypoints, those of the file. Free waypoints cut each piece
into `Task.pieces` equal parts. The knots are uniform and the end conditions do not depend on them.
Every path through the stated waypoints is therefore also a path of the refined task. Searches draw
the stated waypoints; a polish moves all waypoints.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.path.spline import path_position
from symbolic.records.task import RedundantJoint, Task, Waypoint, extended_waypoints


def refined_task(task: Task) -> Task:
    """Return the task with `task.pieces` - 1 free waypoints added between each two waypoints of its
    file.

    The bounds of the added waypoints admit every path that the bounds in the file admit.
    """
    n = len(task.waypoints)
    by = _through(n, (n - 1) * task.pieces + 1)

    def bounds(lower: Array, upper: Array) -> tuple[Array, Array]:
        middle, half = by @ ((lower + upper) / 2.0), np.abs(by) @ ((upper - lower) / 2.0)
        least, most = middle - half, middle + half
        least[:: task.pieces], most[:: task.pieces] = lower, upper
        return least, most

    lower, upper = bounds(*(np.array([getattr(w, k) for w in task.waypoints]) for k in BOUNDS))
    hand_made = np.array([waypoint.lower for waypoint in task.waypoints])
    hand_made[list(task.free_indices)] = task.initial
    hand_made[:, 3:] = task.orientation.unwrapped(hand_made[:, 3:])
    hand_made = np.clip(by @ hand_made, lower, upper)
    redundant = []
    for joint in task.redundant:
        least, most = bounds(joint.lower, joint.upper)
        initial = np.clip(by @ joint.initial, least, most)
        redundant.append(replace(joint, lower=least, upper=most, initial=initial))
    return _with_waypoints(task, lower, upper, hand_made, redundant)


def coarse_task(task: Task) -> Task:
    """Return the task without the waypoints that `refined_task` added, with `pieces` 1."""
    if task.pieces == 1:
        return task
    every = slice(None, None, task.pieces)
    lower, upper = (np.array([getattr(w, k) for w in task.waypoints[every]]) for k in BOUNDS)
    hand_made = np.array([waypoint.lower for waypoint in task.waypoints])
    hand_made[list(task.free_indices)] = task.initial
    redundant = [
        replace(j, lower=j.lower[every], upper=j.upper[every], initial=j.initial[every])
        for j in task.redundant
    ]
    return replace(_with_waypoints(task, lower, upper, hand_made[every], redundant), pieces=1)


BOUNDS = ("lower", "upper")


def _with_waypoints(
    task: Task, lower: Array, upper: Array, hand_made: Array, redundant: list[RedundantJoint]
) -> Task:
    waypoints = tuple(map(Waypoint, lower, upper))
    found = replace(task, waypoints=waypoints, redundant=tuple(redundant))
    return replace(found, initial=hand_made[list(found.free_indices)])


def coarse_entries(task: Task) -> NDArray[np.intp]:
    """Return the indices of those path variables of a refined task that belong to waypoints of the
    file.

    Returns:
        (coarse n_path,) integers, in the order of the path variables.
    """
    return np.flatnonzero(task.free_entries[0] % task.pieces == 0)


def hierarchical_basis(task: Task) -> tuple[Array, Array]:
    """Compute a hierarchical basis of the path variables, from coarse to fine waypoints.

    The grid of the file's waypoints is refined in steps, by halves as long as that is possible.
    Each waypoint belongs to the coarsest grid that contains it. A move of a waypoint also moves the
    waypoints of all finer grids, so that they stay on the spline through the waypoint's grid.

    Returns:
        (n_path, n_path) matrix whose column j is the change of all path variables for a unit move
        of variable j; and (n_path,) squared grid spacing of each variable, relative to the spacing
        of the file's waypoints. Equal moves cause accelerations inversely proportional to the
        squared spacing.
    """
    (rows, columns), m = task.free_entries, len(task.waypoints)
    by, square = np.zeros((task.n_path, task.n_path)), np.zeros(task.n_path)
    together = columns[:, None] == columns
    for step in _steps(task.pieces):
        own = (rows % step == 0) & (square == 0.0)
        through = _through((m - 1) // step + 1, m)[np.ix_(rows, rows[own] // step)]
        by[:, own] = np.where(together[:, own], through, 0.0)
        square[own] = (step / task.pieces) ** 2
    return by, square


def _steps(pieces: int) -> list[int]:
    """Return the spacing of the waypoints in each grid, from the coarsest grid to 1.

    The spacing is counted in waypoints of the refined task.

    Args:
        pieces: number of pieces between two waypoints of the file in the refined task.
    """
    steps = [pieces]
    while steps[-1] > 1:
        steps.append(steps[-1] // 2 if steps[-1] % 2 == 0 else 1)
    return steps


def resample_decisions(x: Array, source: Task, target: Task) -> Array:
    """Convert decision vectors of one task to the waypoints of another task.

    The paths stay the same if the target has all waypoints of the source. Otherwise the new paths
    pass through the common waypoints. Path variables are clipped to the bounds of the target.

    Args:
        x: (n, source.n_path or more) decision vectors; entries after the path variables are kept.
        source: task of x.
        target: task of the result.

    Returns:
        (n, target.n_path or more) decision vectors.
    """
    x = np.atleast_2d(x)
    if len(source.waypoints) == len(target.waypoints):
        return x
    by, n = _through(len(source.waypoints), len(target.waypoints)), target.n_path
    rows, columns = target.free_entries
    paths = (by @ extended_waypoints(source, x))[:, rows, columns]
    within = np.clip(paths, target.lower[:n], target.upper[:n])
    return np.hstack([within, x[:, source.n_path :]])


@cache
def _through(n: int, m: int) -> Array:
    """Compute the matrix (m, n) that maps n waypoints to m points of the natural quintic spline
    through them, evenly spaced in u."""
    u = np.linspace(0.0, 1.0, m)
    by = path_position(n, u).copy()
    known, where = np.divmod(np.arange(m) * (n - 1), m - 1)
    by[where == 0] = np.eye(n)[known[where == 0]]
    by.flags.writeable = False
    return by
