"""The search algorithms by name: MOPSO, pymoo's NSGA-II and SMS-EMOA with this project's promises,
and uniform random search. pymoo's MOPSO_CD, CMOPSO and NSGA3 draw from unseeded generators."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from pymoo.algorithms.moo.nsga2 import NSGA2, binary_tournament
from pymoo.algorithms.moo.sms import SMSEMOA, cv_and_dom_tournament
from pymoo.core.algorithm import Algorithm
from pymoo.core.duplicate import DefaultDuplicateElimination
from pymoo.core.population import Population
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM
from pymoo.operators.selection.tournament import TournamentSelection

from hybrid_opt.metaheuristics.guarded import (
    ExhaustiveMating,
    Guarded,
    WarmSampling,
    feasible_front,
)
from hybrid_opt.metaheuristics.mopso import Mopso, MopsoSettings, Points, Share
from symbolic.array import Array, Range, require_allowed
from symbolic.errors import SettingsError
from symbolic.records.problems import shown

Index = Annotated[float, Range(1.0, 1000.0)]


@dataclass(frozen=True)
class GeneticSettings:
    """Settings of NSGA-II and SMS-EMOA.

    Attributes:
        population: points per generation; at 1000 evaluations 40 does better than 100.
        crossover_probability: of simulated binary crossover per mating.
        crossover_eta: its distribution index, greater keeps children nearer to the parents.
        mutation_probability: of polynomial mutation per variable, None for 1 / n_var.
        mutation_eta: its distribution index.
    """

    population: Annotated[int, Range(4, 100_000)] = 40
    crossover_probability: Share = 0.9
    crossover_eta: Index = 15.0
    mutation_probability: Share | None = None
    mutation_eta: Index = 20.0

    def __post_init__(self) -> None:
        require_allowed(self, "genetic algorithm: ")


@dataclass(frozen=True)
class RandomSettings:
    """Settings of uniform random search. batch: points per evaluation call."""

    batch: Points = 100

    def __post_init__(self) -> None:
        require_allowed(self, "random: ")


AlgorithmSettings = GeneticSettings | MopsoSettings | RandomSettings


class GuardedNsga2(Guarded, NSGA2):  # type: ignore[misc]
    """NSGA-II (Deb et al. 2002) of pymoo with `Guarded`'s promises; constraint domination where the
    problem has constraints."""


class GuardedSmsEmoa(Guarded, SMSEMOA):  # type: ignore[misc]
    """SMS-EMOA (Beume et al. 2007) of pymoo, with a whole generation of offspring at a time;
    feasible before infeasible where the problem has constraints."""


def _genetic(
    kind: type[Algorithm], compare: Any, settings: GeneticSettings, initial: Array | None
) -> Algorithm:
    """Build an algorithm that mates the winners of tournaments decided by `compare`."""
    mating = ExhaustiveMating(
        TournamentSelection(func_comp=compare),
        SBX(eta=settings.crossover_eta, prob=settings.crossover_probability),
        PM(eta=settings.mutation_eta, prob_var=settings.mutation_probability),
        eliminate_duplicates=DefaultDuplicateElimination(),
    )
    return kind(pop_size=settings.population, sampling=WarmSampling(initial), mating=mating)


class RandomSearch(Guarded, Algorithm):  # type: ignore[misc]
    """Uniform random points within the bounds: the baseline of every search."""

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


@dataclasses.dataclass(frozen=True)
class _Entry:
    title: str
    build: Callable[[Any, Array | None], Algorithm]
    defaults: AlgorithmSettings


_NSGA2 = partial(_genetic, GuardedNsga2, binary_tournament)
_SMS_EMOA = partial(_genetic, GuardedSmsEmoa, cv_and_dom_tournament)

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
    """Return the names that `make` accepts."""
    return tuple(REGISTRY)


def algorithms() -> dict[str, str]:
    """Return the searches that `make` accepts: titles by name."""
    return {name: entry.title for name, entry in REGISTRY.items()}


def title(name: str) -> str:
    """Return an algorithm's title in print; an unknown name is returned unchanged."""
    return REGISTRY[name].title if name in REGISTRY else name


def settings_of(name: str, overrides: Mapping[str, object] | None = None) -> AlgorithmSettings:
    """Return the effective settings of an algorithm: its defaults with `overrides`.

    Raises:
        SettingsError: unknown algorithm or setting, or a value outside its range.
    """
    if name not in REGISTRY:
        raise SettingsError(
            f"unknown algorithm {shown(name)}; known are {', '.join(REGISTRY)}",
            code="unknown-algorithm",
        )
    defaults = REGISTRY[name].defaults
    known = [field.name for field in dataclasses.fields(defaults)]
    unknown = [key for key in overrides or {} if key not in known]
    if unknown:
        raise SettingsError(
            f"{name}: unknown setting {', '.join(unknown)}; known are {', '.join(known)}",
            code="unknown-setting",
        )
    return dataclasses.replace(defaults, **dict(overrides or {}))  # type: ignore[arg-type]


def make(
    name: str,
    settings: AlgorithmSettings | Mapping[str, object] | None = None,
    initial: Array | None = None,
) -> Algorithm:
    """Build a fresh algorithm for one run.

    Args:
        name: one of `names()`.
        settings: from `settings_of`, or values that differ from the defaults, see
            `hybrid_opt.metaheuristics.registry`.
        initial: (k, n_var) decision vectors that the first generation starts with, the rest
            being uniformly random; None for all random.

    Raises:
        SettingsError: as `settings_of`; wrong `initial` points are refused when the run starts.
    """
    if dataclasses.is_dataclass(settings):
        settings = dataclasses.asdict(settings)
    effective = settings_of(name, settings)
    return REGISTRY[name].build(effective, initial)
