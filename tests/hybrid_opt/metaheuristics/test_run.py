"""Searches: what every algorithm promises, on problems whose fronts are known."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymoo.core.problem import Problem
from pymoo.problems.multi.tnk import TNK
from scipy.optimize import minimize

from hybrid_opt.evaluate.evaluation import FEASIBLE, NOT_FINITE, REASONS, Evaluations
from hybrid_opt.evaluate.objectives import non_dominated
from hybrid_opt.indicators import metrics
from hybrid_opt.metaheuristics import (
    SearchResult,
    make,
    names,
    search,
    settings_of,
)
from hybrid_opt.metaheuristics.algorithms import violation_of
from hybrid_opt.metaheuristics.run import (
    WORST_PENALTY,
    CarryProblem,
    SearchSettings,
    reject_non_finite,
)
from studies.research import analytic
from symbolic.array import Array
from symbolic.errors import SettingsError
from tests.hybrid_opt.campaign.fake import FakeEvaluator, FakeSource, verdicts
from tests.refusals import refused

NAMES = names()


class Counting(Problem):  # type: ignore[misc]
    """Two paraboloids in 3 variables; optionally a constraint and values that are not finite.

    broken: share of points (by a fixed stripe pattern of x0) that return NaN or infinity.
    """

    def __init__(
        self, constraints: int = 0, broken: float = 0.0, upper: float = 1.0, equalities: int = 0
    ) -> None:
        super().__init__(
            n_var=3, n_obj=2, n_ieq_constr=constraints, n_eq_constr=equalities, xl=0.0, xu=upper
        )
        self.broken = broken
        self.calls: list[int] = []

    def _evaluate(self, x: Any, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        self.calls.append(len(x))
        objectives = np.column_stack([(x**2).sum(axis=1), ((x - 1.0) ** 2).sum(axis=1)])
        stripe = (x[:, 0] * 50.0) % 1.0
        objectives[stripe < self.broken] = np.nan
        objectives[stripe < 0.5 * self.broken, 0] = -np.inf
        out["F"] = objectives
        if self.n_ieq_constr:
            constraints = np.repeat(0.4 - x[:, :1], self.n_ieq_constr, axis=1)
            constraints[(x[:, 1] * 50.0) % 1.0 < 0.5 * self.broken] = np.nan
            out["G"] = constraints


def run(name: str, problem: Problem, evaluations: int, seed: int = 3, **options: Any) -> Any:
    return search(problem, make(name, **options), evaluations, seed)


def bits(result: SearchResult) -> bytes:
    return b"".join(
        array.tobytes()
        for points in (result.evaluated, result.front)
        for array in (points.decisions, points.objectives, points.violation)
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("evaluations", [1, 39, 40, 41, 137])
def test_budget_is_spent_exactly(name: str, evaluations: int) -> None:
    problem = Counting()
    result = run(name, problem, evaluations)
    assert sum(problem.calls) == evaluations == len(result.evaluated)
    assert result.evaluated.generation[-1] == len(problem.calls)


@pytest.mark.parametrize("name", NAMES)
def test_each_generation_is_one_call(name: str) -> None:
    problem = Counting()
    size = 100 if name == "random" else 40
    run(name, problem, 2 * size + 7)
    assert problem.calls == [size, size, 7]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("constraints", [0, 1])
def test_same_seed_same_bits(name: str, constraints: int) -> None:
    np.random.seed(1)  # noqa: NPY002
    first = run(name, Counting(constraints), 300, seed=11)
    np.random.seed(2)  # noqa: NPY002
    second = run(name, Counting(constraints), 300, seed=11)
    assert bits(first) == bits(second)
    assert bits(first) != bits(run(name, Counting(constraints), 300, seed=12))


def test_seed_and_generator_agree() -> None:
    by_seed = run("mopso", Counting(), 120, seed=5)
    by_generator = search(Counting(), make("mopso"), 120, np.random.default_rng(5))
    assert bits(by_seed) == bits(by_generator)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("constraints", [0, 1, 3])
def test_front_holds_finite_feasible_points_only(name: str, constraints: int) -> None:
    result = run(name, Counting(constraints, broken=0.3), 400)
    assert np.isinf(result.evaluated.violation).any()
    assert len(result.front) > 0
    assert np.isfinite(result.front.objectives).all()
    if constraints:
        assert (result.front.decisions[:, 0] >= 0.4).all()
    assert non_dominated(result.front.objectives).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("constraints", [0, 1])
def test_nothing_finite_gives_an_empty_front(name: str, constraints: int) -> None:
    result = run(name, Counting(constraints, broken=2.0), 130)
    assert len(result.front) == 0
    assert not result.evaluated.feasible.any()
    assert len(result.evaluated) == 130


@pytest.mark.parametrize("name", NAMES)
def test_broken_points_are_recorded_as_they_were(name: str) -> None:
    result = run(name, Counting(broken=0.3), 200)
    objectives = Counting(broken=0.3).evaluate(result.evaluated.decisions)
    np.testing.assert_array_equal(result.evaluated.objectives, objectives)


@pytest.mark.parametrize("name", NAMES)
def test_warm_start_is_evaluated_first(name: str) -> None:
    initial = np.array([[0.5, 0.5, 0.5], [0.1, 0.2, 0.3]])
    result = run(name, Counting(), 60, initial=initial)
    np.testing.assert_array_equal(result.evaluated.decisions[:2], initial)
    without = run(name, Counting(), 60)
    np.testing.assert_array_equal(
        result.evaluated.decisions[2:40], without.evaluated.decisions[2:40]
    )


@pytest.mark.parametrize(
    ("initial", "code"),
    [
        ([[0.5, 0.5]], "shape"),
        (np.full((41, 3), 0.5), "shape"),
        ([[0.5, 1.5, 0.5]], "outside-the-bounds"),
        ([[0.5, np.nan, 0.5]], "outside-the-bounds"),
    ],
)
def test_wrong_warm_start_is_refused(initial: Any, code: str) -> None:
    with refused(SettingsError, code):
        run("nsga2", Counting(), 60, initial=np.asarray(initial))


@pytest.mark.parametrize("name", NAMES)
def test_budget_is_spent_when_only_duplicates_are_left(name: str) -> None:
    problem = Counting(upper=0.0)
    assert len(run(name, problem, 130).evaluated) == 130
    assert sum(problem.calls) == 130


@cache
def median_volume(algorithm: str) -> float:
    """Hypervolume of a short search's front."""
    fronts = [run(algorithm, TNK(), 600, seed).front.objectives for seed in range(5)]
    return float(np.median([metrics.hypervolume(front, (1.2, 1.2)) for front in fronts]))


