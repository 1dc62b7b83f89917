"""The polish of a front of duration against force: the front door, resume, what it refuses."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.drivable.front import DrivablePolisher
from hybrid_opt.polishing.polisher import polisher_for
from hybrid_opt.polishing.records import PolishedFront, outcome_from_json, outcome_to_json
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from tests.hybrid_opt.polishing.drivable.cells import (
    drivable_rack,
    evaluator,
    functions,
    polisher,
    start,
)

BOUND = np.full(2, 1.1)

ROUNDS = 8
"""Of each point: enough to get better."""


def starts() -> Array:
    return np.array([start(51.0), start(55.0, seed=1)])


@cache
def polished() -> PolishedFront:
    return polisher(ROUNDS).polish(starts(), np.random.default_rng(0))


def test_the_front_dominates_more_than_before() -> None:
    before = evaluator().evaluate(starts()).objectives
    after = evaluator().certified(evaluator().evaluate(polished().x))
    assert after.feasible.all()
    np.testing.assert_array_equal(after.objectives, polished().objectives)
    assert metrics.hypervolume(after.objectives, BOUND) > metrics.hypervolume(before, BOUND) + 0.01
    assert any(outcome.status == "accepted" for outcome in polished().outcomes)


def test_a_polish_goes_on_where_it_was_interrupted() -> None:
    written = [outcome_to_json(outcome) for outcome in polished().outcomes[:2]]
    recorded = [outcome_from_json(values) for values in written]
    again = polisher(ROUNDS).polish(starts(), np.random.default_rng(0), recorded=recorded)
    np.testing.assert_array_equal(again.x, polished().x)
    np.testing.assert_array_equal(again.objectives, polished().objectives)


def test_an_empty_front_stays_empty() -> None:
    assert len(polisher(ROUNDS).polish(np.empty((0, 19)), np.random.default_rng(0)).x) == 0


def test_the_time_law_chooses_the_polish() -> None:
    found = polisher_for(evaluator(), PolishSettings(attempts=1), functions())
    assert isinstance(found, DrivablePolisher)


def test_other_objectives_are_refused() -> None:
    other = CandidateEvaluator(
        drivable_rack(), ("duration", "mean_force"), compiled=evaluator().compiled
    )
    with pytest.raises(SettingsError, match="switch the polish off"):
        DrivablePolisher(other, PolishSettings(), functions())
