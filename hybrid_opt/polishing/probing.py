"""Starts far from a front: many short solves, of which the better half goes on each time.

A front's ends and its middle lie in several basins, and a search's front in few of them. What a
short solve reaches from a random feasible candidate tells which ones deserve more (successive
halving, Jamieson and Talwalkar 2016). Everything that is reached enters the archive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.archive import LEAST_SPAN
from hybrid_opt.polishing.feasible import first_feasible
from hybrid_opt.polishing.plan import Attempt
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.targets import balance, extreme
from symbolic.array import Array


@dataclass(frozen=True)
class Start:
    """A feasible decision vector (n_var,) and its objectives (2,); spent where a solve from it came
    no further, as would every other."""

    x: Array
    objectives: Array
    spent: bool = False

    def value(self, objective: int | None) -> float:
        """The objective that is aimed at, or the sum of both."""
        return float(self.objectives.sum() if objective is None else self.objectives[objective])

    def probe(self, objective: int | None, settings: PolishSettings) -> Attempt:
        """A short solve from here towards an end of the front, or its balanced middle."""
        span = np.full(2, LEAST_SPAN)
        if objective is None:
            target = balance(self.objectives, span)
        else:
            target = extreme(self.objectives, span, objective)
        radius = settings.trust.first
        return Attempt("probe", -1, self.x, self.objectives, target, radius, brief=True)


def random_starts(
    evaluator: CandidateEvaluator, settings: PolishSettings, count: int, rng: np.random.Generator
) -> list[Start]:
    """Feasible ones among random candidates, at most so many."""
    shape = settings.probe.candidates, evaluator.n_var
    candidates = rng.uniform(evaluator.lower, evaluator.upper, shape)
    rows, objectives = first_feasible(evaluator, candidates, count)
    return list(map(Start, candidates[rows], objectives))


def halve(pool: list[Start], objective: int | None, solve: Callable[[Start], Start]) -> None:
    """Solve from all starts, then from the better half of what was reached, until one is left."""
    while pool:
        reached = [start if start.spent else solve(start) for start in pool]
        pool = better_half(reached, objective)


def better_half(reached: list[Start], objective: int | None) -> list[Start]:
    """Those that go on, the best first; none after the last."""
    ranked = sorted(reached, key=lambda start: start.value(objective))
    return ranked[: len(reached) // 2]
