"""Paths between two sets of points in the plane, past a wall with a slit."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from hybrid_opt.extras.proposing.trees import connect, inner_points
from symbolic.array import Array

STEPS = 10_000
"""Number of motions after which a search ends."""


class Wall:
    """A wall at x = 0 with a slit around y = 0.3; a configuration is the point itself."""

    def __init__(self, width: float) -> None:
        self.width, self.asked = width, 0

    def free(self, begin: Array, end: Array) -> bool:
        """True if the segment does not cross the wall, exactly."""
        if (begin[0] < 0.0) == (end[0] < 0.0):
            return True
        share = begin[0] / (begin[0] - end[0])
        return bool(abs(begin[1] + share * (end[1] - begin[1]) - 0.3) < self.width / 2.0)

    def join(self, begins: Sequence[Array], ends: Array) -> list[Array | None]:
        self.asked += len(begins)
        return [end if self.free(a, end) else None for a, end in zip(begins, ends, strict=True)]

    def path(self, seed: int, first: Array, last: Array, same: bool = True) -> list[Array] | None:
        rng = np.random.default_rng(seed)
        return connect(
            ((first, list(first)), (last, list(last))),
            0.15,
            lambda count: rng.uniform(-1.0, 1.0, (count, 2)),
            self.join,
            lambda one, other: same,
            lambda: self.asked >= STEPS,
        )


LEFT, RIGHT = np.array([[-0.9, -0.9]]), np.array([[0.9, -0.8], [0.8, 0.9]])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_path_leads_through_a_slit(seed: int) -> None:
    wall = Wall(0.02)
    path = wall.path(seed, LEFT, RIGHT)
    assert path is not None
    np.testing.assert_array_equal(path[0], LEFT[0])
    assert any(np.array_equal(path[-1], end) for end in RIGHT)
    for begin, end in pairwise(path):
        assert wall.free(begin, end)
        assert 0.0 < np.linalg.norm(end - begin) <= 0.15 + 1e-12
    back = wall.path(seed, RIGHT, LEFT)
    assert back is not None
    np.testing.assert_array_equal(back[-1], LEFT[0])


def test_no_path_is_told_without_a_slit_or_where_configurations_differ() -> None:
    assert Wall(0.0).path(1, LEFT, RIGHT) is None
    assert Wall(0.5).path(1, LEFT, RIGHT, same=False) is None


def test_inner_points_are_all_points_between_ends_the_middles_first() -> None:
    counts = np.array([1, 2, 5, 3])
    sets = inner_points(counts)
    assert [list(which) for which, _ in sets] == [[1, 2, 3], [2, 2, 2, 3]]
    found = sorted(
        (int(k), float(u)) for which, share in sets for k, u in zip(which, share, strict=True)
    )
    wanted = sorted((k, i / n) for k, n in enumerate(counts.tolist()) for i in range(1, n))
    np.testing.assert_allclose(found, wanted)
