"""Cost of a whole candidate with collisions, for candidates of a search and for random ones.

The compiled way is the evaluator that the searches call, with batches of a search's population.
The plain way is the tests' reference: every pair of every sample goes to FCL.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from codegen.interpreted import InterpretedFunction
from codegen.source import dense
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.metaheuristics.problem import CarryProblem
from hybrid_opt.metaheuristics.registry import make
from hybrid_opt.metaheuristics.run import search
from hybrid_opt.metaheuristics.settings import GeneticSettings
from studies.benchmark_peak import candidate_operations, peak_operations
from studies.benchmark_turns import Evaluate, interleaved, progress, summary
from symbolic.array import Array
from symbolic.functions import cell_functions
from symbolic.records import Workcell

EVALUATIONS = 1000
"""Evaluations of the NSGA-II search whose candidates are timed."""

POPULATION = GeneticSettings().population
"""Candidates per batch."""

SHARED = 5
"""Most batches on which the shares of the time are measured."""


def with_collisions(
    workcell: Workcell, plain: Evaluate, candidates: int, repeats: int, seed: int
) -> dict[str, Any]:
    """Measure the evaluation with collisions; every time is in milliseconds per candidate.

    Figures are means over the rounds, as a search pays the mean and not the median.

    Args:
        plain: the plain reference with collisions, of one decision vector.
        candidates: batches of the compiled way, drawn from all candidates; the other ways
            evaluate one candidate of each batch.
        repeats: rounds with each of them.
        seed: of the search and the draws.

    Returns:
        The figures of the search's candidates and, as 'random', those of uniform candidates; under
        the joint allocation also what they cost over the paper's.
    """
    rng = np.random.default_rng(seed)
    progress(f"a search of {EVALUATIONS} evaluations, whose candidates are to be timed")
    evaluator = CandidateEvaluator(workcell)
    problem = CarryProblem(evaluator)
    search(problem, make("nsga2"), EVALUATIONS, rng)
    searched = rng.choice(problem.evaluations.x, (candidates, POPULATION))
    size = (candidates, POPULATION, evaluator.n_var)
    uniform = rng.uniform(evaluator.lower, evaluator.upper, size)
    functions = {
        name: InterpretedFunction(dense(function))
        for name, function in cell_functions(evaluator.compiled.model).items()
    }
    interpreted = CandidateEvaluator(workcell, functions=functions)
    peak = peak_operations()
    ways: dict[str, Evaluate] = {
        "compiled": evaluator.evaluate,
        "interpreted": interpreted.evaluate,
        "plain": plain,
    }
    if workcell.task.allocation == "joint" and workcell.has_opposite_pads:
        task = replace(workcell.task, allocation="paper")
        ways["paper"] = CandidateEvaluator(replace(workcell, task=task)).evaluate
    figures: list[dict[str, Any]] = []
    for what, batches in (("the search's", searched), ("random", uniform)):
        progress(f"{candidates * repeats} rounds on {what} candidates, with collisions")
        one_each = batches[:, 0]
        in_batches = ("compiled", "paper")
        x = {name: batches if name in in_batches else one_each for name in ways}
        times = interleaved(ways, x, repeats)
        for name in times.keys() & in_batches:
            times[name] /= POPULATION
        verdicts = evaluator.evaluate(np.concatenate(batches))
        figures.append(
            {
                **summary(times, np.mean),
                **over_paper(times),
                "feasible_share": float(verdicts.feasible.mean()),
                "shares": shares(evaluator, batches[:SHARED], repeats),
            }
        )
    ours, random = figures
    per_second = candidate_operations(evaluator.compiled.model) / (1e-3 * ours["compiled_ms"])
    ours["operations_per_second"] = per_second
    ours["share_of_peak"] = per_second / peak if peak else None
    return {"evaluations": EVALUATIONS, "population": POPULATION, **ours, "random": random}


def over_paper(times: Mapping[str, Array]) -> dict[str, float]:
    """Cost of the joint allocation's candidates over the same ones under the paper's, where that
    was measured."""
    if "paper" not in times:
        return {}
    return {"compiled_over_paper": float(np.mean(times["compiled"] / times["paper"]))}


def shares(evaluator: CandidateEvaluator, batches: Array, repeats: int) -> dict[str, float]:
    """Where the time of the compiled way goes, as shares of the whole.

    candidate: path, arms and forces. collisions: bounds, proofs and FCL. rest: objectives and
    bookkeeping.

    Args:
        batches: (n, size, n_var).
        repeats: rounds with each batch.
    """
    ways: dict[str, Evaluate] = {
        "whole": evaluator.evaluate,
        "with collisions": evaluator.sampled,
        "candidate": lambda x: evaluator.sampled(x, with_collisions=False),
    }
    times = interleaved(ways, dict.fromkeys(ways, batches), repeats)
    part = {name: float(np.mean(value / times["whole"])) for name, value in times.items()}
    collisions = part["with collisions"] - part["candidate"]
    return {
        "candidate": part["candidate"],
        "collisions": collisions,
        "rest": 1.0 - part["with collisions"],
    }