@pytest.mark.parametrize("name", [name for name in NAMES if name != "random"])
def test_search_beats_random(name: str) -> None:
    assert median_volume(name) > median_volume("random")


def test_violation_sums_what_is_exceeded() -> None:
    objectives = np.array([[0.0, 1.0], [0.0, 1.0], [np.nan, 1.0], [0.0, -np.inf], [1e30, 0.0]])
    constraints = np.array([[-1.0, -2.0], [0.5, 0.25], [-1.0, -1.0], [-1.0, -1.0], [-1.0, -1.0]])
    np.testing.assert_array_equal(
        violation_of(objectives, constraints), [0.0, 0.75, np.inf, np.inf, np.inf]
    )
    unconstrained = violation_of(objectives[:1], np.empty((1, 0)))
    np.testing.assert_array_equal(unconstrained, [0.0])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("nsga3", None, "'nsga3'.*nsga2, mopso"),
        ("mopso", {"swarn": 4}, "swarn.*swarm, archive"),
        ("mopso", {"swarm": 0}, "swarm is 0.* 1 "),
        ("mopso", {"inertia": float("nan")}, "inertia is nan"),
        ("mopso", {"swarm": "many"}, "swarm is 'many'"),
        ("mopso", {"swarm": 12.5}, "swarm is 12.5"),
        ("mopso", {"inertia": "much"}, "mopso: inertia .*'much'.*0.0.*1.0"),
        ("nsga2", {"population": 2}, "population is 2"),
        ("nsga2", {"mutation_probability": 1.5}, "mutation_probability is 1.5"),
        ("random", {"batch": 0}, "batch is 0"),
    ],
)
def test_wrong_settings_are_told(name: str, settings: Any, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        make(name, settings)


def test_an_algorithm_runs_once() -> None:
    algorithm = make("nsga2")
    search(Counting(), algorithm, 40, 1)
    with refused(SettingsError, "already-ran"):
        search(Counting(), algorithm, 40, 1)


def test_a_budget_is_needed() -> None:
    with refused(SettingsError, "budget"):
        search(Counting(), make("nsga2"), 0, 1)


@pytest.mark.parametrize("name", NAMES)
def test_equalities_are_refused(name: str) -> None:
    with refused(SettingsError, "equalities"):
        run(name, Counting(equalities=1), 40)


@pytest.mark.parametrize("name", NAMES)
def test_effective_settings_make_the_same_algorithm(name: str) -> None:
    overrides = {"population": 12} if name in ("nsga2", "sms-emoa") else {}
    effective = settings_of(name, overrides)
    first, second = (
        search(Counting(), make(name, settings), 60, 3) for settings in (effective, overrides)
    )
    assert bits(first) == bits(second)
    with refused(SettingsError, "unknown-setting"):
        make("random", settings_of("nsga2"))


FIGURES = ("objectives", "penalised", "violation", "violation_time")
BROKEN = (np.nan, np.inf, -np.inf)
RNG = np.random.default_rng(4)


class Stub(FakeEvaluator):
    """An evaluator whose verdicts may be spoilt."""

    def __init__(self, figure: str = "", value: float = 0.0) -> None:
        super().__init__(FakeSource())
        self._figure, self._value = figure, value

    def evaluate(self, x: Array) -> Evaluations:
        found = super().evaluate(x)
        if not self._figure:
            return found
        spoilt = getattr(found, self._figure).copy()
        spoilt[::3, -1] = self._value
        return replace(found, **{self._figure: spoilt})


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
    after = reject_non_finite(before)
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
    with refused(SettingsError, "unknown-choice", "'hope'", "penalty, constraints"):
        SearchSettings(constraint_handling="hope")  # type: ignore[arg-type]


# Ideal, nadir and largest hypervolume of the normalised front, for reference point (1.1, 1.1).
KNOWN = {
    "zdt1": ((0.0, 0.0), (1.0, 1.0), 0.8766),
    "zdt2": ((0.0, 0.0), (1.0, 1.0), 0.5433),
    "zdt3": ((0.0, -0.7734), (0.8518, 1.0), 0.7275),
    "tnk": ((0.0417, 0.0417), (1.0385, 1.0385), 0.5189),
    "srn": ((10.1, -217.74), (222.97, 2.61), 0.7507),
    "osy": ((-274.0, 4.0), (-42.0, 76.0), 0.9689),
    "shifted-zdt1": ((0.0, 0.0), (1.0, 1.0), 0.8766),
}


@pytest.mark.parametrize("name", analytic.PROBLEMS)
def test_front_has_its_known_range_and_volume(name: str) -> None:
    target = analytic.make(name)
    ideal, nadir, volume = KNOWN[name]
    np.testing.assert_allclose(target.ideal, ideal, rtol=2e-4, atol=5e-5)
    np.testing.assert_allclose(target.nadir, nadir, rtol=2e-4, atol=5e-5)
    # A finite sample of the front stays below the limit, by less than its resolution.
    reached = metrics.hypervolume(target.normalise(target.front))
    assert volume - 1e-3 < reached <= volume + 5e-5
    assert non_dominated(target.front).all()


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["tnk", "srn", "osy"])
def test_front_is_what_a_gradient_solver_finds(name: str) -> None:
    """Least f1 under a bound on f2, by SLSQP from many starts."""
    target = analytic.make(name)
    problem = target.problem
    rng = np.random.default_rng(5)
    extent = target.nadir - target.ideal

    def values(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        f, g = problem.evaluate(x, return_values_of=["F", "G"])
        return (f - target.ideal) / extent, g

    for limit in (0.1, 0.3, 0.55):
        best = np.inf
        for start in rng.uniform(problem.xl, problem.xu, size=(20, problem.n_var)):
            outcome = minimize(
                lambda x: values(x)[0][0],
                start,
                method="SLSQP",
                bounds=list(zip(problem.xl, problem.xu, strict=True)),
                constraints={
                    "type": "ineq",
                    "fun": lambda x, limit=limit: np.append(-values(x)[1], limit - values(x)[0][1]),
                },
            )
            f, g = values(outcome.x)
            if (g <= 1e-7).all() and f[1] <= limit + 1e-7:
                best = min(best, float(f[0]))
        normalised = target.normalise(target.front)
        expected = normalised[normalised[:, 1] <= limit][:, 0].min()
        assert best == pytest.approx(expected, abs=3e-3)


def test_shifted_zdt_has_its_optimum_inside() -> None:
    problem = analytic.make("shifted-zdt1").problem
    optimum = np.concatenate([[0.25], np.linspace(0.2, 0.5, 29)])
    np.testing.assert_allclose(problem.evaluate(optimum), [0.25, 0.5])
    away = optimum.copy()
    away[7] += 0.1
    assert problem.evaluate(away)[1] > 0.5
    away[7] -= 0.2
    assert problem.evaluate(away)[1] > 0.5
