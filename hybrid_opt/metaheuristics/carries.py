"""A search among a cell's carries: what `ho.search` and every replica of a campaign do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.metaheuristics.problem import CarryProblem, ConstraintHandling, Evaluator
from hybrid_opt.metaheuristics.registry import make
from hybrid_opt.metaheuristics.run import search
from symbolic.array import Array


@dataclass(frozen=True)
class SearchSettings:
    """How a search is done.

    Attributes:
        algorithm: values that differ from the algorithm's defaults, see
            `hybrid_opt.metaheuristics.settings`.
        constraint_handling: 'penalty' (the paper's) or 'constraints'.
        initial: (k, n_var) decision vectors that the first generation starts with, the rest being
            uniformly random; None for what the caller starts from by default.
    """

    algorithm: Mapping[str, object] = field(default_factory=dict)
    constraint_handling: ConstraintHandling = "penalty"
    initial: Array | None = None


@dataclass(frozen=True)
class SearchedCarries:
    """All candidates of a search, in order, with its front certified.

    Attributes:
        evaluations: every candidate.
        generation: (n,) the generation of each, from 1.
    """

    evaluations: Evaluations
    generation: NDArray[np.int64]


def search_carries(
    evaluator: Evaluator,
    algorithm: str,
    evaluations: int,
    rng: np.random.Generator,
    settings: SearchSettings,
    evaluated: Callable[[int], None] = lambda count: None,
) -> SearchedCarries:
    """Spend exactly that many evaluations and certify the front of all of them.

    Args:
        algorithm: one of `hybrid_opt.metaheuristics.names()`.
        evaluated: called with the number of candidates after each batch.

    Raises:
        SettingsError: an unknown algorithm or a value that is not allowed.
    """
    problem = CarryProblem(evaluator, settings.constraint_handling, evaluated)
    search(problem, make(algorithm, settings.algorithm, settings.initial), evaluations, rng)
    sizes = [len(batch) for batch in problem.batches]
    generation = np.repeat(np.arange(1, len(sizes) + 1), sizes)
    return SearchedCarries(evaluator.certified(problem.evaluations), generation)
