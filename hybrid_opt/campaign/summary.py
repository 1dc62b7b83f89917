"""summary.json as records: the figures of a campaign. docs/results.md describes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from hybrid_opt.campaign.documents import Seconds, StoredCell, StoredSettings
from hybrid_opt.campaign.recommended import StoredRecommendation
from hybrid_opt.indicators.metrics import BindingBound
from hybrid_opt.indicators.statistics import RankTest, Summary
from hybrid_opt.polishing.records import PolishEffort
from hybrid_opt.static_hold import StaticHold
from symbolic.array import Count, Figure, Pair, Range, Row

Share = Annotated[float, Range(0.0, 1.0)]


@dataclass(frozen=True)
class SelectedEntry:
    """The solution selected from a front, or the hand-made trajectory.

    Attributes:
        evaluation: its number, from 1; 0 for the hand-made one.
        file: its trajectory file, relative to the folder.
        objectives: (n_obj,).
        peak_normal_force, minimum_normal_force: per robot [N].
        excess_above_static: per robot [%].
        payload_limit: [kg].
        duration: [s].
        feasible: the evaluator's verdict.
    """

    evaluation: Count
    file: str | None
    objectives: Row
    peak_normal_force: Pair
    minimum_normal_force: Pair
    excess_above_static: Pair
    payload_limit: float
    duration: float
    feasible: bool = True

    @property
    def mean_excess_above_static(self) -> float:
        """Mean of both robots' [%]."""
        return float(self.excess_above_static.mean())


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
    best_so_far: tuple[Row, ...]
    polished: PolishedFigures | None = None


@dataclass(frozen=True)
class PolishedStatistics:
    """An algorithm's polished fronts, over the replicas."""

    statistics: Mapping[str, Summary]
    hypervolume_gain: Summary
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
    statistics: Mapping[str, Summary]
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
class StoredFront:
    """The campaign's reference front: its file, points and hypervolume."""

    file: str
    points: Count
    hypervolume: float


@dataclass(frozen=True)
class Bounds:
    """Bounds of the decision variables on which members of the best fronts lie.

    Attributes:
        solutions: members of these fronts, polished where they were.
        binding: the bounds that some of them lie on.
    """

    solutions: Count
    binding: tuple[BindingBound, ...]


NO_BOUNDS = Bounds(0, ())


@dataclass(frozen=True)
class CampaignSummary:
    """summary.json.

    Attributes:
        robots: their names, in the order of all pairs.
        hand_made: the workcell file's own trajectory, None where it has no forces.
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
    static_hold: StaticHold
    reference_front: StoredFront
    algorithms: Mapping[str, AlgorithmFigures]
    tests: tuple[RankTest, ...]
    hand_made: SelectedEntry | None = None
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
