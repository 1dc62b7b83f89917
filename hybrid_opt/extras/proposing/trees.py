"""Two trees of straight motions that grow towards each other until they meet.

This is RRT-Connect (Kuffner and LaValle, ICRA 2000) with many motions at once: one tree grows
towards random points, then the other one towards all its new points. Checking many motions together
takes much less time than one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array

TARGETS_TOGETHER = 64
"""Number of random points towards which a tree grows in one step."""

Configuration = TypeVar("Configuration")
"""What is known at a point beside its coordinates, such as the joint positions of both arms."""

Join = Callable[[Sequence[Configuration], Array], Sequence[Configuration | None]]
"""Function that follows k straight motions, from known configurations to points (k, d). It returns
the configurations there, None for motions that are not free."""


def connect(
    ends: tuple[tuple[Array, Sequence[Configuration]], tuple[Array, Sequence[Configuration]]],
    longest: float,
    draw: Callable[[int], Array],
    join: Join[Configuration],
    same: Callable[[Configuration, Configuration], bool],
    ended: Callable[[], bool],
) -> list[Configuration] | None:
    """Find a path of free straight motions between two sets of points by RRT-Connect.

    Args:
        ends: points (n, d) at which the path may begin, with their configurations, and those at
            which it may end.
        longest: length of the longest motion by which a tree grows, in the unit of the points.
        draw: function that returns a given number k of random points (k, d).
        join: function that follows straight motions, see `Join`.
        same: function that returns True if two configurations at one point are the same.
        ended: function that returns True if the search has to end.

    Returns:
        The configurations at the corners of the path, both ends included; None if no path is found.
    """
    trees, grows = [_Tree(*end, longest, join) for end in ends], 0
    while not ended():
        own, other = trees[grows], trees[1 - grows]
        targets = draw(TARGETS_TOGETHER)
        new, _ = own.grow(own.nearest(targets), targets)
        met = _meeting(own, other, new, same, ended)
        if met is not None:
            ways = own.way(met[0]), other.way(met[1])
            first, last = ways if grows == 0 else ways[::-1]
            return [*first, *last[-2::-1]]
        grows = 1 - grows
    return None


class _Tree(Generic[Configuration]):
    """Points that are reached from roots.

    Attributes:
        points: (n, d) the points, roots first.
        configurations: configuration at each point.
    """

    def __init__(
        self,
        roots: Array,
        configurations: Sequence[Configuration],
        longest: float,
        join: Join[Configuration],
    ) -> None:
        self.points, self.configurations = roots, list(configurations)
        self._parents = [-1] * len(self.configurations)
        self._longest, self._join = longest, join

    def nearest(self, wanted: Array) -> NDArray[np.intp]:
        """Return the index (k,) of the point nearest to each of k points (k, d)."""
        squares = np.sum(self.points**2, axis=1) - 2.0 * wanted @ self.points.T
        return np.asarray(np.argmin(squares, axis=1))

    def grow(
        self, begins: NDArray[np.intp], targets: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Grow the tree by one motion from each of k of its points, straight towards a target and
        at most as long as the longest motion. Motions that are not free add no point.

        Args:
            begins: (k,) indices of the points.
            targets: (k, d) the targets.

        Returns:
            Indices (n,) of the new points in the tree; and for each of them the index (n,) of its
            target.
        """
        away = targets - self.points[begins]
        share = self._longest / np.maximum(np.linalg.norm(away, axis=1), self._longest)
        points = np.where(share[:, None] < 1.0, targets - (1.0 - share[:, None]) * away, targets)
        found = list(self._join([self.configurations[k] for k in begins.tolist()], points))
        free = np.array([k for k, one in enumerate(found) if one is not None], dtype=np.intp)
        first = len(self.configurations)
        self.points = np.vstack([self.points, points[free]])
        self.configurations += [one for one in found if one is not None]
        self._parents += begins[free].tolist()
        return np.arange(first, len(self.configurations)), free

    def way(self, index: int) -> list[Configuration]:
        """Return the configurations from a root to the point with an index."""
        found = []
        while index >= 0:
            found.append(self.configurations[index])
            index = self._parents[index]
        return found[::-1]


def _meeting(
    own: _Tree[Configuration],
    other: _Tree[Configuration],
    new: NDArray[np.intp],
    same: Callable[[Configuration, Configuration], bool],
    ended: Callable[[], bool],
) -> tuple[int, int] | None:
    """Grow one tree, motion after motion, towards the new points of the other tree, until it
    reaches one of them or no motion is free.

    Args:
        own: tree that got the new points.
        other: tree that grows towards them.
        new: (n,) indices of the new points in `own`.
        same: function that returns True if two configurations at one point are the same.
        ended: function that returns True if the search has to end.

    Returns:
        Index in `own` and index in `other` of the point at which the trees meet; None if they do
        not meet.
    """
    begins = other.nearest(own.points[new])
    while len(new) and not ended():
        begins, kept = other.grow(begins, own.points[new])
        new = new[kept]
        there = np.all(other.points[begins] == own.points[new], axis=1)
        for a, b in zip(new[there].tolist(), begins[there].tolist(), strict=True):
            if same(own.configurations[a], other.configurations[b]):
                return a, b
        begins, new = begins[~there], new[~there]
    return None


def inner_points(counts: NDArray[np.intp]) -> list[tuple[NDArray[np.intp], Array]]:
    """Return the inner points of k motions in the order in which they are best checked for
    collisions: first a point near the middle of each motion, then all others.

    Args:
        counts: (k,) number of equal parts into which each motion is divided.

    Returns:
        Two sets of n points, each as the index (n,) of the motion, and the place (n,) on the
        motion, from 0 at its beginning to 1 at its end.
    """
    which = np.repeat(np.arange(len(counts)), np.maximum(counts - 1, 0))
    first = np.concatenate([[0], np.cumsum(np.maximum(counts - 1, 0))])[:-1]
    number = 1 + np.arange(len(which)) - first[which]
    share, middle = number / counts[which], number == counts[which] // 2
    return [(which[chosen], share[chosen]) for chosen in (middle, ~middle)]
