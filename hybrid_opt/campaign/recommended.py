"""recommendation.json as records: the carry to run, as a study stores it, or why there is none."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_opt.evaluate.objectives import PLANNED_FORCE, ROBUST_FORCE, ForceKind
from hybrid_opt.recommending.advice import Advice
from hybrid_opt.recommending.choice import Wish
from hybrid_opt.recommending.comparison import Rival
from hybrid_opt.recommending.recommendation import Recommendation
from hybrid_opt.robust.force import RobustPrice
from hybrid_opt.robust.squeeze import Part
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array, Count, Figure, Pair


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
