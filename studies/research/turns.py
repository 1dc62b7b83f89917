"""Ways of evaluating candidates that take turns on one core, and what they cost.

With collisions the compiled way is the evaluator that the searches call; in the plain way, the
tests' reference, every pair of every sample goes to FCL.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from codegen.build import load_or_build_program
from codegen.interpreted import InterpretedFunction
from codegen.source import operations
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.metaheuristics.algorithms import GeneticSettings
from hybrid_opt.metaheuristics.run import CarryProblem, make, search
from symbolic.array import Array
from symbolic.cell_model import CellModel
from symbolic.functions import cell_functions, kernel_functions
from symbolic.records import Workcell

Evaluate = Callable[[Array], object]

SLICE = 0.05
"""Least time of one way of evaluation per round [s]. Fast ways evaluate further candidates to fill
it, as a search does, so that refilling the processor's caches costs no more than in a search."""


def interleaved(
    ways: Mapping[str, Evaluate], x: Mapping[str, Array], repeats: int
) -> dict[str, Array]:
    """Return the time per call of each way of evaluation in each round (rounds,) [s]. The ways are
    measured in turns.

    Args:
        ways: functions of one decision vector, or of one batch, by name.
        x: arguments for each way: decision vectors (n, n_var) or batches (n, size, n_var), with the
            same n for all.
        repeats: number of rounds with each of the n.
    """
    counts = {}
    for name, evaluate in ways.items():
        evaluate(x[name][0])
        counts[name] = max(1, int(np.ceil(SLICE / _seconds(evaluate, x[name], 0, 1))))
    n = len(next(iter(x.values())))
    times: dict[str, list[float]] = {name: [] for name in ways}
    for round_ in range(n * repeats):
        # Every other round backwards: what comes first has no advantage.
        for name in list(ways)[:: 1 if round_ % 2 == 0 else -1]:
            times[name].append(_seconds(ways[name], x[name], round_, counts[name]))
    return {name: np.array(values) for name, values in times.items()}


def _seconds(evaluate: Evaluate, x: Array, first: int, count: int) -> float:
    """Measure the mean time per call [s] of a function at single decision vectors, one after the
    other.

    Args:
        evaluate: function to call.
        x: (n, n_var) decision vectors.
        first: index of the first row; rows repeat after the last.
        count: number of calls.
    """
    start = time.thread_time()
    for k in range(first, first + count):
        evaluate(x[k % len(x)])
    return (time.thread_time() - start) / count


def summary(
    times: Mapping[str, Array], average: Callable[[Array], np.floating] = np.median
) -> dict[str, float]:
    """Return the average time of each way of evaluation [ms], and its average ratio to 'compiled'.

    A ratio is taken within a round. The keys end with `_ms` and `_over_compiled`.

    Args:
        times: seconds per candidate (rounds,) of 'compiled', 'interpreted' and 'plain'.
        average: function that averages over the rounds.
    """
    ratios = {
        f"{name}_over_compiled": float(average(times[name] / times["compiled"]))
        for name in ("plain", "interpreted")
    }
    return {f"{name}_ms": 1e3 * float(average(value)) for name, value in times.items()} | ratios


def progress(text: str) -> None:
    """Print a text on the present work to standard error."""
    print(text, file=sys.stderr, flush=True)


CLOCK_ROUNDS = 2_000_000
BEST_OF = 5

RARE = frozenset({"closer", "again", "held"})
"""Names of branches of `symbolic.robot.arm.track_function` that few samples take."""

_LOOP = """
/* Additions and multiplications that wait for nothing but their own last one. */
DUAL_ARM_EXPORT double dual_arm_peak(long long rounds) {
  lanes_real a[8], m[8], step = lanes_all_equal(1e-9), factor = lanes_all_equal(1.0 + 1e-16);
  for (int i = 0; i < 8; ++i) a[i] = m[i] = lanes_all_equal(1.0 + i);
  for (long long k = 0; k < rounds; ++k) {
#pragma GCC unroll 8
    for (int i = 0; i < 8; ++i) {
      a[i] = a[i] + step;
      m[i] = m[i] * factor;
    }
  }
  lanes_real sum = lanes_all_equal(0.0);
  for (int i = 0; i < 8; ++i) sum += a[i] + m[i];
  return sum[0];
}
"""


