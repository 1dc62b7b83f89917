"""summary.json as records: the figures of a campaign. docs/results.md describes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from hybrid_opt.campaign.documents import (
    Count,
    Pair,
    PolishEffort,
    Seconds,
    StoredCell,
    StoredSettings,
)
from hybrid_opt.campaign.recommended import StoredRecommendation
from hybrid_opt.store.json_records import Figure, Range, Shape
from symbolic.array import Array

Share = Annotated[float, Range(0.0, 1.0)]


@dataclass(frozen=True)
class Statistics:
    """`hybrid_opt.indicators.statistics.Summary` of one figure, as stored."""

    count: Count
    missing: Count
    mean: Figure
    std: Figure
    minimum: Figure
    quartile1: Figure
    median: Figure
    quartile3: Figure
    maximum: Figure


@dataclass(frozen=True)
class StoredTest:
    """`hybrid_opt.indicators.statistics.RankTest` of one figure, as stored."""

    figure: str
    first: str
    second: str
    count_first: Count
    count_second: Count
    u: Figure
    p: Figure
    p_holm: Figure
    a12: Figure
    magnitude: Literal["negligible", "small", "medium", "large"]


@dataclass(frozen=True)
class SelectedEntry:
    """The solution selected from a front.

    Attributes:
        evaluation: its number, from 1.
        file: its trajectory file, relative to the folder.
        objectives: (n_obj,).
        peak_normal_force, minimum_normal_force: per robot [N].
        excess_above_static: per robot [%].
        payload_limit: [kg].
        duration: [s].
    """

    evaluation: Count
    file: str | None
    objectives: Annotated[Array, Shape((None,))]
    peak_normal_force: Pair
    minimum_normal_force: Pair
    excess_above_static: Pair
    payload_limit: float
    duration: float


@dataclass(frozen=True)
class FrontFigures:
    """Indicators of a front, and of the solution selected from it.

    Attributes:
        non_dominated: points.
        hypervolume, igd, igd_plus, spacing: see `hybrid_opt.indicators.metrics`.
        mean_excess_above_static: of the selected solution [%].
        payload_limit: of the selected solution [kg].
        selected: None where no candidate is feasible.
    """

    non_dominated: Count
    hypervolume: float
    igd: Figure
    igd_plus: Figure
    spacing: Figure
    mean_excess_above_static: Figure
    payload_limit: Figure
    selected: SelectedEntry | None


@dataclass(frozen=True)
class PolishedFigures(PolishEffort, FrontFigures):
    """A replica's polished front, and the effort."""


@dataclass(frozen=True)
class ReplicaFigures(FrontFigures):
    """One replica.

    Attributes:
        replica: its number, from 0.
        evaluations, feasible, feasible_share: candidates.
        seconds: what the search took.
        infeasible_by_reason: candidates by what made them infeasible.
        best_so_far: evaluations at which the best of an objective changed: number, then the best.
        polished: None without a polish.
    """

    replica: Count
    evaluations: Annotated[int, Range(1, 10**12)]
    feasible: Count
    feasible_share: Share
    seconds: Seconds
    infeasible_by_reason: Mapping[str, Count]
    best_so_far: tuple[Annotated[Array, Shape((None,))], ...]
    polished: PolishedFigures | None = None


@dataclass(frozen=True)
class PolishedStatistics:
    """An algorithm's polished fronts, over the replicas."""

    statistics: Mapping[str, Statistics]
    hypervolume_gain: Statistics
    replicas_improved: Count


@dataclass(frozen=True)
class AlgorithmFigures:
    """One algorithm.

    Attributes:
        representative: the replica with the largest hypervolume, None if it found nothing.
        statistics: by figure, over the replicas.
        replicas: in order.
        polished: None without a polish.
    """

    representative: int | None
    statistics: Mapping[str, Statistics]
    replicas: tuple[ReplicaFigures, ...]
    polished: PolishedStatistics | None = None

    def __post_init__(self) -> None:
        """Refuse what does not belong together."""
        if not self.replicas:
            raise ValueError("has no replicas")
        if self.representative is not None and not (
            0 <= self.representative < len(self.replicas)
            and self.replicas[self.representative].selected is not None
        ):
            raise ValueError("its representative replica selected no solution")


@dataclass(frozen=True)
class StaticForces:
    """Forces of the payload held level and still: per robot [N], and the payload limit [kg]."""

    normal_force: Pair
    contact_force: Pair
    payload_limit: float


@dataclass(frozen=True)
class StoredFront:
    """The campaign's reference front: its file, points and hypervolume."""

    file: str
    points: Count
    hypervolume: float


@dataclass(frozen=True)
class StoredBound:
    """A bound of the decision variables that solutions lie on, see `hybrid_opt.indicators.metrics`.

    Attributes:
        variable, side, value: which bound [m, rad].
        solutions: how many lie on it.
    """

    variable: str
    side: Literal["lower", "upper"]
    value: float
    solutions: Count


@dataclass(frozen=True)
class Bounds:
    """Bounds of the decision variables on which members of the best fronts lie.

    Attributes:
        solutions: members of these fronts, polished where they were.
        binding: the bounds that some of them lie on.
    """

    solutions: Count
    binding: tuple[StoredBound, ...]


NO_BOUNDS = Bounds(0, ())


@dataclass(frozen=True)
class CampaignSummary:
    """summary.json.

    Attributes:
        robots: their names, in the order of all pairs.
        recommendation: the carry to run, None where the study has none.
        no_recommendation: why it has none, '' where it has one or where the study is part of
            another, which recommends.
    """

    workcell: StoredCell
    robots: tuple[str, ...]
    settings: StoredSettings
    environment: Mapping[str, str]
    objectives: tuple[str, ...]
    reference_force: Pair
    static_hold: StaticForces
    reference_front: StoredFront
    algorithms: Mapping[str, AlgorithmFigures]
    tests: tuple[StoredTest, ...]
    bounds: Bounds = NO_BOUNDS
    recommendation: StoredRecommendation | None = None
    no_recommendation: str = ""

    def __post_init__(self) -> None:
        """Refuse what does not belong together."""
        if len(self.robots) != 2:
            raise ValueError("does not name two robots")
        if list(self.algorithms) != list(self.settings.algorithms):
            raise ValueError("its algorithms are not those of its settings")
        for name, entry in self.algorithms.items():
            if len(entry.replicas) != self.settings.replicas:
                raise ValueError(f"algorithms.{name} has not as many replicas as the settings say")
        strays = {name for test in self.tests for name in (test.first, test.second)}
        if not strays <= self.algorithms.keys():
            raise ValueError("its tests name unknown algorithms")
