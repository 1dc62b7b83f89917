"""A tournament of starts: better than each of them, and it leaves those that arrived."""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.drivable.point import Climb
from hybrid_opt.polishing.drivable.timed import Goal
from hybrid_opt.polishing.drivable.tournament import best_of
from tests.hybrid_opt.polishing.drivable.cells import evaluator, polisher, start, tilted

FORCE = 55.0
GOAL = Goal("duration", FORCE)
ROUNDS = 8


def test_the_answer_is_feasible_and_better_than_any_start_after_a_turn() -> None:
    """Of an upright path, a tilted one, and a fast one that touches a board and cannot leave it."""
    solver = polisher(ROUNDS).drivable
    sunk = tilted(FORCE)
    sunk[[2, 8, 14]] -= 0.2
    starts = [start(FORCE), tilted(FORCE), sunk]
    turn, levels = solver.settings.drivable.turn, []
    for x in starts:
        climb = Climb(solver, x, GOAL)
        climb.go_on(turn)
        if evaluator().evaluate(climb.x).feasible[0]:
            levels.append(climb.level)
    found = best_of(solver, starts, GOAL)
    assert evaluator().evaluate(found.x).feasible[0]
    assert solver.judge.timed(found.x[:-1], GOAL).duration <= min(levels)
    assert 3 * turn <= found.rounds <= 5 * turn + 2 * ROUNDS


def test_one_of_two_starts_in_one_basin_goes_on() -> None:
    solver = polisher(ROUNDS).drivable
    x = tilted(FORCE)
    nearby = x.copy()
    nearby[0] += 1e-3
    turn = solver.settings.drivable.turn
    assert best_of(solver, (x, nearby), GOAL).rounds <= 2 * turn + ROUNDS


def test_a_climb_that_is_left_goes_on_as_if_it_had_not_been() -> None:
    solver = polisher(ROUNDS).drivable
    whole, parts = Climb(solver, start(FORCE), GOAL), Climb(solver, start(FORCE), GOAL)
    whole.go_on(6)
    parts.go_on(2)
    parts.go_on(4)
    np.testing.assert_array_equal(whole.x, parts.x)
    assert whole.solution.rounds == parts.solution.rounds
