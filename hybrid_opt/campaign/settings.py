"""Settings of a campaign, its random generators, and the small files of its results folder: their
content as records, and their paths (docs/reference/results.md).
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from hybrid_opt import metaheuristics
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES, select_objectives
from hybrid_opt.metaheuristics.run import ConstraintHandling
from symbolic.array import Range, require_allowed
from symbolic.errors import SettingsError

FirstGeneration = Literal["initial", "random"]
"""'random': all candidates are uniformly random. 'initial': one of them is the hand-made
trajectory."""

Budget = Annotated[int, Range(1, 10**9)]
Runs = Annotated[int, Range(1, 10_000)]
Seed = Annotated[int, Range(0, 2**63 - 1)]

ALGORITHMS = ("nsga2", "mopso")
"""Default search algorithms of a campaign."""

SIZE_KEYS = ("population", "swarm", "batch")
"""Names of the setting for the number of candidates per generation, in all algorithms."""


def sized(algorithm: str, size: int) -> dict[str, Any]:
    """Return the settings of an algorithm, as values by name, that make it evaluate `size`
    candidates per generation."""
    known = asdict(metaheuristics.settings_of(algorithm))
    return {key: size for key in SIZE_KEYS if key in known}


def chosen(
    names: Sequence[str], populations: Sequence[tuple[str, int]] = ()
) -> dict[str, dict[str, Any]]:
    """Return the algorithms of a campaign by name, each with its settings that are not the
    defaults.

    Args:
        names: names of search algorithms in `hybrid_opt.metaheuristics`, each once.
        populations: pairs of algorithm and candidates per generation, each algorithm at most once.

    Raises:
        SettingsError: `names` is empty or has a name twice, or `populations` has an algorithm twice
            or one that is not in `names`.
    """
    if not names or len(set(names)) != len(names):
        raise SettingsError(
            f"algorithms {tuple(names)}: name at least one, each once", code="repeated"
        )
    sizes = dict(populations)
    if len(sizes) != len(populations) or not sizes.keys() <= set(names):
        raise SettingsError(
            f"populations for {', '.join(name for name, _ in populations)}: name each algorithm of "
            f"the campaign ({', '.join(names)}) at most once",
            code="repeated",
        )
    return {name: sized(name, sizes[name]) if name in sizes else {} for name in names}


@dataclass(frozen=True)
class CampaignSettings:
    """Everything that determines the results of a campaign, apart from the workcell.

    Attributes:
        algorithms: settings of each algorithm by algorithm name (`hybrid_opt.metaheuristics`);
            missing settings get their defaults.
        evaluations: number of candidates that every replica evaluates.
        replicas: number of independent runs per algorithm.
        seed: seed of the campaign, from which every replica derives its own.
        objectives: names of objectives in `hybrid_opt.evaluate.objectives`, each once.
        constraint_handling: 'penalty' (the paper's) or 'constraints'.
        first_generation: candidates at the start of a search, 'initial' or 'random'; the random
            search ignores this setting.
    """

    algorithms: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: chosen(ALGORITHMS))
    evaluations: Budget = 1000
    replicas: Runs = 10
    seed: Seed = 1
    objectives: tuple[str, ...] = PAPER_OBJECTIVES
    constraint_handling: ConstraintHandling = "penalty"
    first_generation: FirstGeneration = "initial"

    def __post_init__(self) -> None:
        """Check every value, and add the defaults of the algorithms' settings.

        Raises:
            SettingsError: a value is not allowed; the message states the allowed values.
        """
        require_allowed(self)
        select_objectives(self.objectives)
        if not self.algorithms:
            raise SettingsError("algorithms: name at least one", code="no-algorithm")
        whole = {
            name: asdict(metaheuristics.settings_of(name, own))
            for name, own in self.algorithms.items()
        }
        object.__setattr__(self, "algorithms", whole)

    def starts_from_initial(self, algorithm: str) -> bool:
        """Return True if the first generation of an algorithm contains the hand-made trajectory."""
        return self.first_generation == "initial" and algorithm != "random"

    def replica_rng(self, algorithm: str, replica: int) -> np.random.Generator:
        """Return the random generator of one replica, its only source of randomness.

        The generator depends only on the campaign's seed and both arguments. It does not depend on
        other algorithms, the number of replicas, or the order of work.

        Args:
            algorithm: name of the search algorithm.
            replica: number of the replica, from 0.
        """
        key = (zlib.crc32(algorithm.encode()), replica)
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))


Seconds = Annotated[float, Range(0.0, 1e12)]

StageStatus = Literal["running", "done", "outdated"]


@dataclass(frozen=True)
class StoredCell:
    """Identity of the workcell of a campaign.

    Attributes:
        name: title of the workcell.
        file: path of the workcell's copy, relative to the results folder.
        digest: digest of the workcell file and of the files that it names.
    """

    name: str
    file: str
    digest: str


@dataclass(frozen=True)
class Configuration:
    """Content of configuration.json: everything that determines the results of a campaign.

    Attributes:
        format: name of the file format.
        version: version of the file format.
        workcell: identity of the workcell.
        settings: settings of the campaign.
        environment: versions of the software that affects a search, by name.
    """

    format: str
    version: int
    workcell: StoredCell
    settings: CampaignSettings
    environment: Mapping[str, str]


@dataclass(frozen=True)
class StageMark:
    """Content of the file stages/NAME.json: status, settings and computing time [s] of one stage of
    a study.
    """

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
POLISHED_FOLDER = "polished"
POLISHED_SUFFIX = "-polished"
DRIVABLE = "drivable"
RECOMMENDED_FILE = "recommended.json"
RECOMMENDATION = "recommendation.json"
NO_RECOMMENDATION = "no-recommendation.json"
SIMULATED = "simulated"
HAND_MADE_FILE = "hand-made.json"


UNION = "union"
"""Name of the front of all replicas together, in place of an algorithm's name.

A drivable experiment polishes this front alone."""


def replica_file(root: Path, algorithm: str, replica: int) -> Path:
    """Return the path of the file of all candidates of one replica.

    Args:
        root: the results folder.
        algorithm: name of the search algorithm.
        replica: number of the replica, from 0.
    """
    return root / REPLICAS / algorithm / f"{replica:02d}.csv.gz"


def selected_file(root: Path, algorithm: str, replica: int) -> Path:
    """Return the path of the trajectory file of the carry that was selected from the front of one
    replica.

    Args:
        root: the results folder.
        algorithm: name of the search algorithm.
        replica: number of the replica, from 0.
    """
    return root / SELECTED / algorithm / f"{replica:02d}.json"


def polished_file(root: Path, algorithm: str, replica: int) -> Path:
    """Return the path of the file of a polished front.

    Args:
        root: the results folder.
        algorithm: name of the search algorithm; `UNION` for the front of all replicas together.
        replica: number of the replica, from 0.
    """
    return root / POLISHED_FOLDER / algorithm / f"{replica:02d}.json"


def polished_selected_file(root: Path, algorithm: str, replica: int) -> Path:
    """Return the path of the trajectory file of the carry that was selected from the polished front
    of one replica.

    Args:
        root: the results folder.
        algorithm: name of the search algorithm.
        replica: number of the replica, from 0.
    """
    return root / SELECTED / f"{algorithm}{POLISHED_SUFFIX}" / f"{replica:02d}.json"


def reference_front_file(root: Path) -> Path:
    """Return the path of the file of the reference front: the non-dominated carries of all fronts
    of the campaign.
    """
    return root / FRONTS / "reference.csv"
