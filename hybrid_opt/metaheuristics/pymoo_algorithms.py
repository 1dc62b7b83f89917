"""pymoo's NSGA-II and SMS-EMOA with this project's guarantees, and uniform random search."""

from __future__ import annotations

from typing import Any

from pymoo.algorithms.moo.nsga2 import NSGA2, binary_tournament
from pymoo.algorithms.moo.sms import SMSEMOA, cv_and_dom_tournament
from pymoo.core.algorithm import Algorithm
from pymoo.core.duplicate import DefaultDuplicateElimination
from pymoo.core.population import Population
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM
from pymoo.operators.selection.tournament import TournamentSelection

from hybrid_opt.metaheuristics.guarded import FillingMating, Guarded, WarmSampling, feasible_front
from hybrid_opt.metaheuristics.settings import GeneticSettings, RandomSettings
from symbolic.array import Array


class GuardedNsga2(Guarded, NSGA2):  # type: ignore[misc]
    """NSGA-II (Deb et al. 2002) of pymoo with `Guarded`'s promises."""


class GuardedSmsEmoa(Guarded, SMSEMOA):  # type: ignore[misc]
    """SMS-EMOA (Beume et al. 2007) of pymoo, with a whole generation of offspring at a time."""


def _mating(settings: GeneticSettings, compare: Any) -> FillingMating:
    return FillingMating(
        TournamentSelection(func_comp=compare),
        SBX(eta=settings.crossover_eta, prob=settings.crossover_probability),
        PM(eta=settings.mutation_eta, prob_var=settings.mutation_probability),
        eliminate_duplicates=DefaultDuplicateElimination(),
    )


def nsga2(settings: GeneticSettings, initial: Array | None) -> Algorithm:
    """NSGA-II; constraint domination where the problem has constraints."""
    return GuardedNsga2(
        pop_size=settings.population,
        sampling=WarmSampling(initial),
        mating=_mating(settings, binary_tournament),
    )


def sms_emoa(settings: GeneticSettings, initial: Array | None) -> Algorithm:
    """SMS-EMOA; feasible before infeasible where the problem has constraints."""
    return GuardedSmsEmoa(
        pop_size=settings.population,
        sampling=WarmSampling(initial),
        mating=_mating(settings, cv_and_dom_tournament),
    )


class RandomSearch(Guarded, Algorithm):  # type: ignore[misc]
    """Uniform random points within the bounds: the floor that any search has to beat."""

    def __init__(
        self, settings: RandomSettings, initial: Array | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.settings = settings
        self.sampling = WarmSampling(initial)
        self.uniform = WarmSampling()

    def _initialize_infill(self) -> Population:
        return self.sampling(self.problem, self.settings.batch, random_state=self.random_state)

    def _initialize_advance(self, infills: Population, **kwargs: Any) -> None:
        self.members = feasible_front(infills)

    def _infill(self) -> Population:
        return self.uniform(self.problem, self.settings.batch, random_state=self.random_state)

    def _advance(self, infills: Population, **kwargs: Any) -> None:
        self.pop = infills
        self.members = feasible_front(Population.merge(self.members, infills))

    def _set_optimum(self) -> None:
        self.opt = self.members
