"""Search among a cell's carries: the algorithms by name, pymoo's problem, the run with its exact
number of evaluations, and the record of all evaluated candidates.

pymoo's own MOPSO_CD, CMOPSO and NSGA3 are not offered, because they draw from unseeded generators.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pymoo.algorithms.moo.nsga2 import binary_tournament
from pymoo.algorithms.moo.sms import cv_and_dom_tournament
from pymoo.core.algorithm import Algorithm
from pymoo.core.problem import Problem

from hybrid_opt.evaluate.evaluation import NOT_FINITE, REASONS, Evaluations, concatenated
from hybrid_opt.metaheuristics.algorithms import (
    GeneticSettings,
    GuardedNsga2,
    GuardedSmsEmoa,
    RandomSearch,
    RandomSettings,
    genetic,
    violation_of,
)
from hybrid_opt.metaheuristics.mopso import Mopso, MopsoSettings
from symbolic.array import Array, require_allowed, set_read_only
from symbolic.errors import SettingsError
from symbolic.path.spline import coarse_task, resample_decisions
from symbolic.records import Task
from symbolic.records.problems import shown

# --- the algorithms by name ---


AlgorithmSettings = GeneticSettings | MopsoSettings | RandomSettings


@dataclass(frozen=True)
class _Entry:
    title: str
    build: Callable[[Any, Array | None], Algorithm]
    defaults: AlgorithmSettings


_NSGA2 = partial(genetic, GuardedNsga2, binary_tournament)
_SMS_EMOA = partial(genetic, GuardedSmsEmoa, cv_and_dom_tournament)

REGISTRY: dict[str, _Entry] = {
    "nsga2": _Entry("NSGA-II", _NSGA2, GeneticSettings()),
    "mopso": _Entry("MOPSO", Mopso, MopsoSettings()),
    "mopso-turbulent": _Entry(
        "MOPSO, turbulent", Mopso, MopsoSettings(inertia=0.45, mutation_share=0.75)
    ),
    "sms-emoa": _Entry("SMS-EMOA", _SMS_EMOA, GeneticSettings()),
    "random": _Entry("random search", RandomSearch, RandomSettings()),
}


def names() -> tuple[str, ...]:
    """Return the names of the algorithms that `make` accepts."""
    return tuple(REGISTRY)


def algorithms() -> dict[str, str]:
    """Return the printed title of each algorithm that `make` accepts, keyed by name."""
    return {name: entry.title for name, entry in REGISTRY.items()}


def title(name: str) -> str:
    """Return an algorithm's title in print; an unknown name is returned unchanged."""
    return REGISTRY[name].title if name in REGISTRY else name


def settings_of(name: str, overrides: Mapping[str, object] | None = None) -> AlgorithmSettings:
    """Return the settings of an algorithm: its defaults with some values replaced.

    Args:
        name: name of the algorithm, one of `names()`.
        overrides: values by setting name that replace defaults; None for none.

    Raises:
        SettingsError: unknown algorithm or setting, or a value outside its range.
    """
    if name not in REGISTRY:
        raise SettingsError(
            f"unknown algorithm {shown(name)}; known are {', '.join(REGISTRY)}",
            code="unknown-algorithm",
        )
    defaults = REGISTRY[name].defaults
    known = [field.name for field in fields(defaults)]
    unknown = [key for key in overrides or {} if key not in known]
    if unknown:
        raise SettingsError(
            f"{name}: unknown setting {', '.join(unknown)}; known are {', '.join(known)}",
            code="unknown-setting",
        )
    return replace(defaults, **dict(overrides or {}))  # type: ignore[arg-type]


