"""Run an algorithm on a problem and keep every point that it evaluated."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pymoo.core.algorithm import Algorithm
from pymoo.core.problem import Problem

from hybrid_opt.metaheuristics.guarded import violation_of
from symbolic.array import Array
from symbolic.errors import SettingsError


@dataclass(frozen=True)
class Evaluated:
    """Evaluated points in the order of their evaluation.

    Attributes:
        decisions: (n, n_var).
        objectives: (n, n_obj), as the problem returned them.
        violation: (n,) total constraint violation, 0 where feasible; infinite where an
            objective or constraint was not finite.
        generation: (n,) number of the generation, from 1.
    """

    decisions: Array
    objectives: Array
    violation: Array
    generation: NDArray[np.int64]

    def __post_init__(self) -> None:
        for array in (self.decisions, self.objectives, self.violation, self.generation):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.violation)

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """(n,) whether every constraint is satisfied and every objective is finite."""
        return np.asarray(self.violation == 0.0)


@dataclass(frozen=True)
class SearchResult:
    """Record of a search.

    Attributes:
        evaluated: every point, without limit; fronts and metrics are computed from it.
        front: the points of the algorithm's own final front (of limited size), feasible only.
        evaluation_seconds: wall time inside the problem.
        algorithm_seconds: wall time outside of it.
    """

    evaluated: Evaluated
    front: Evaluated
    evaluation_seconds: float
    algorithm_seconds: float


def search(
    problem: Problem,
    algorithm: Algorithm,
    evaluations: int,
    rng: np.random.Generator | int,
    observe: Callable[[Evaluated], None] | None = None,
) -> SearchResult:
    """Spend exactly `evaluations` evaluations of `problem`.

    Args:
        problem: with `elementwise=False`; each generation is one call.
        algorithm: a fresh one from `hybrid_opt.metaheuristics.make`.
        evaluations: the budget, at least 1.
        rng: the run's only source of randomness, or a seed for it; the same seed gives the
            same result to the bit.
        observe: called after each generation with that generation's points.

    Raises:
        SettingsError: no budget, or an algorithm that already ran.
    """
    if evaluations < 1:
        raise SettingsError(f"evaluations is {evaluations}; at least 1 is needed")
    if algorithm.problem is not None:
        raise SettingsError("this algorithm already ran; make a new one for each run")
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
        if observe is not None:
            observe(batches[-1])
    evaluated = _join(batches)
    return SearchResult(
        evaluated,
        _final_front(algorithm, problem),
        inside,
        time.perf_counter() - start - inside,
    )


def _join(batches: list[Evaluated]) -> Evaluated:
    return Evaluated(
        np.concatenate([batch.decisions for batch in batches]),
        np.concatenate([batch.objectives for batch in batches]),
        np.concatenate([batch.violation for batch in batches]),
        np.concatenate([batch.generation for batch in batches]),
    )


def _final_front(algorithm: Algorithm, problem: Problem) -> Evaluated:
    members = list(algorithm.opt)
    return Evaluated(
        np.array([m.X for m in members]).reshape(-1, problem.n_var),
        np.array([m.F for m in members]).reshape(-1, problem.n_obj),
        np.zeros(len(members)),
        np.array([m.get("n_gen") for m in members], dtype=np.int64),
    )
