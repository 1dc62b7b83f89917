"""Settings of the search algorithms, checked where they are made."""

from __future__ import annotations

from dataclasses import dataclass

from symbolic.errors import SettingsError


def _require(algorithm: str, name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise SettingsError(f"{algorithm}: {name} is {value}; allowed is {low:g} to {high:g}")


def _require_whole(algorithm: str, name: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int):
        raise SettingsError(f"{algorithm}: {name} is {value!r}; allowed are whole numbers")
    _require(algorithm, name, value, low, high)


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

    population: int = 40
    crossover_probability: float = 0.9
    crossover_eta: float = 15.0
    mutation_probability: float | None = None
    mutation_eta: float = 20.0

    def __post_init__(self) -> None:
        _require_whole("genetic algorithm", "population", self.population, 4, 100_000)
        _require("genetic algorithm", "crossover_probability", self.crossover_probability, 0.0, 1.0)
        _require("genetic algorithm", "crossover_eta", self.crossover_eta, 1.0, 1000.0)
        _require("genetic algorithm", "mutation_eta", self.mutation_eta, 1.0, 1000.0)
        if self.mutation_probability is not None:
            _require(
                "genetic algorithm", "mutation_probability", self.mutation_probability, 0.0, 1.0
            )


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

    swarm: int = 40
    archive: int = 100
    divisions: int = 30
    inertia: float = 0.4
    cognitive: float = 1.0
    social: float = 1.0
    mutation_share: float = 0.5
    horizon: int | None = None

    def __post_init__(self) -> None:
        _require_whole("mopso", "swarm", self.swarm, 1, 100_000)
        _require_whole("mopso", "archive", self.archive, 1, 100_000)
        _require_whole("mopso", "divisions", self.divisions, 1, 1000)
        _require("mopso", "inertia", self.inertia, 0.0, 1.0)
        _require("mopso", "cognitive", self.cognitive, 0.0, 4.0)
        _require("mopso", "social", self.social, 0.0, 4.0)
        _require("mopso", "mutation_share", self.mutation_share, 0.0, 1.0)
        if self.horizon is not None:
            _require_whole("mopso", "horizon", self.horizon, 1, 1_000_000_000)


@dataclass(frozen=True)
class RandomSettings:
    """Settings of uniform random search. batch: points per evaluation call."""

    batch: int = 100

    def __post_init__(self) -> None:
        _require_whole("random", "batch", self.batch, 1, 100_000)
