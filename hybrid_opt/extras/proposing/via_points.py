"""Via-points with which the quintic spline follows a planned path without collision."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hybrid_opt.extras.proposing.closed_chain import (
    PATH_STEP,
    ChainConfiguration,
    ClosedChain,
    distance,
    metric_weights,
    straight,
)
from hybrid_opt.extras.proposing.kinematics import JUMP
from hybrid_opt.extras.proposing.planner import same
from symbolic.array import Array
from symbolic.path.spline import path_basis
from symbolic.records import POSE_SIZE

SHORTCUTS = 80
"""Number of shortcuts of a path that are tried."""

SHORTER = 0.99
"""A shortcut is taken if it is shorter than this share of the length that it replaces."""

MOST_VIA_POINTS = 6
"""Largest number of via-points of a proposal; more make a search long."""

LEAST_SAMPLES = 60
"""Smallest number of points of a spline that are checked."""

SHIFTS = 24
"""Number of random shifts of the best via-points that are tried together if fits collide."""

NO_BETTER = 6
"""Number of such sets in sequence without a better one, after which no further set is tried."""

SHIFT = 0.06
"""Standard deviation of the largest shifts [m]; for rotations with the lever of `distance`."""

SHIFT_SIZES = (1.0, 0.3, 0.1, 0.03)
"""Shares of this deviation, one of which is drawn for each shift."""

GENERATIONS = 60
"""Number of generations of the evolution strategy that shortens a free spline."""

OFFSPRING = 16
"""Number of splines per generation."""

MEASURED = 24
"""Number of points of a spline at which the strategy measures its length and checks collisions."""

BLOCKED = 100.0
"""Cost of a spline that is out of reach everywhere; half as much if it collides everywhere
[rad]."""


def path_length(points: Array) -> float:
    """Compute the Euclidean length of the straight lines between successive points.

    Args:
        points: (n, m) points; the length has their unit.
    """
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def joint_length(path: Sequence[ChainConfiguration]) -> float:
    """Compute the Euclidean length of a path in the joint space of both arms [rad].

    Args:
        path: configurations along the path.
    """
    return path_length(np.array([np.concatenate(each.q) for each in path]))


def along(corners: Sequence[ChainConfiguration]) -> Array:
    """Compute box poses (n, 6) [m, rad] on a path of straight motions, neighbours at most
    `planner.PATH_STEP` apart.

    Args:
        corners: configurations at the corners of the path.
    """
    legs = [straight(a.extended, b.extended)[:, :POSE_SIZE] for a, b in pairwise(corners)]
    return np.vstack(legs)


def remove_corners(
    chain: ClosedChain, corners: Sequence[ChainConfiguration], rng: np.random.Generator
) -> list[ChainConfiguration]:
    """Shorten a path: replace parts of it by straight collision-free motions between random points
    of it.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        corners: corners of a collision-free path.
        rng: generator that chooses the points.

    Returns:
        Configurations along the path, at most `planner.PATH_STEP` apart.
    """
    dense = [corners[0]]
    for corner in corners[1:]:
        found = chain.way(dense[-1], straight(dense[-1].extended, corner.extended))
        dense += found[1:] if found and same(found[-1], corner) else [corner]
    for _ in range(SHORTCUTS):
        if len(dense) < 4:
            break
        first, last = sorted(rng.choice(len(dense), 2, replace=False).tolist())
        if last - first < 3:
            continue
        old = dense[first : last + 1]
        path = straight(old[0].extended, old[-1].extended)
        if rng.random() < 0.5:  # in one coordinate alone, the others go on as they do
            path, column = np.array([place.extended for place in old]), rng.integers(path.shape[1])
            path[:, column] = np.linspace(path[0, column], path[-1, column], len(path))
        found = chain.between(old[0], old[-1], path)
        if found and joint_length(found) < SHORTER * joint_length(old):
            dense[first : last + 1] = found
    return dense


def fit(
    chain: ClosedChain, path: Sequence[ChainConfiguration], count: int, rng: np.random.Generator
) -> Array | None:
    """Find via-points whose spline from start to goal is free of collisions; None if none are
    found.

    The search tries points on the path at even distances, the points whose spline is nearest to the
    path, interpolations between these two, and random shifts of the best so far.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        path: configurations from start to goal.
        count: number of via-points.
        rng: generator of the shifts.

    Returns:
        (count, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
    """
    points = np.array([place.extended for place in path])
    steps = [distance(a, b) for a, b in pairwise(points)]
    share = np.concatenate([[0.0], np.cumsum(steps)])
    u = np.linspace(0.0, 1.0, LEAST_SAMPLES)

    def at(u: Array, columns: Array) -> Array:
        return np.column_stack([np.interp(u * share[-1], share, column) for column in columns.T])

    on_path = at(np.linspace(0.0, 1.0, count + 2), points)
    basis = path_basis(count + 2, u).position
    rest = at(u, points) - basis[:, [0, -1]] @ on_path[[0, -1]]
    nearest = on_path.copy()
    nearest[1:-1] = np.linalg.lstsq(basis[:, 1:-1], rest, rcond=None)[0]
    q_1, q_2 = (at(u, np.array([place.q[arm] for place in path])) for arm in (0, 1))
    lever = metric_weights(points.shape[1])
    tried = np.array([(1.0 - weight) * on_path + weight * nearest for weight in (0.0, 0.5, 1.0)])
    best, least, worse = on_path, np.inf, 0
    while worse < NO_BETTER:
        _, blocked = _lengths(chain, basis @ tried, (q_1, q_2))
        for waypoints in tried[blocked == 0.0]:
            if free_share(chain, path[0], waypoints) == 1.0:
                return np.asarray(waypoints[1:-1])
        k = int(np.argmin(blocked))
        worse = 0 if blocked[k] < least else worse + 1
        if not worse:
            best, least = tried[k], blocked[k]
        size = SHIFT * rng.choice(SHIFT_SIZES, (SHIFTS, 1, 1))
        tried = np.tile(best, (SHIFTS, 1, 1))
        tried[:, 1:-1] += size * rng.normal(size=(SHIFTS, count, len(lever))) / lever
    return None


def shorten_spline(
    chain: ClosedChain, start: ChainConfiguration, waypoints: Array, rng: np.random.Generator
) -> Array:
    """Change waypoints such that their spline stays free of collisions and the paths of the joints
    become shorter.

    An evolution strategy, CMA-ES (Hansen, arXiv 1604.00772), starts from the given waypoints.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        start: configuration at the first waypoint.
        waypoints: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m],
            start and goal included.
        rng: generator that seeds the strategy.

    Returns:
        (n, 6 + m) waypoints; the given ones if none better are found.
    """
    # Not imported at the top: it brings Matplotlib, and a first carry is there before.
    import cma

    lever = metric_weights(waypoints.shape[1])
    basis = path_basis(len(waypoints), np.linspace(0.0, 1.0, MEASURED)).position
    configurations, whole = chain.followed(basis @ waypoints, start.q)
    if not whole:
        return waypoints
    shorter: list[tuple[float, Array]] = []
    least = joint_length(configurations)
    near = (
        np.array([each.q[0] for each in configurations]),
        np.array([each.q[1] for each in configurations]),
    )

    def moved(y: Array) -> Array:
        inner = y.reshape(-1, len(lever)) / lever
        return np.vstack([waypoints[0], inner, waypoints[-1]])

    options = {"popsize": OFFSPRING, "seed": int(rng.integers(1, 2**31)), "verbose": -9}
    strategy = cma.CMAEvolutionStrategy((waypoints[1:-1] * lever).ravel(), SHIFT / 3.0, options)
    for _ in range(GENERATIONS):
        asked = strategy.ask()
        tried = [moved(np.asarray(y)) for y in asked]
        lengths, blocked = _lengths(chain, np.array([basis @ one for one in tried]), near)
        strategy.tell(asked, (lengths + blocked).tolist())
        k = int(np.argmin(lengths + blocked))
        if blocked[k] == 0.0 and lengths[k] < least:
            shorter.append((float(lengths[k]), tried[k]))
        if strategy.stop():
            break
    # All points are looked at in the end: most of these are on the way to a shorter one.
    shorter.sort(key=lambda item: item[0])
    return next((one for _, one in shorter if free_share(chain, start, one) == 1.0), waypoints)


def _lengths(chain: ClosedChain, paths: Array, near: tuple[Array, Array]) -> tuple[Array, Array]:
    """Compute the length of k paths in the joint space of both arms, and a cost of their blocked
    parts.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        paths: (k, n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
        near: joint positions (n, joints) of each arm along a similar path, from which the solution
            starts [rad or m].

    Returns:
        - Lengths (k,) [rad].
        - Costs (k,) [rad], which grow with the share of poses that an arm cannot hold or that
          collide; 0 if there are none.
    """
    k, n, size = paths.shape
    begin = np.tile(near[0], (k, 1)), np.tile(near[1], (k, 1))
    flat = paths.reshape(-1, size)
    q, closed = chain.close_many(flat, begin)
    steps = np.diff(np.hstack(q).reshape(k, n, -1), axis=1)
    closed &= np.abs(np.hstack(q) - np.hstack(begin)).max(axis=1) <= JUMP
    hit = np.zeros(k * n, dtype=bool)
    hit[closed] = chain.blocked(flat[closed, :POSE_SIZE], (q[0][closed], q[1][closed]))
    lost, met = ((~closed).reshape(k, n).mean(axis=1), hit.reshape(k, n).mean(axis=1))
    return np.linalg.norm(steps, axis=2).sum(axis=1), BLOCKED * (lost + met / 2.0)


def free_share(chain: ClosedChain, start: ChainConfiguration, waypoints: Array) -> float:
    """Compute which share of a spline both arms can follow, from 0 to 1: the share before the first
    collision, or before the first pose at which an arm cannot hold the box.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        start: configuration at the first waypoint.
        waypoints: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
    """
    legs = [distance(a, b) for a, b in pairwise(waypoints)]
    n = max(LEAST_SAMPLES, int(np.ceil(1.2 * sum(legs) / PATH_STEP)))
    path = path_basis(len(waypoints), np.linspace(0.0, 1.0, n)).position @ waypoints
    return sum(1 for _ in chain.along(start, path)) / n
