"""The problems that ship: each can be read and held, and in the night each gets a carry."""

from __future__ import annotations

from pathlib import Path

import pytest

import hybrid_opt as ho
from hybrid_opt.extras.proposing.problem import read_problem
from studies.research.problems import attempt, shipped_problems

PROBLEMS = [pytest.param(path, id=path.stem) for path in shipped_problems()]


def test_all_problems_that_ship_are_read() -> None:
    assert len([read_problem(path) for path in shipped_problems()]) == 17


@pytest.mark.slow
@pytest.mark.parametrize("path", PROBLEMS)
@pytest.mark.filterwarnings("ignore:.*not watertight")
def test_every_problem_that_ships_can_be_held_at_rest(path: Path) -> None:
    """Its reference force allows what the usual uncertainty needs."""
    assert ho.grip_budget(read_problem(path).workcell()).fits


@pytest.mark.slow
@pytest.mark.parametrize("path", PROBLEMS)
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.filterwarnings("ignore:.*not watertight")
def test_every_problem_that_ships_gets_a_carry(path: Path, seed: int) -> None:
    found = attempt(path, seed, 120.0, 0)
    assert found.certified is not None, found.problem_met
