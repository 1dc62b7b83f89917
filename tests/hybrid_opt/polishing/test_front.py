"""The polish of fronts of the rack: better, never worse, believed only after re-evaluation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing import front as front_module
from hybrid_opt.polishing.attempt import Lost
from hybrid_opt.polishing.front import FrontPolisher, polish_front
from hybrid_opt.polishing.point import PolishSolver, Solution, SolveStart
from hybrid_opt.polishing.records import (
    PolishedFront,
    PolishOutcome,
    outcome_from_json,
    outcome_to_json,
)
from hybrid_opt.polishing.settings import FillSettings, PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records.task import initial_decision
from tests.symbolic.read.samples import RACK

SETTINGS = PolishSettings(attempts=7, fill=FillSettings(attempts=1))
PATIENT = PolishSettings(attempts=1, rounds=25, max_iterations=80)


@cache
def evaluator() -> CandidateEvaluator:
    return CandidateEvaluator(load(RACK))


@cache
def start_front() -> Array:
    """Non-dominated random candidates."""
    rng = np.random.default_rng(5)
    x = rng.uniform(evaluator().lower, evaluator().upper, (600, evaluator().n_var))
    found = evaluator().certified(evaluator().evaluate(x))
    return np.asarray(x[metrics.non_dominated(found.objectives, found.feasible)])


@cache
def polisher() -> FrontPolisher:
    return FrontPolisher(evaluator(), SETTINGS)


@cache
def polished() -> PolishedFront:
    return polisher().polish(start_front(), np.random.default_rng(0))


def objectives_of(x: Array) -> Array:
    return evaluator().evaluate(x).objectives


def test_the_front_gets_better_and_no_point_is_lost() -> None:
    before, after = objectives_of(start_front()), polished().objectives
    assert metrics.hypervolume(after) > metrics.hypervolume(before)
    for point in before:
        assert np.any(np.all(after <= point, axis=1))
    assert metrics.non_dominated(after).all()


def test_points_of_the_front_never_get_worse() -> None:
    own = [o for o in polished().outcomes if o.aim == "point"]
    assert own
    for outcome in own:
        assert np.all(outcome.objectives <= outcome.start + SETTINGS.tolerance)
    assert sum(o.status in ("accepted", "optimal") for o in own) >= 0.9 * len(own)
    assert polished().success_share == pytest.approx(
        np.mean([o.status in ("accepted", "optimal") for o in own])
    )


def test_every_point_is_feasible_for_the_full_evaluator_and_certified() -> None:
    found = evaluator().certified(evaluator().evaluate(polished().x))
    assert found.feasible.all()
    np.testing.assert_array_equal(found.objectives, polished().objectives)


def test_residuals_of_accepted_points_are_told() -> None:
    accepted = [o for o in polished().outcomes if o.status == "accepted"]
    # Whatever a program asked for beyond that, what is accepted holds.
    found = evaluator().evaluate(np.array([outcome.x for outcome in accepted]))
    assert found.feasible.all()
    np.testing.assert_array_equal(found.objectives, [o.objectives for o in accepted])
    for outcome in accepted:
        residuals = outcome.residuals
        # Feasibility may be large where the last step was a part of a refused one.
        assert np.isfinite([residuals.stationarity, residuals.feasibility]).all()
        assert outcome.iterations > 0


def test_with_time_a_point_becomes_stationary() -> None:
    patient = FrontPolisher(evaluator(), replace(PATIENT, fill=FillSettings(attempts=0)))
    start = initial_decision(evaluator().workcell.task)[None]
    outcomes = patient.polish(start, np.random.default_rng(0)).outcomes
    (outcome,) = [o for o in outcomes if o.aim == "point"]
    assert outcome.status == "accepted"
    assert outcome.residuals.stationarity < 1e-4
    assert outcome.residuals.feasibility < 1e-6
    assert outcome.residuals.complementarity < 1e-4


def test_what_it_cost_is_told_in_evaluations() -> None:
    result = polished()
    assert result.seconds > 0.0
    assert result.equivalent_evaluations == pytest.approx(
        result.seconds / result.evaluation_seconds, abs=1.0
    )
    ends_and_middle = 3
    most = SETTINGS.attempts * (1 + 2 * SETTINGS.fill.attempts) + ends_and_middle
    beside_probes = sum(o.aim != "probe" for o in result.outcomes)
    assert SETTINGS.attempts < beside_probes <= most
    assert sum(o.status == "accepted" for o in result.outcomes) == result.counts["accepted"]


def test_recorded_attempts_are_not_repeated() -> None:
    texts = [outcome_to_json(outcome) for outcome in polished().outcomes]
    recorded = [outcome_from_json(text) for text in texts[:5]]
    emitted: list[PolishOutcome] = []
    again = polisher().polish(
        start_front(), np.random.default_rng(0), recorded=recorded, emit=emitted.append
    )
    assert len(emitted) == len(polished().outcomes) - 5
    np.testing.assert_array_equal(again.x, polished().x)


def test_an_attempt_that_ended_its_process_costs_itself_alone() -> None:
    recorded: list[PolishOutcome | Lost] = [*polished().outcomes[:2], Lost("killed")]
    emitted: list[PolishOutcome] = []
    again = polisher().polish(
        start_front(), np.random.default_rng(0), recorded=recorded, emit=emitted.append
    )
    assert (again.outcomes[2].status, again.outcomes[2].reason) == ("failed", "killed")
    assert again.outcomes[2] not in emitted
    assert len(again.outcomes) > 3
    assert len(emitted) == len(again.outcomes) - 3


def test_a_front_of_one_point() -> None:
    one = evaluator().workcell.task.initial.reshape(1, -1)
    result = FrontPolisher(evaluator(), replace(SETTINGS, attempts=4)).polish(
        one, np.random.default_rng(0)
    )
    assert np.any(np.all(result.objectives <= objectives_of(one)[0], axis=1))
    assert result.outcomes[0].parent == 0


def test_an_empty_front() -> None:
    result = polish_front(
        evaluator(), np.empty((0, evaluator().n_var)), SETTINGS, np.random.default_rng(0)
    )
    assert result.x.shape == (0, evaluator().n_var)
    assert result.objectives.shape == (0, 2)
    assert result.outcomes == ()
    assert result.counts == {}
    assert np.isnan(result.success_share)


def test_infeasible_points_are_no_front() -> None:
    x = np.vstack([evaluator().lower, evaluator().upper])
    assert not evaluator().evaluate(x).feasible.any()
    assert len(polisher().polish(x, np.random.default_rng(0)).x) == 0


def test_no_points_means_no_polish() -> None:
    result = FrontPolisher(evaluator(), PolishSettings(attempts=0)).polish(
        start_front(), np.random.default_rng(0)
    )
    assert result.outcomes == ()
    assert not result.polished.any()


def test_epsilon_constraint_improves_too() -> None:
    settings = PolishSettings(attempts=3, method="epsilon")
    result = FrontPolisher(evaluator(), settings).polish(start_front(), np.random.default_rng(0))
    own = [o for o in result.outcomes if o.aim == "point"]
    assert own[0].status == "accepted"
    assert np.all(own[0].objectives <= own[0].start + settings.tolerance)


def test_other_objectives_are_refused() -> None:
    other = CandidateEvaluator(load(RACK), ("duration", "mean_force"))
    with pytest.raises(SettingsError, match="the polish minimises"):
        FrontPolisher(other, SETTINGS)


class Broken(PolishSolver):
    """A solver whose attempts end in every bad way in turn."""

    def solve(self, start: SolveStart) -> Solution:
        found = super().solve(start)
        mood = int(1e6 * start.x[0]) % 3
        if mood == 0:
            raise FloatingPointError("broken")
        if mood == 1:
            return replace(found, x=evaluator().lower)  # claims success, far outside
        return replace(found, usable=False, message="Invalid_Number_Detected")


def test_a_broken_solver_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(front_module, "PolishSolver", Broken)
    polisher = FrontPolisher(evaluator(), PolishSettings(attempts=9, rounds=1))
    result = polisher.polish(start_front(), np.random.default_rng(0))
    before = objectives_of(start_front())
    order = np.lexsort(before.T[::-1])
    np.testing.assert_array_equal(result.objectives, before[order])
    assert {outcome.status for outcome in result.outcomes} <= {"failed", "rejected"}
    assert all(outcome.reason for outcome in result.outcomes)
    for outcome in result.outcomes:
        np.testing.assert_array_equal(outcome.objectives, outcome.start)
