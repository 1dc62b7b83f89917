"""Settings of a campaign and the source of its randomness; the small files of its results folder as
records, and where they lie (docs/results.md)."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from hybrid_opt import metaheuristics
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES, select_objectives
from hybrid_opt.metaheuristics.run import ConstraintHandling
from symbolic.array import Count, Range, require_allowed
from symbolic.errors import SettingsError

FirstGeneration = Literal["initial", "random"]
"""'initial': uniformly random but for the workcell's hand-made trajectory; 'random': all."""

Budget = Annotated[int, Range(1, 10**9)]
Runs = Annotated[int, Range(1, 10_000)]
Seed = Annotated[int, Range(0, 2**63 - 1)]

SIZE_KEYS = ("population", "swarm", "batch")
"""How the algorithms' settings call the candidates of one generation."""


@dataclass(frozen=True)
class CampaignSettings:
    """Everything that decides a campaign's results, besides the workcell.

    Attributes:
        algorithms: names known to `hybrid_opt.metaheuristics`, each once.
        evaluations: budget of every replica.
        replicas: independent runs per algorithm.
        seed: the campaign's seed; every replica derives its own from it.
        objectives: names known to `hybrid_opt.evaluate.objectives`, each once.
        constraint_handling: 'penalty' (the paper's) or 'constraints'.
        first_generation: what the searches start from; uniform random search is always all random.
        populations: (algorithm, candidates per generation) where not the algorithm's default.
    """

    algorithms: tuple[str, ...] = ("nsga2", "mopso")
    evaluations: Budget = 1000
    replicas: Runs = 10
    seed: Seed = 1
    objectives: tuple[str, ...] = PAPER_OBJECTIVES
    constraint_handling: ConstraintHandling = "penalty"
    first_generation: FirstGeneration = "initial"
    populations: tuple[tuple[str, int], ...] = ()

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            SettingsError: with the value, and what is allowed.
        """
        require_allowed(self)
        select_objectives(self.objectives)
        if not self.algorithms or len(set(self.algorithms)) != len(self.algorithms):
            raise SettingsError(f"algorithms {self.algorithms}: name at least one, each once")
        sized = [name for name, _ in self.populations]
        strays = [name for name in sized if name not in self.algorithms]
        if strays or len(set(sized)) != len(sized):
            raise SettingsError(
                f"populations for {', '.join(sized)}: name each algorithm of the campaign "
                f"({', '.join(self.algorithms)}) at most once"
            )
        for name in self.algorithms:
            metaheuristics.settings_of(name, self.overrides(name))

    def overrides(self, algorithm: str) -> dict[str, object]:
        """The settings of an algorithm that differ from its defaults."""
        size = dict(self.populations).get(algorithm)
        if size is None:
            return {}
        known = {field.name for field in fields(metaheuristics.settings_of(algorithm))}
        return {key: size for key in SIZE_KEYS if key in known}

    def starts_from_initial(self, algorithm: str) -> bool:
        """Whether an algorithm's first generation holds the hand-made trajectory."""
        return self.first_generation == "initial" and algorithm != "random"

    def effective(self) -> dict[str, Any]:
        """Every setting as JSON values, the algorithms' own ones spelt out."""
        values = asdict(self)
        del values["populations"]
        values["algorithms"] = {
            name: asdict(metaheuristics.settings_of(name, self.overrides(name)))
            for name in self.algorithms
        }
        values["objectives"] = list(self.objectives)
        return values

    def replica_rng(self, algorithm: str, replica: int) -> np.random.Generator:
        """The only source of randomness of one replica.

        It depends on the campaign's seed, the algorithm's name and the replica's number alone:
        not on other algorithms, on the number of replicas, or on the order of work.
        """
        key = (zlib.crc32(algorithm.encode()), replica)
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))


Seconds = Annotated[float, Range(0.0, 1e12)]

StageStatus = Literal["running", "done", "outdated"]


@dataclass(frozen=True)
class StoredCell:
    """The workcell of a campaign.

    Attributes:
        name: for people.
        file: of the folder's copy, relative to the folder.
        digest: of the workcell.
    """

    name: str
    file: str
    digest: str


@dataclass(frozen=True)
class StoredSettings:
    """`CampaignSettings.effective` as it was stored; the algorithms' own settings by name."""

    algorithms: Mapping[str, Mapping[str, Any]]
    evaluations: Budget
    replicas: Runs
    seed: Seed
    objectives: tuple[str, ...]
    constraint_handling: ConstraintHandling
    first_generation: FirstGeneration

    def __post_init__(self) -> None:
        """Refuse what no campaign has."""
        if not self.algorithms or not self.objectives:
            raise ValueError("names no algorithm or no objective")


@dataclass(frozen=True)
class Configuration:
    """configuration.json: what the results depend on."""

    format: str
    version: int
    workcell: StoredCell
    settings: StoredSettings
    environment: Mapping[str, str]


@dataclass(frozen=True)
class FinishedReplica:
    """replica.json, written last: with it, a replica is done.

    Attributes:
        algorithm, replica: which one.
        evaluations: candidates.
        seconds: what the search took.
        sha256: checksums of its files by name.
    """

    algorithm: str
    replica: Count
    evaluations: Count
    seconds: Seconds
    sha256: Mapping[str, str]


@dataclass(frozen=True)
class StageMark:
    """stages/NAME.json: how far a stage is, its own settings, and the time spent on it [s]."""

    status: StageStatus
    settings: Mapping[str, Any]
    seconds: Seconds


CONFIGURATION = "configuration.json"
SUMMARY = "summary.json"
BRANCHES = "branches.json"
WORKCELL = "workcell"
REPLICAS = "replicas"
STAGES = "stages"
FRONTS = "fronts"
SELECTED = "selected"
POLISHED = "polished"
POLISHED_SUFFIX = "-polished"
DRIVABLE = "drivable"
RECOMMENDED = "recommended.json"
RECOMMENDATION = "recommendation.json"
NO_RECOMMENDATION = "no-recommendation.json"
SIMULATED = "simulated"
HAND_MADE = "hand-made.json"

EVALUATIONS = "evaluations.csv.gz"
FRONT = "front.csv"
DONE = "replica.json"
JOURNAL = "journal.bin"
POLISH = "polish.json"


def replica_folder(root: Path, algorithm: str, replica: int) -> Path:
    """Folder of one replica, counted from 0."""
    return root / REPLICAS / algorithm / f"{replica:02d}"


def selected_file(root: Path, algorithm: str, replica: int) -> Path:
    """Trajectory file of the solution selected from one replica."""
    return root / SELECTED / algorithm / f"{replica:02d}.json"


def polished_folder(root: Path, algorithm: str, replica: int) -> Path:
    """Folder of what the polish made of one replica's front."""
    return root / POLISHED / algorithm / f"{replica:02d}"


def polished_selected_file(root: Path, algorithm: str, replica: int) -> Path:
    """Trajectory file of the solution selected from a replica's polished front."""
    return root / SELECTED / f"{algorithm}{POLISHED_SUFFIX}" / f"{replica:02d}.json"


def reference_front_file(root: Path) -> Path:
    """Non-dominated union of all fronts of the campaign."""
    return root / FRONTS / "reference.csv"
