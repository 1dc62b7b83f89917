"""recommendation.json as records: the carry to run, as a study stores it, or why there is none."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_opt.campaign.documents import Count, Pair
from hybrid_opt.evaluate.objectives import PLANNED_FORCE, ROBUST_FORCE, ForceKind
from hybrid_opt.recommending.advice import Advice
from hybrid_opt.recommending.recommendation import Recommendation
from hybrid_opt.robust.force import RobustPrice
from hybrid_opt.robust.squeeze import Part
from hybrid_opt.store.json_records import Figure
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array


@dataclass(frozen=True)
class StoredWish:
    """The wish: at most one of duration [s], force [N] and payload [kg]."""

    duration: float | None
    force: float | None
    payload: float | None


@dataclass(frozen=True)
class StoredRival:
    """Another path beside the recommended carry, driven as fast as the same limits allow.

    Attributes:
        label: what it is.
        duration_at_force: [s] with the same force commanded, null where it cannot.
        force_at_duration: to command in the same time [N], null where it cannot.
    """

    label: str
    duration_at_force: Figure
    force_at_duration: Figure


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
class StoredPrice:
    """Cost for the recommended carry to hold in every case of a set.

    Attributes:
        stated: whether the workcell states the set; else it is the usual one.
        uncertainty: the set in words.
        factors: multiples of it.
        peak: largest normal force of each robot under them [N].
        commanded: under the set itself [N].
        limit: reference forces [N].
        largest_factor: the largest multiple that they allow, at most
            `hybrid_opt.robust.force.LARGEST_FACTOR`.
        cases, failing: random cases held against the forces, and how many they did not hold.
        closest: largest share of the forces that a case needed; less is told as 0.97.
    """

    stated: bool
    uncertainty: str
    factors: tuple[float, ...]
    peak: tuple[Pair, ...]
    commanded: Pair
    limit: Pair
    largest_factor: float
    cases: Count
    failing: Count
    closest: float


def stored_price(price: RobustPrice) -> StoredPrice:
    """A price as a study stores it."""
    return StoredPrice(
        stated=price.uncertainty.stated,
        uncertainty=str(price.uncertainty),
        factors=tuple(price.factors.tolist()),
        peak=tuple(price.peak),
        commanded=price.commanded,
        limit=price.limit,
        largest_factor=price.largest_factor,
        cases=price.check.cases,
        failing=price.check.failing,
        closest=price.check.closest,
    )


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

    wish: StoredWish
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
    rivals: tuple[StoredRival, ...]
    margins: tuple[Margin, ...]
    advice: tuple[Advice, ...]
    warnings: tuple[str, ...]
    considered: Count
    durations: ForceTable
    price: StoredPrice | None = None
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


@dataclass(frozen=True)
class Told:
    """Further statements about a recommendation: the attributes of those names there."""

    source: str
    file: str
    export: str
    considered: int
    durations: ForceTable
    price: StoredPrice | None


def stored_recommendation(found: Recommendation, told: Told) -> StoredRecommendation:
    """A recommendation as a study stores it."""
    return StoredRecommendation(
        **vars(told),
        wish=StoredWish(**vars(found.wish)),
        why=str(found.wish),
        duration=found.duration,
        force=found.force,
        parts=found.squeeze.parts,
        job_duration=float("nan") if found.job is None else found.job.duration,
        force_limit=found.limit,
        peak_force=found.carry.peak_normal_force,
        squeeze=found.commanded,
        squeeze_reason=str(found.squeeze),
        payload_limit=found.carry.payload_limit,
        rivals=tuple(
            StoredRival(rival.label, rival.duration_at_force, rival.force_at_duration)
            for rival in found.rivals
        ),
        margins=found.margins,
        advice=found.advice,
        warnings=found.warnings,
        robust_force=found.limited_force if found.force_kind.robust else None,
    )
