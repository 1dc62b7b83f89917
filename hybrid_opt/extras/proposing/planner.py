"""A collision-free path of the box with both arms, over the closed chain.

First straight motions are tried: out of the start, across, into the goal. If none is free, trees
of straight motions (`trees.py`) grow from every pose that straight motions out of start and goal
reach. Both move in the coordinates of the box path, which the later spline has too, and not in
joint coordinates. The joints of both arms follow and stay on their branches; they are stored with
every pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations, product

import numpy as np

from hybrid_opt.extras.proposing.closed_chain import (
    MATCH,
    PATH_STEP,
    ChainConfiguration,
    ClosedChain,
    distance,
    metric_weights,
)
from hybrid_opt.extras.proposing.trees import connect
from hybrid_opt.extras.proposing.trial import PayloadSceneChecker
from symbolic.array import Array
from symbolic.records import POSE_SIZE

RETREAT = 0.6
"""Largest length of a straight motion out of the start or the goal [m]."""

SHORT_RETREAT = 0.06
"""Smallest useful length of such a motion [m]."""

DIRECTIONS = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
"""Directions of straight motions out of start and goal: along the world's axes and between them."""

RETREAT_STOPS = 4
"""Every so many configurations of a retreat the box may rotate to the pose of the other end."""

STRAIGHT_TRIED = 100
"""Largest number of straight motions of the box between two retreats that are tried with the
arms."""

LINE_SHARES = np.array([0.5, 0.25, 0.75, 0.375, 0.625, 0.125, 0.875])
"""Positions on such a motion at which the box alone is checked first."""

REDUNDANT_ASIDE = 5.0
"""Distance by which redundant joints may deviate per metre of deviation of the box [rad/m]."""


@dataclass(frozen=True)
class AffineSubspace:
    """A bounded set in which a path is searched: the vectors origin + directions @ y with bounds of
    y.

    A vector is a box pose followed by m redundant joints. A coordinate y has d entries.

    Attributes:
        origin: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        directions: (6 + m, d) basis. Its scale makes the Euclidean distance between two coordinates
            equal to the `distance` of their vectors.
        lower, upper: (d,) bounds of y [m].
        range: longest motion by which trees grow [m].
    """

    origin: Array
    directions: Array
    lower: Array
    upper: Array
    range: float

    def extended(self, y: Array) -> Array:
        """Convert a coordinate of the subspace to the box pose [m, rad] followed by the m redundant
        joints [rad or m], (6 + m,).

        Args:
            y: (d,) coordinate [m].
        """
        return np.asarray(self.origin + self.directions @ y)

    def coordinates(self, extended: Array) -> Array:
        """Convert a box pose with redundant joints to the coordinate (d,) [m] of the nearest vector
        of the subspace.

        Args:
            extended: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        """
        return np.asarray(np.linalg.pinv(self.directions) @ (extended - self.origin))


@dataclass(frozen=True)
class Corridor:
    """Limits on the deviation of a path from the straight motion.

    Attributes:
        tilt: largest rotation of the box away from the straight interpolation between the angles of
            start and goal [rad]; 0 allows none.
        range: longest motion by which trees grow [m].
        aside: largest distance of the box beyond start and goal along each axis of the world [m].
        towards: -1, 0 or 1 for each axis of the world: the direction in which the box may leave the
            range between start and goal; None for all directions.
    """

    tilt: float
    range: float
    aside: float
    towards: tuple[int, int, int] | None = None


def search_subspace(start: Array, goal: Array, stray: Corridor, limits: Array) -> AffineSubspace:
    """Compute the bounded set of box poses and redundant joints in which a planner searches a path.

    If the corridor allows no tilt, the box may rotate only as on the straight motion; otherwise
    each angle varies on its own.

    Args:
        start, goal: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        stray: allowed deviation from the straight motion; redundant joints may deviate
            `REDUNDANT_ASIDE` times as far.
        limits: (m, 2) lower and upper limit of each redundant joint [rad or m].
    """
    size, weight, tilt = len(start), metric_weights(len(start)), stray.tilt
    aside = np.full(size, stray.aside)
    aside[POSE_SIZE:] *= REDUNDANT_ASIDE
    less, more = aside.copy(), aside.copy()
    if stray.towards is not None:
        less[:3] *= np.less(stray.towards, 0)
        more[:3] *= np.greater(stray.towards, 0)
    lower, upper = np.minimum(start, goal) - less, np.maximum(start, goal) + more
    lower[POSE_SIZE:] = np.maximum(lower[POSE_SIZE:], limits[:, 0])
    upper[POSE_SIZE:] = np.minimum(upper[POSE_SIZE:], limits[:, 1])
    columns, low, high = [], [], []
    turn = (goal - start) * ((np.arange(size) >= 3) & (np.arange(size) < 6))
    length = float(np.linalg.norm(weight * turn))
    for k in range(size):
        angle = 3 <= k < 6
        if angle and tilt == 0.0:
            continue
        column = np.zeros(size)
        column[k] = 1.0 / weight[k]
        least = min(start[k], goal[k]) - tilt if angle else lower[k]
        most = max(start[k], goal[k]) + tilt if angle else upper[k]
        columns.append(column)
        low.append(weight[k] * (least - start[k]))
        high.append(weight[k] * (most - start[k]))
    if tilt == 0.0 and length > 0.0:
        columns.append(turn / length)
        low.append(0.0)
        high.append(length)
    bounds = np.array(low) - 1e-9, np.array(high) + 1e-9
    return AffineSubspace(start, np.column_stack(columns), *bounds, stray.range)


