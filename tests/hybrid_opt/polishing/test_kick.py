"""Kicks: feasible candidates elsewhere, the best of many."""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.kick import kicked
from hybrid_opt.polishing.settings import KickSettings
from symbolic.records.task import initial_decision
from tests.hybrid_opt.polishing.test_front import evaluator

SETTINGS = KickSettings(candidates=400)


def test_a_kick_is_feasible_far_away_and_the_same_for_the_same_seed() -> None:
    x = initial_decision(evaluator().workcell.task)
    for objective in (0, 1):
        found = kicked(evaluator(), SETTINGS, x, objective, np.random.default_rng(3))
        again = kicked(evaluator(), SETTINGS, x, objective, np.random.default_rng(3))
        assert found is not None
        assert again is not None
        candidate, objectives = found
        np.testing.assert_array_equal(candidate, again[0])
        judged = evaluator().evaluate(candidate)
        assert judged.feasible[0]
        np.testing.assert_array_equal(judged.objectives[0], objectives)
        moved = np.abs(candidate - x) / (evaluator().upper - evaluator().lower)
        assert moved.max() > SETTINGS.distance
        assert (moved == 0.0).sum() > evaluator().n_var / 2


def test_more_candidates_are_no_worse() -> None:
    x = initial_decision(evaluator().workcell.task)
    everywhere = KickSettings(candidates=400, distance=0.0)
    found = kicked(evaluator(), everywhere, x, 0, np.random.default_rng(4))
    assert found is not None
    assert found[1][0] <= evaluator().evaluate(x).objectives[0, 0]


def test_where_nothing_else_is_feasible_there_is_none() -> None:
    x, everything = evaluator().lower, KickSettings(candidates=3, share=0.0)
    assert kicked(evaluator(), everything, x, 0, np.random.default_rng(0)) is None
