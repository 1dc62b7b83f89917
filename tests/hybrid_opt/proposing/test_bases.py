"""Where a machine may stand before a shelf."""

from __future__ import annotations

import time

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.proposing.bases import base_choices, draft_of, machine_places
from hybrid_opt.proposing.places import PlaceScorer, shared_room
from hybrid_opt.proposing.problem import Problem, read_problem
from symbolic.array import Array
from tests.hybrid_opt.proposing.problems import tiago_problem

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
    settings = ho.ProposeSettings(bases=True, clock=time.process_time)
    found = ho.propose(problem.source, rng=np.random.default_rng(1), settings=settings)
    assert found.judgement.feasible
    assert found.seconds <= settings.seconds
