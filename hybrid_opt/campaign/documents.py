"""The small files of a results folder as records, and where they lie (docs/results.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from hybrid_opt.campaign.settings import Budget, FirstGeneration, Runs, Seed
from hybrid_opt.metaheuristics.run import ConstraintHandling
from symbolic.array import Count, Range

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
