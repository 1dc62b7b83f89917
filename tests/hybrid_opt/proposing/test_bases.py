"""Where a machine may stand before a shelf."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.proposing.bases import (
    ASIDE,
    LIFT,
    POSES,
    PlaceScorer,
    base_choices,
    draft_of,
    free_detours,
    machine_places,
    shared_room,
)
from hybrid_opt.proposing.problem import Problem, read_problem
from symbolic.array import Array
from symbolic.records import Body, Box, Workcell
from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.proposing.problems import tiago_problem
from tests.symbolic.cells import hand_cell

pytestmark = pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")

SPINS: Array = 2.0 * np.pi * np.arange(12.0) / 12.0


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return read_problem(tiago_problem(tmp_path_factory.mktemp("tiago")))


def at(x: float) -> Array:
    return np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_a_machine_stands_where_its_arms_reach(problem: Problem) -> None:
    """With its left hand on the left it looks along x, before the tote; else against it."""
    for side in problem.sides()[2:]:
        left = np.array(side.contacts[0]["xyz"])
        assert left[1] != 0.0
        for base in machine_places(side, draft_of(side)):
            across = [-np.sin(base[5]), np.cos(base[5]), 0.0]
            assert left @ across > 0.0
            ahead = np.array([np.cos(base[5]), np.sin(base[5])])
            assert (np.array([0.6, 0.0]) - base[:2]) @ ahead > 0.2


def test_too_near_there_is_no_room_and_in_the_shelf_no_place(problem: Problem) -> None:
    (side,) = (s for s in problem.sides() if s.contacts[0]["xyz"] == [0.0, 0.18, 0.0])
    scorer = PlaceScorer(side, draft_of(side), SPINS, np.random.default_rng(1))
    rooms = []
    for x in (0.07, 0.20):
        arms = [scorer.place(arm, at(x)) for arm in (0, 1)]
        assert arms[0] is not None
        assert arms[1] is not None
        rooms.append(shared_room(arms[0], arms[1]))
    assert rooms[0] > rooms[1]
    assert scorer.place(0, at(0.6)) is None
    assert scorer.place(0, at(-1.5)) is None, "out of reach"


@pytest.mark.slow
def test_a_machine_without_a_place_gets_a_carry(problem: Problem) -> None:
    """The best places are before the shelf: behind it, its back is in the way."""
    choices = base_choices(problem, SPINS, np.random.default_rng(1))
    assert all(-0.1 < choice["robots"][0]["base"]["xyz"][0] < 0.1 for choice in choices[:2])
    settings = ho.ProposeSettings(bases=True)
    found = ho.propose(problem.source, rng=np.random.default_rng(1), settings=settings)
    assert found.judgement.feasible
    assert found.seconds <= settings.seconds


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
