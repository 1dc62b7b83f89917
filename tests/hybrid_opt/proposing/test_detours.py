"""Ways around of the box alone; the oracle compares its edges with those of level boxes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.proposing.detours import ASIDE, LIFT, POSES, free_detours
from symbolic.array import Array
from symbolic.records import Body, Box, Workcell
from symbolic.records.poses import pose_matrix
from tests.symbolic.cells import hand_cell

START, GOAL = np.array([0.0, 0, 0.7, 0, 0, 0]), np.array([0.0, 0, 1.1, 0, 0, 0.2])
SHELF = {
    "lower board": ([0.0, 0.0, 0.56], [0.3, 0.3, 0.02]),
    "upper board": ([0.0, 0.0, 0.95], [0.3, 0.3, 0.02]),
    "back": ([0.25, 0.0, 0.8], [0.02, 0.3, 1.4]),
}
"""Middles and edges [m]: open to -x and to both sides."""


def cell_with(bodies: dict[str, tuple[list[float], list[float]]]) -> Workcell:
    environment = tuple(
        Body(name, Box(np.array(size)), pose_matrix(np.array(middle), np.zeros(3)))
        for name, (middle, size) in bodies.items()
    )
    return replace(hand_cell(), environment=environment)


def meets(pose: Array, size: Array) -> bool:
    """Whether a level box of these edges meets the shelf."""
    return any(
        bool(np.all(np.abs(pose[:3] - middle) < (size + edges) / 2.0))
        for middle, edges in SHELF.values()
    )


def test_without_obstacles_every_detour_is_free() -> None:
    found = free_detours(cell_with({}), START, GOAL)
    assert found.shape == (1 + 9 * len(ASIDE), POSES, 6)
    np.testing.assert_allclose(found[:, 0], np.tile(START, (len(found), 1)))
    np.testing.assert_allclose(found[:, -1], np.tile(GOAL, (len(found), 1)))
    away = np.linalg.norm(found[:, :, :2], axis=2).max(axis=1)
    # Some poses stand a little beside the corner.
    assert away[0] == 0.0
    assert away.max() == pytest.approx(max(ASIDE), abs=0.02)
    assert found[:, :, 2].max() == pytest.approx(GOAL[2] + LIFT + max(ASIDE), abs=0.05)


def test_what_is_left_leads_around_the_shelf() -> None:
    goal = GOAL * [1, 1, 1, 1, 1, 0]  # level, as the oracle wants it
    cell = cell_with(SHELF)
    every, found = free_detours(cell_with({}), START, goal), free_detours(cell, START, goal)
    size = cell.payload.size
    ends = (START, goal)
    expected = [
        path
        for path in every
        if not any(
            meets(pose, size)
            for pose in path
            if min(np.abs(pose - end).max() for end in ends) >= LIFT
        )
    ]
    np.testing.assert_array_equal(found, np.array(expected))
    farthest = found[np.arange(len(found)), np.abs(found[:, :, :2]).sum(axis=2).argmax(axis=1)]
    assert 0 < len(found) < len(every) / 3
    assert np.all(farthest[:, 0] < 0.1), "through the back"


def test_there_may_be_none() -> None:
    walls = {"wall": ([0.0, 0.0, 0.9], [2.0, 2.0, 0.02])}
    assert free_detours(cell_with(walls), START, GOAL).shape == (0, POSES, 6)
