"""Probes: feasible starts everywhere, the better half of which goes on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.evaluate.evaluations import COLLISION, REASONS
from hybrid_opt.polishing.feasible import first_feasible
from hybrid_opt.polishing.probing import Start, better_half, halve, random_starts
from hybrid_opt.polishing.settings import PolishSettings
from tests.hybrid_opt.polishing.test_front import evaluator, polished


def test_random_starts_are_feasible_and_the_same_for_the_same_seed() -> None:
    settings = PolishSettings()
    found = random_starts(evaluator(), settings, 5, np.random.default_rng(1))
    again = random_starts(evaluator(), settings, 5, np.random.default_rng(1))
    assert len(found) == 5
    for start, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(start.x, other.x)
        judged = evaluator().evaluate(start.x)
        assert judged.feasible[0]
        np.testing.assert_array_equal(judged.objectives[0], start.objectives)


@pytest.mark.parametrize("objective", [None, 0, 1])
def test_the_first_feasible_ones_are_those_of_a_verdict_on_all(objective: int | None) -> None:
    judge = evaluator()
    x = np.random.default_rng(2).uniform(judge.lower, judge.upper, (800, judge.n_var))
    found = judge.evaluate(x)
    rows = np.flatnonzero(found.feasible)
    assert (found.reason == REASONS.index(COLLISION)).any()
    if objective is not None:
        rows = rows[np.argsort(found.objectives[rows, objective])]
    for count in (1, 5, 800):
        chosen, objectives = first_feasible(judge, x, count, objective)
        np.testing.assert_array_equal(chosen, rows[:count])
        np.testing.assert_array_equal(objectives, found.objectives[rows[:count]])


@given(
    values=st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 2.0)), max_size=9),
    objective=st.sampled_from([0, 1, None]),
)
def test_the_better_half_is_no_worse_than_the_rest(
    values: list[tuple[float, float]], objective: int | None
) -> None:
    starts = [Start(np.empty(0), np.array(value)) for value in values]
    half = better_half(starts, objective)
    assert len(half) == len(starts) // 2
    rest = [start for start in starts if all(start is not kept for kept in half)]
    for kept in half:
        assert all(kept.value(objective) <= other.value(objective) for other in rest)


def test_starts_that_came_no_further_are_not_solved_again_and_stay_in_the_running() -> None:
    solved: list[float] = []

    def solve(start: Start) -> Start:
        value = start.value(0)
        solved.append(value)
        gain = 0.0 if value == 1.0 else 0.5
        return Start(start.x, start.objectives - gain, spent=gain == 0.0)

    pool = [Start(np.empty(0), np.array([value, 0.0])) for value in (1.0, 4.0, 2.0, 3.0)]
    halve(pool, 0, solve)
    assert solved == [1.0, 4.0, 2.0, 3.0, 1.5]


def test_what_probes_reach_is_given_up_only_where_the_front_is_nearly_as_good() -> None:
    probes = [o for o in polished().outcomes if o.aim == "probe"]
    assert len(probes) > 4
    accepted = [o for o in probes if o.status == "accepted"]
    assert accepted
    front = polished().objectives
    nearly = PolishSettings().fill.far * np.ptp(front, axis=0)
    for outcome in accepted:
        assert (outcome.start - outcome.objectives).max() > 0.0
        assert np.any(np.all(front <= outcome.objectives + nearly, axis=1))
