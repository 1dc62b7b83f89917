"""The search problem hands out finite figures only and keeps what it evaluated."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.evaluate.evaluations import FEASIBLE, NOT_FINITE, REASONS, Evaluations
from hybrid_opt.metaheuristics.run import WORST_PENALTY, CarryProblem, SearchSettings, disarmed
from symbolic.array import Array
from symbolic.errors import SettingsError
from tests.hybrid_opt.campaign.fake import OBJECTIVES, verdicts

FIGURES = ("objectives", "penalised", "violation", "violation_time")
BROKEN = (np.nan, np.inf, -np.inf)
RNG = np.random.default_rng(4)


class Stub:
    """An evaluator whose verdicts may be spoilt."""

    objective_names: tuple[str, ...] = OBJECTIVES
    n_var = 4
    lower = np.zeros(4)
    upper = np.ones(4)

    def __init__(self, figure: str = "", value: float = 0.0) -> None:
        self._figure, self._value = figure, value

    def evaluate(self, x: Array) -> Evaluations:
        found = verdicts(x)
        if not self._figure:
            return found
        spoilt = getattr(found, self._figure).copy()
        spoilt[::3, -1] = self._value
        return replace(found, **{self._figure: spoilt})

    def certified(self, evaluations: Evaluations) -> Evaluations:
        return evaluations


def evaluate(problem: CarryProblem, x: Array) -> dict[str, Any]:
    out: dict[str, Any] = problem.evaluate(x, return_as_dictionary=True)
    return out


@pytest.mark.parametrize("figure", FIGURES)
@pytest.mark.parametrize("value", BROKEN)
@pytest.mark.parametrize("handling", ["penalty", "constraints"])
def test_no_figure_that_is_not_finite_gets_out(figure: str, value: float, handling: Any) -> None:
    problem = CarryProblem(Stub(figure, value), handling)
    x = RNG.random((60, 4))
    out = evaluate(problem, x)
    assert np.isfinite(out["F"]).all()
    if handling == "constraints":
        assert np.isfinite(out["G"]).all()
    found = problem.evaluations
    assert np.isfinite(found.objectives[found.feasible]).all()
    violated = (found.violation > 0.0).any(axis=1)
    np.testing.assert_array_equal(found.feasible, ~violated)
    np.testing.assert_array_equal(found.feasible, found.reason == FEASIBLE)
    np.testing.assert_array_equal(found.feasible, np.isnan(found.position))


def test_disarmed_candidates_are_worst_and_say_why() -> None:
    x = np.array([[0.31, 0.5, 0.5, 0.5], [0.5, 0.5, 0.5, 0.5]])
    before = verdicts(x)
    after = disarmed(before)
    assert np.isnan(before.objectives[0]).all()
    assert before.feasible.tolist() == [True, True]
    assert after.feasible.tolist() == [False, True]
    assert after.reason.tolist() == [REASONS.index(NOT_FINITE), FEASIBLE]
    assert after.penalised[0].tolist() == [WORST_PENALTY] * 2
    for field in fields(Evaluations):
        np.testing.assert_array_equal(getattr(after, field.name)[1], getattr(before, field.name)[1])


def test_penalty_has_no_constraints_and_constraints_no_penalty() -> None:
    x = RNG.random((50, 4)) * 0.3
    x[:, 2] = 0.95
    found = verdicts(x)
    problem = CarryProblem(Stub())
    np.testing.assert_array_equal(evaluate(problem, x)["F"], found.penalised)
    assert problem.n_ieq_constr == 0
    by_constraints = evaluate(CarryProblem(Stub(), "constraints"), x)
    np.testing.assert_array_equal(by_constraints["F"], found.objectives)
    np.testing.assert_array_equal(by_constraints["G"], found.violation)
    assert (found.penalised > 1.0).all()


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6))
def test_every_candidate_is_kept_in_order(sizes: list[int]) -> None:
    problem = CarryProblem(Stub())
    x = np.random.default_rng(len(sizes)).random((sum(sizes), 4))
    for part in np.split(x, np.cumsum(sizes)[:-1]):
        evaluate(problem, part)
    assert [len(batch) for batch in problem.batches] == sizes
    np.testing.assert_array_equal(problem.evaluations.x, x)


def test_unknown_handling_is_told() -> None:
    with pytest.raises(SettingsError, match="'hope'; known are penalty, constraints"):
        SearchSettings(constraint_handling="hope")  # type: ignore[arg-type]
