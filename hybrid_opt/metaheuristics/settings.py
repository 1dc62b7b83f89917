"""Settings of the search algorithms, checked where they are made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from symbolic.array import Range, require_allowed

Share = Annotated[float, Range(0.0, 1.0)]
Index = Annotated[float, Range(1.0, 1000.0)]
Pull = Annotated[float, Range(0.0, 4.0)]
Points = Annotated[int, Range(1, 100_000)]


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
class MopsoSettings:
    """Settings of MOPSO; the defaults except the swarm are those of the 2002 and 2004 papers.

    Constriction coefficients (inertia 0.7298, both pulls 1.496) are far worse at 1000 evaluations
    (shifted ZDT1: IGD 0.91).

    Attributes:
        swarm: particles.
        archive: capacity of the external archive.
        divisions: hypercubes per objective.
        inertia, cognitive, social: factors of the old velocity, of the pull towards the
            personal best and of that towards the leader.
        mutation_share: part of the run over which the turbulence fades to nothing.
        horizon: evaluations of the whole run, None to take them from the termination.
    """

    swarm: Points = 40
    archive: Points = 100
    divisions: Annotated[int, Range(1, 1000)] = 30
    inertia: Share = 0.4
    cognitive: Pull = 1.0
    social: Pull = 1.0
    mutation_share: Share = 0.5
    horizon: Annotated[int, Range(1, 10**9)] | None = None

    def __post_init__(self) -> None:
        require_allowed(self, "mopso: ")


@dataclass(frozen=True)
class RandomSettings:
    """Settings of uniform random search. batch: points per evaluation call."""

    batch: Points = 100

    def __post_init__(self) -> None:
        require_allowed(self, "random: ")


AlgorithmSettings = GeneticSettings | MopsoSettings | RandomSettings
