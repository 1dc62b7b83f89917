"""Via-points through which the quintic spline follows a planned path without collision."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hybrid_opt.proposing.closed_chain import STEP, ClosedChain, Place, distance, straight
from hybrid_opt.proposing.planner import same
from symbolic.array import Array
from symbolic.path.spline import path_basis

SHORTCUTS = 60
"""Shortcuts of a path that are tried."""

MOST_VIA_POINTS = 6
"""Via-points of a proposal; more make a search long."""

LEAST_SAMPLES = 60
"""Places of a spline that are looked at, at least."""

SHIFTS = 12
"""Random shifts of via-points that are tried where fits collide."""

SHIFT = 0.04
"""Their standard deviation [m], and in a turn counted by its lever."""


def shortened(
    chain: ClosedChain, corners: Sequence[Place], rng: np.random.Generator
) -> list[Place]:
    """A path without needless corners: places along it, `closed_chain.STEP` apart."""
    dense = [corners[0]]
    for corner in corners[1:]:
        dense += _between(chain, dense[-1], corner) or [corner]
    for _ in range(SHORTCUTS):
        if len(dense) < 4:
            break
        first, last = sorted(rng.choice(len(dense), 2, replace=False).tolist())
        if last - first < 3:
            continue
        old = sum(
            distance(a.extended, b.extended)
            for a, b in zip(dense[first:last], dense[first + 1 : last + 1], strict=True)
        )
        if distance(dense[first].extended, dense[last].extended) > 0.98 * old:
            continue
        new = _between(chain, dense[first], dense[last])
        if new is not None:
            dense[first + 1 : last + 1] = new
    return dense


def _between(chain: ClosedChain, first: Place, last: Place) -> list[Place] | None:
    """Places after the first on the straight motion to the last; None if it is not free."""
    path = straight(first.extended, last.extended)[1:]
    found = list(chain.along(first, path))
    return found if len(found) == len(path) and same(found[-1], last) else None


def fit(
    chain: ClosedChain, path: Sequence[Place], count: int, rng: np.random.Generator
) -> Array | None:
    """Via-points (count, 6 + m) whose spline is free, None if none are found.

    Those on the path at even distances, those whose spline is nearest to it, what lies between
    them, then random shifts of the best.

    Args:
        path: from start to goal.
        count: via-points.
        rng: of the shifts.
    """
    points = np.array([place.extended for place in path])
    steps = [distance(a, b) for a, b in pairwise(points)]
    share = np.concatenate([[0.0], np.cumsum(steps)])
    u = np.linspace(0.0, 1.0, LEAST_SAMPLES)
    even = np.column_stack([np.interp(u * share[-1], share, column) for column in points.T])
    at = np.linspace(0.0, 1.0, count + 2)
    on_path = np.column_stack([np.interp(at * share[-1], share, column) for column in points.T])
    basis = path_basis(count + 2, u).position
    rest = even - basis[:, [0, -1]] @ on_path[[0, -1]]
    nearest = on_path.copy()
    nearest[1:-1] = np.linalg.lstsq(basis[:, 1:-1], rest, rcond=None)[0]
    best, most = on_path, -1.0
    for weight in (0.0, 0.5, 1.0):
        waypoints = (1.0 - weight) * on_path + weight * nearest
        free = free_share(chain, path[0], waypoints)
        if free == 1.0:
            return waypoints[1:-1]
        if free > most:
            best, most = waypoints, free
    for _ in range(SHIFTS):
        waypoints = best.copy()
        waypoints[1:-1, :3] += rng.normal(0.0, SHIFT, (count, 3))
        free = free_share(chain, path[0], waypoints)
        if free == 1.0:
            return waypoints[1:-1]
        if free > most:
            best, most = waypoints, free
    return None


def free_share(chain: ClosedChain, start: Place, waypoints: Array) -> float:
    """Share of the spline through waypoints (n, 6 + m) before it is first not free."""
    legs = [distance(a, b) for a, b in pairwise(waypoints)]
    n = max(LEAST_SAMPLES, int(np.ceil(1.2 * sum(legs) / STEP)))
    path = path_basis(len(waypoints), np.linspace(0.0, 1.0, n)).position @ waypoints
    return sum(1 for _ in chain.along(start, path)) / n