def peak_operations() -> float | None:
    """Measure how many floating-point additions and multiplications one core can make per second
    with vector instructions.

    The result is the best of several runs of a loop with sixteen independent sequences of
    operations; None on a machine without vector instructions.
    """
    library = load_or_build_program("peak", "peak", dict, _LOOP)
    if library.dual_arm_lanes() < 2:
        return None
    loop = library.dual_arm_peak
    loop.argtypes, loop.restype = [ctypes.c_longlong], ctypes.c_double
    times = []
    for _ in range(BEST_OF):
        start = time.thread_time()
        loop(CLOCK_ROUNDS)
        times.append(time.thread_time() - start)
    return 16.0 * CLOCK_ROUNDS * int(library.dual_arm_lanes()) / min(times)


def candidate_operations(model: CellModel) -> int:
    """Return the number of operations of one candidate with collisions, counted in the CasADi
    functions.

    Branches that few samples take are left out; a sine or cosine counts as one operation.
    """
    functions = kernel_functions(model)
    each = sum(operations(functions[name], RARE) for name in ("sample", "clearance"))
    return operations(functions["path"]) + model.workcell.task.samples * each


TURN_EVALUATIONS = 1000
"""Number of evaluations of the NSGA-II search whose candidates are timed."""

POPULATION = GeneticSettings().population
"""Number of candidates per batch."""

SHARE_BATCHES = 5
"""Largest number of batches with which the shares of the time are measured."""


def with_collisions(
    workcell: Workcell, plain: Evaluate, candidates: int, repeats: int, seed: int
) -> dict[str, Any]:
    """Measure three ways to evaluate candidates with collisions: compiled, interpreted and plain.

    Times are in milliseconds per candidate, means over the rounds, since a search pays the mean and
    not the median.

    Args:
        workcell: the cell.
        plain: function that evaluates one decision vector by the plain reference code.
        candidates: number of batches for the compiled way; the other ways evaluate one candidate of
            each batch.
        repeats: number of rounds of each way.
        seed: seed of the search and the draws.

    Returns:
        Times and shares by name for candidates that a search evaluates; and, under the key
        'random', the same for candidates that are uniform within the bounds.
    """
    rng = np.random.default_rng(seed)
    progress(f"a search of {TURN_EVALUATIONS} evaluations, whose candidates are to be timed")
    evaluator = CandidateEvaluator(workcell)
    problem = CarryProblem(evaluator)
    search(problem, make("nsga2"), TURN_EVALUATIONS, rng)
    searched = rng.choice(problem.evaluations.x, (candidates, POPULATION))
    size = (candidates, POPULATION, evaluator.n_var)
    uniform = rng.uniform(evaluator.lower, evaluator.upper, size)
    functions = {
        name: InterpretedFunction(function)
        for name, function in cell_functions(evaluator.compiled.model).items()
    }
    interpreted = CandidateEvaluator(workcell, functions=functions)
    peak = peak_operations()
    ways: dict[str, Evaluate] = {
        "compiled": evaluator.evaluate,
        "interpreted": interpreted.evaluate,
        "plain": plain,
    }
    figures: list[dict[str, Any]] = []
    for what, batches in (("the search's", searched), ("random", uniform)):
        progress(f"{candidates * repeats} rounds on {what} candidates, with collisions")
        one_each = batches[:, 0]
        x = {name: batches if name == "compiled" else one_each for name in ways}
        times = interleaved(ways, x, repeats)
        times["compiled"] /= POPULATION
        verdicts = evaluator.evaluate(np.concatenate(batches))
        averages = summary(times, np.mean)
        figures.append(
            {
                **averages,
                "feasible_share": float(verdicts.feasible.mean()),
                "shares": shares(evaluator, batches[:SHARE_BATCHES], repeats),
            }
        )
    ours, random = figures
    per_second = candidate_operations(evaluator.compiled.model) / (1e-3 * ours["compiled_ms"])
    ours["operations_per_second"] = per_second
    ours["share_of_peak"] = per_second / peak if peak else None
    return {"evaluations": TURN_EVALUATIONS, "population": POPULATION, **ours, "random": random}


def shares(evaluator: CandidateEvaluator, batches: Array, repeats: int) -> dict[str, float]:
    """Measure the shares of two parts of the compiled evaluation in its time.

    The key 'candidate' is for path, arms, forces and objectives, 'collisions' for bounds, proofs
    and FCL.

    Args:
        evaluator: evaluator of the cell.
        batches: (n, size, n_var) candidates.
        repeats: number of rounds with each batch.
    """
    ways: dict[str, Evaluate] = {
        "whole": evaluator.evaluate,
        "candidate": lambda x: evaluator.evaluate(x, with_collisions=False),
    }
    times = interleaved(ways, dict.fromkeys(ways, batches), repeats)
    candidate = float(np.mean(times["candidate"] / times["whole"]))
    return {"candidate": candidate, "collisions": 1.0 - candidate}