def make(
    name: str,
    settings: AlgorithmSettings | Mapping[str, object] | None = None,
    initial: Array | None = None,
) -> Algorithm:
    """Build a search algorithm for one run.

    Args:
        name: name of the algorithm, one of `names()`.
        settings: settings object of the algorithm, or only the values that differ from the
            defaults, by setting name; None for the defaults.
        initial: (k, n_var) decision vectors that the first generation starts with, the rest being
            uniformly random; None for all random.

    Raises:
        SettingsError: unknown algorithm or setting, or a value outside its range. Wrong `initial`
            points raise an error only when the run starts.
    """
    if is_dataclass(settings):
        settings = asdict(settings)
    effective = settings_of(name, settings)
    return REGISTRY[name].build(effective, initial)


# --- the problem ---


ConstraintHandling = Literal["penalty", "constraints"]
"""How a search handles infeasible candidates: by the paper's penalised objectives, or by plain
objectives with violations as inequality constraints."""

WORST_PENALTY = 1.0 + len(REASONS)
"""Penalised objective of a candidate whose figures are not finite: the value for every constraint
violated all the time."""


class Evaluator(Protocol):
    """Interface that a search needs from an evaluator, such as
    `hybrid_opt.evaluate.evaluation.CandidateEvaluator`.

    Attributes:
        objective_names: names of the objectives.
        n_var: number of decision variables.
        lower, upper: (n_var,) bounds of the decision variables.
    """

    objective_names: tuple[str, ...]
    n_var: int
    lower: Array
    upper: Array

    def evaluate(self, x: Array) -> Evaluations:
        """Evaluate decision vectors x (n, n_var)."""

    def certified(self, evaluations: Evaluations) -> Evaluations:
        """Return the evaluations after a check for collisions between the samples.

        Candidates that collide there become infeasible. Afterwards every member of the feasible
        front is proven free of collisions.
        """


def reject_non_finite(evaluations: Evaluations) -> Evaluations:
    """Return the evaluations, with every candidate made infeasible whose values are not all finite.

    A violation or penalised objective that is NaN or infinite makes any candidate infeasible, an
    objective only a feasible one: the objectives of infeasible candidates do not count. Such a
    candidate gets the penalised objectives `WORST_PENALTY` and the reason `NOT_FINITE`.
    """
    finite = np.isfinite(evaluations.violation).all(axis=1)
    finite &= np.isfinite(evaluations.violation_time).all(axis=1)
    finite &= np.isfinite(evaluations.penalised).all(axis=1)
    # Infeasible candidates may lack objectives: a lost arm has no joint torque.
    finite &= np.isfinite(evaluations.objectives).all(axis=1) | ~evaluations.feasible
    if finite.all():
        return evaluations
    broken = ~finite
    changed = {f.name: getattr(evaluations, f.name).copy() for f in fields(evaluations)}
    changed["penalised"][broken] = WORST_PENALTY
    changed["feasible"][broken] = False
    changed["reason"][broken] = REASONS.index(NOT_FINITE)
    changed["position"][broken] = 0.0
    for name in ("violation", "violation_time"):
        changed[name][broken] = 0.0
        changed[name][broken, REASONS.index(NOT_FINITE)] = 1.0
    return replace(evaluations, **changed)


