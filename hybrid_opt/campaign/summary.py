"""summary.json and recommendation.json as records: the figures of a campaign, and the carry to run
or why there is none. docs/results.md describes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from hybrid_opt.campaign.settings import CampaignSettings, Seconds, StoredCell
from hybrid_opt.evaluate.objectives import PLANNED_FORCE, ROBUST_FORCE, ForceKind
from hybrid_opt.indicators.metrics import BindingBound
from hybrid_opt.indicators.statistics import RankTest, Summary
from hybrid_opt.polishing.records import PolishEffort
from hybrid_opt.recommending.advice import Advice
from hybrid_opt.recommending.choice import Wish
from hybrid_opt.recommending.comparison import Rival
from hybrid_opt.recommending.recommendation import Recommendation
from hybrid_opt.robust.force import RobustPrice
from hybrid_opt.robust.squeeze import Part
from hybrid_opt.static_hold import StaticHold
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array, Count, Figure, Pair, Range, Row


@dataclass(frozen=True)
class StoredDurations:
    """How long paths take at the forces of a table [s], null where they cannot move.

    Attributes:
        label: whose they are.
        replicas: how many fronts stand behind the figures, 1 for a single path.
        median, least, largest: over the replicas, one per force.
    """

    label: str
    replicas: Count
    median: tuple[Figure, ...]
    least: tuple[Figure, ...]
    largest: tuple[Figure, ...]


@dataclass(frozen=True)
class ForceTable:
    """Durations at the same forces.

    Attributes:
        forces: limits on both forces [N].
        rows: hand-made path, optimum of the other experiment, then every algorithm's fronts.
    """

    forces: tuple[float, ...]
    rows: tuple[StoredDurations, ...]


@dataclass(frozen=True)
class StoredRecommendation:
    """The carry to run.

    Attributes:
        wish, why: what was asked for, as values and as words.
        source: whose it is, as 'NSGA-II, polished, replica 3'.
        file: its trajectory file, relative to the folder.
        export: the command that makes of it what robots need, run in the folder.
        duration: as robots drive it, limits on jerk kept [s].
        force: largest force to command of the force-controlled arm [N]; the one force.
        parts: what it is made of, its sum.
        job_duration: of the whole job [s], null where none can be planned.
        force_limit: of the search [N].
        peak_force: largest planned normal force of each robot [N].
        robust_force: likewise in every case of the workcell's uncertainty, where force limits are
            about these; else null.
        squeeze, squeeze_reason: largest normal force to command of each robot [N], and why.
        payload_limit: payload that the robots bear on the same motion, nothing uncertain [kg].
        rivals: other paths at the same force and in the same time, the hand-made one first.
        margins: how far the cell's description may be off at the commanded force.
        advice: what changes of the cell would change.
        warnings: what speaks against it.
        considered: carries that it was chosen from.
        durations: how long all fronts take at the same forces.
        price: of robustness, null where no set leaves friction and patches.
    """

    wish: Wish
    why: str
    source: str
    file: str
    export: str
    duration: float
    force: float
    parts: tuple[Part, ...]
    job_duration: Figure
    force_limit: float
    peak_force: Pair
    squeeze: Pair
    squeeze_reason: str
    payload_limit: float
    rivals: tuple[Rival, ...]
    margins: tuple[Margin, ...]
    advice: tuple[Advice, ...]
    warnings: tuple[str, ...]
    considered: Count
    durations: ForceTable
    price: RobustPrice | None = None
    robust_force: Pair | None = None

    @property
    def force_kind(self) -> ForceKind:
        """The forces that limits, of the table and of rivals too, are about."""
        return PLANNED_FORCE if self.robust_force is None else ROBUST_FORCE

    @property
    def limited_force(self) -> Array:
        """(2,) largest of them of each robot [N]."""
        return self.peak_force if self.robust_force is None else self.robust_force


@dataclass(frozen=True)
class NoRecommendation:
    """no-recommendation.json: why a study has no carry to run."""

    reason: str


def stored_recommendation(
    found: Recommendation,
    *,
    source: str,
    file: str,
    export: str,
    considered: int,
    durations: ForceTable,
    price: RobustPrice | None,
) -> StoredRecommendation:
    """A recommendation as a study stores it, with what else is said of it there."""
    return StoredRecommendation(
        wish=found.wish,
        why=str(found.wish),
        source=source,
        file=file,
        export=export,
        duration=found.duration,
        force=found.force,
        parts=found.squeeze.parts,
        job_duration=float("nan") if found.job is None else found.job.duration,
        force_limit=found.limit,
        peak_force=found.carry.peak_normal_force,
        squeeze=found.commanded,
        squeeze_reason=str(found.squeeze),
        payload_limit=found.carry.payload_limit,
        rivals=found.rivals,
        margins=found.margins,
        advice=found.advice,
        warnings=found.warnings,
        considered=considered,
        durations=durations,
        price=price,
        robust_force=found.limited_force if found.force_kind.robust else None,
    )


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
    settings: CampaignSettings
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
