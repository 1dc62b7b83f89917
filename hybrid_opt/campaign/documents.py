"""The small files of a results folder as records. docs/results.md describes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from hybrid_opt.campaign.settings import FirstGeneration
from hybrid_opt.metaheuristics.problem import ConstraintHandling
from hybrid_opt.store.json_records import Figure, Range, Shape
from symbolic.array import Array

Count = Annotated[int, Range(0, 10**12)]
Seconds = Annotated[float, Range(0.0, 1e12)]
Pair = Annotated[Array, Shape((2,))]
"""One number per robot."""

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
    evaluations: Annotated[int, Range(1, 10**9)]
    replicas: Annotated[int, Range(1, 10_000)]
    seed: Annotated[int, Range(0, 2**63 - 1)]
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


@dataclass(frozen=True)
class FrontPoint:
    """A point of a polished front.

    Attributes:
        objectives, x: (2,) and (n_var,).
        parent: row of the searched front that it replaced or still is, -1 for a new one.
        polished: whether the polish made it.
    """

    objectives: Annotated[Array, Shape((2,))]
    x: Annotated[Array, Shape((None,))]
    parent: Annotated[int, Range(-1, 10**9)]
    polished: bool


@dataclass(frozen=True)
class PolishEffort:
    """Effort and success of a polish.

    Attributes:
        solver: what solved its programs: 'dense', 'ipopt', or 'quadratic' for drivable carries.
        attempts: solves.
        counts: attempts by status, and those not accepted also by 'status: reason'.
        success_share: of the front's own points, those accepted or optimal.
        seconds, median_attempt_seconds: spent in total and per attempt.
        equivalent_evaluations: candidate evaluations that take as long.
        widest_gap: share of the front's length between the neighbours that are farthest apart.
        worst_stationarity, worst_feasibility, median_stationarity: residuals of the points that a
            solve made and that stand on the front in the end.
    """

    solver: str
    attempts: Count
    counts: Mapping[str, Count]
    success_share: Figure
    seconds: Seconds
    median_attempt_seconds: Figure
    equivalent_evaluations: Count
    widest_gap: Figure
    worst_stationarity: Figure
    worst_feasibility: Figure
    median_stationarity: Figure


@dataclass(frozen=True)
class PolishDocument:
    """polish.json: a polished front, what it took, and every attempt as its journal has it."""

    front: tuple[FrontPoint, ...]
    figures: PolishEffort
    attempts: tuple[Mapping[str, Any], ...]