class CarryProblem(Problem):  # type: ignore[misc]
    """A cell's candidates as a vectorised pymoo problem that stores its evaluations.

    With handling 'penalty', pymoo minimises the penalised objectives (paper Eq. 60) without
    constraints. With handling 'constraints', pymoo minimises the plain objectives, or the penalised
    ones of a candidate without finite objectives. Each of `REASONS` is then an inequality
    constraint, and the violation is its value.

    Attributes:
        evaluator: evaluator of the candidates.
        drawn: task with fewer waypoints whose decision vectors pymoo varies; None if pymoo varies
            the decision vectors of the evaluated task itself.
        task: task of the evaluated candidates, to which the vectors of `drawn` are resampled; None
            if `drawn` is None.
        handling: 'penalty' or 'constraints'.
        evaluated: function called after each batch with the number of candidates in the batch.
        batches: evaluations of each batch, in order.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        handling: ConstraintHandling = "penalty",
        evaluated: Callable[[int], None] = lambda count: None,
        task: Task | None = None,
    ) -> None:
        """Store the evaluator, and set the number and bounds of the variables.

        Args:
            evaluator: evaluator of the candidates.
            handling: 'penalty' or 'constraints', see the class.
            evaluated: function called after each batch with the number of candidates in the batch.
            task: task of the evaluator. If `Task.pieces` added intermediate waypoints to those of
                the workcell file, pymoo varies only the waypoints of the file; the intermediate
                waypoints lie on the path through the waypoints of the file. None to vary all
                variables of the evaluator.
        """
        self.task = task if task is not None and task.pieces > 1 else None
        self.drawn = None if self.task is None else coarse_task(self.task)
        bounds = evaluator if self.drawn is None else self.drawn
        super().__init__(
            n_var=bounds.n_var,
            n_obj=len(evaluator.objective_names),
            n_ieq_constr=len(REASONS) if handling == "constraints" else 0,
            xl=bounds.lower,
            xu=bounds.upper,
        )
        self.evaluator = evaluator
        self.handling = handling
        self.evaluated = evaluated
        self.batches: list[Evaluations] = []

    @property
    def evaluations(self) -> Evaluations:
        """Every evaluated candidate in the order of evaluation; needs at least one."""
        return concatenated(self.batches)

    def _evaluate(self, x: Array, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        if self.drawn is not None and self.task is not None:
            x = resample_decisions(x, self.drawn, self.task)
        batch = reject_non_finite(self.evaluator.evaluate(x))
        self.batches.append(batch)
        self.evaluated(len(batch.feasible))
        if self.handling == "penalty":
            out["F"] = batch.penalised
        else:
            known = np.isfinite(batch.objectives).all(axis=1, keepdims=True)
            out["F"] = np.where(known, batch.objectives, batch.penalised)
            out["G"] = batch.violation


@dataclass(frozen=True)
class Evaluated:
    """Evaluated points in the order of their evaluation.

    Attributes:
        decisions: (n, n_var) decision vectors.
        objectives: (n, n_obj) objectives as the problem returned them.
        violation: (n,) total constraint violation, 0 where feasible; infinite where an
            objective or constraint was not finite.
        generation: (n,) number of the generation, from 1.
    """

    decisions: Array
    objectives: Array
    violation: Array
    generation: NDArray[np.int64]

    def __post_init__(self) -> None:
        set_read_only(self)

    def __len__(self) -> int:
        return len(self.violation)

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """(n,) True where every constraint is satisfied and every objective is finite."""
        return np.asarray(self.violation == 0.0)


@dataclass(frozen=True)
class SearchResult:
    """Record of a search.

    Attributes:
        evaluated: every evaluated point; fronts and metrics are computed from these.
        front: the feasible points of the algorithm's own final front, whose size is limited.
        algorithm_seconds: wall time spent in the algorithm, without evaluations [s].
    """

    evaluated: Evaluated
    front: Evaluated
    algorithm_seconds: float


def search(
    problem: Problem,
    algorithm: Algorithm,
    evaluations: int,
    rng: np.random.Generator | int,
) -> SearchResult:
    """Run an algorithm on a problem with an exact number of evaluations.

    Args:
        problem: pymoo problem with `elementwise=False`; each generation is one call.
        algorithm: algorithm from `hybrid_opt.metaheuristics.make` that has not run yet.
        evaluations: number of evaluations, at least 1.
        rng: random generator of the whole run, or a seed. The same seed gives the same result to
            the bit.

    Raises:
        SettingsError: fewer than one evaluation, or an algorithm that already ran.
    """
    if evaluations < 1:
        raise SettingsError(f"evaluations is {evaluations}; at least 1 is needed", code="budget")
    if algorithm.problem is not None:
        raise SettingsError(
            "this algorithm already ran; make a new one for each run", code="already-ran"
        )
    start = time.perf_counter()
    inside = 0.0
    batches: list[Evaluated] = []
    algorithm.setup(problem, termination=("n_eval", evaluations), seed=rng)
    while algorithm.has_next():
        candidates = algorithm.ask()
        before = time.perf_counter()
        algorithm.evaluator.eval(problem, candidates, algorithm=algorithm)
        inside += time.perf_counter() - before
        # Read before `tell`, which disarms points that are not finite.
        decisions, objectives, constraints = candidates.get("X", "F", "G")
        violation = violation_of(objectives, constraints)
        number = np.full(len(violation), len(batches) + 1, dtype=np.int64)
        batches.append(Evaluated(decisions, objectives, violation, number))
        algorithm.tell(infills=candidates)
    columns = zip(*(vars(batch).values() for batch in batches), strict=True)
    evaluated = Evaluated(*map(np.concatenate, columns))
    members = list(algorithm.opt)
    front = Evaluated(
        np.array([m.X for m in members]).reshape(-1, problem.n_var),
        np.array([m.F for m in members]).reshape(-1, problem.n_obj),
        np.zeros(len(members)),
        np.array([m.get("n_gen") for m in members], dtype=np.int64),
    )
    return SearchResult(evaluated, front, time.perf_counter() - start - inside)


@dataclass(frozen=True)
class SearchSettings:
    """Settings of a search.

    Attributes:
        algorithm: settings object of the algorithm, or only the values that differ from its
            defaults, by setting name.
        constraint_handling: 'penalty' (the paper's) or 'constraints', see `CarryProblem`.
        initial: (k, n_var) decision vectors that the first generation starts with, the rest being
            uniformly random; None for what the caller starts from by default.
    """

    algorithm: AlgorithmSettings | Mapping[str, object] = field(default_factory=dict)
    constraint_handling: ConstraintHandling = "penalty"
    initial: Array | None = None

    def __post_init__(self) -> None:
        require_allowed(self)


def search_carries(
    evaluator: Evaluator,
    algorithm: str,
    evaluations: int,
    rng: np.random.Generator,
    settings: SearchSettings,
    evaluated: Callable[[int], None] = lambda count: None,
    task: Task | None = None,
) -> tuple[Evaluations, NDArray[np.intp]]:
    """Search with an exact number of evaluations, then certify the members of the feasible front of
    all evaluated candidates: prove that they do not collide between samples either.

    Args:
        evaluator: evaluator of the candidates.
        algorithm: name of the algorithm, one of `hybrid_opt.metaheuristics.names()`.
        evaluations: number of evaluations, at least 1.
        rng: random generator of the whole run.
        settings: settings of the search.
        evaluated: function called after each batch with the number of candidates in the batch.
        task: task of the evaluator. If `Task.pieces` added intermediate waypoints to those of the
            workcell file, the search varies only the waypoints of the file; the intermediate
            waypoints lie on the path through the waypoints of the file. None to vary all variables
            of the evaluator.

    Returns:
        The evaluations of all candidates in order, and the generation (n,) of each, from 1. In the
        evaluations a member of the front without a proof is infeasible, for the reason
        `BETWEEN_SAMPLES`; every member of the front that remains is proven.

    Raises:
        SettingsError: an unknown algorithm or a value that is not allowed.
    """
    problem = CarryProblem(evaluator, settings.constraint_handling, evaluated, task)
    initial = settings.initial
    if initial is not None and problem.task is not None and problem.drawn is not None:
        initial = resample_decisions(initial, problem.task, problem.drawn)
    search(problem, make(algorithm, settings.algorithm, initial), evaluations, rng)
    sizes = [len(batch) for batch in problem.batches]
    generation = np.repeat(np.arange(1, len(sizes) + 1), sizes)
    return evaluator.certified(problem.evaluations), generation