Retreats = tuple[list[list[ChainConfiguration]], list[list[ChainConfiguration]]]
"""Free configurations from the start, and from the goal, along the same directions, in order,
beginning with the end itself."""


def retreats(chain: ClosedChain, ends: tuple[ChainConfiguration, ChainConfiguration]) -> Retreats:
    """Find straight collision-free motions of the box out of its start and out of its goal, for
    instance out of a shelf.

    Directions are the world's axes and the diagonals between them.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        ends: configurations at the start and at the goal.

    Returns:
        For the start, then for the goal: a list of configurations along each direction, from the
        end itself to the last one before a collision.
    """
    ways = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    begins = [each for each in ends for _ in ways]
    away = np.array([each.extended for each in begins])
    away[:, :3] += RETREAT * np.tile(ways, (len(ends), 1))
    steps = round(RETREAT / PATH_STEP)
    paths = np.linspace([each.extended for each in begins], away, steps + 1, axis=1)
    found = chain.along_many(begins, paths)
    return found[: len(ways)], found[len(ways) :]


def straight_paths(
    chain: ClosedChain, out: Retreats, box: PayloadSceneChecker
) -> Iterator[list[ChainConfiguration]]:
    """Yield collision-free paths of three straight motions, shorter ones first.

    The motions are a retreat from the start, a motion across, and the reverse of a retreat from the
    goal. Both retreats have the same direction, or two different axes of the world as directions.
    At most one path is yielded for each pair of directions.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        out: result of `retreats`: configurations along straight motions out of start and goal.
        box: collision checker of the box alone.

    Yields:
        Configurations at the four corners of a path.
    """
    ways: dict[tuple[bytes, bytes], tuple[float, tuple[int, int], list[ChainConfiguration]]] = {}
    axes = np.flatnonzero(np.count_nonzero(DIRECTIONS, axis=1) == 1)
    same_way = [(k, k) for k in range(len(DIRECTIONS))]
    for along in (*same_way, *permutations(axes.tolist(), 2)):
        first, last = out[0][along[0]], out[1][along[1]]
        for a, b in product(first[::RETREAT_STOPS], last[::RETREAT_STOPS]):
            corners = [first[0], a, b, last[0]]
            length = sum(distance(p.extended, q.extended) for p, q in pairwise(corners))
            ways.setdefault((a.extended.tobytes(), b.extended.tobytes()), (length, along, corners))
    tried, done = 0, set[tuple[int, int]]()
    for _, along, corners in sorted(ways.values(), key=lambda way: way[0]):
        begin, end = corners[1].extended, corners[2].extended
        if along in done or box.is_between(begin[:POSE_SIZE], end[:POSE_SIZE], LINE_SHARES):
            continue
        there = chain.reach(corners[1], end)
        tried += 1
        if there is not None and same(there, corners[2]):
            done.add(along)
            tried = 0
            yield corners
        elif tried == STRAIGHT_TRIED:
            return


def plan(
    chain: ClosedChain,
    out: Retreats,
    room: AffineSubspace,
    *,
    most: int,
    out_of_time: Callable[[], bool],
    rng: np.random.Generator,
) -> list[ChainConfiguration] | None:
    """Find a collision-free path of the box and both arms from start to goal by RRT-Connect.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        out: result of `retreats`: configurations along straight motions out of start and goal.
            Their last ones are further roots of both trees.
        room: box poses and redundant joints that the path may use.
        most: number of checked configurations after which the search ends.
        out_of_time: function that returns True if no time is left.
        rng: generator of random poses.

    Returns:
        Configurations at the corners of the path, between which the box moves straight; None if no
        path is found.
    """
    roots = [[ways[0][0], *_usable([way[-1] for way in ways], ways[0][0], room)] for ways in out]
    first, last = (
        (np.array([room.coordinates(stop.extended) for stop in stops]), stops) for stops in roots
    )

    def join(
        begins: Sequence[ChainConfiguration], points: Array
    ) -> list[ChainConfiguration | None]:
        return chain.reach_many(begins, room.origin + points @ room.directions.T)

    until = chain.looked + most
    path = connect(
        (first, last),
        room.range,
        lambda count: rng.uniform(room.lower, room.upper, (count, len(room.lower))),
        join,
        same,
        lambda: chain.looked >= until or out_of_time(),
    )
    if path is None:
        return None
    found = [roots[0][0], *path, roots[1][0]]
    return [each for k, each in enumerate(found) if k == 0 or each is not found[k - 1]]


def _usable(
    stops: list[ChainConfiguration], end: ChainConfiguration, room: AffineSubspace
) -> list[ChainConfiguration]:
    """Select the ends of retreats that can serve as roots of a planner's tree: they lie in the
    searched set, at least `SHORT_RETREAT` away from the end of the carry.

    Args:
        stops: last configuration of each retreat.
        end: configuration at this end of the carry, the start or the goal.
        room: the searched set.

    Returns:
        The selected configurations.
    """
    at = [room.coordinates(stop.extended) for stop in stops]
    return [
        stop
        for stop, y in zip(stops, at, strict=True)
        if distance(end.extended, stop.extended) >= SHORT_RETREAT
        and bool(np.all((y >= room.lower) & (y <= room.upper)))
    ]


def same(first: ChainConfiguration, second: ChainConfiguration) -> bool:
    """Return True if the joint positions of both arms agree within `MATCH` in two configurations.

    Args:
        first: a configuration.
        second: another configuration.
    """
    apart = [np.abs(a - b).max() for a, b in zip(first.q, second.q, strict=True)]
    return bool(max(apart) < MATCH)
