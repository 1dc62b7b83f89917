"""All timings of one trajectory as one record: stored in `timing/*.json`, printed as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybrid_opt.store.json_records import read_record
from hybrid_opt.timing.analysis import ForceCurve, TimedTrajectory
from hybrid_opt.timing.limits import joint_use
from hybrid_opt.timing.records import Excess, JerkTiming, Timing, TimingStatus
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array, Count, Figure, Pair, Row


@dataclass(frozen=True)
class StoredTiming:
    """One `Timing`. What follows `use` is that of its carry, None without one.

    Attributes:
        status, reason, iterations, slowed, seconds: as there.
        duration: [s], NaN without a timing.
        use: by limit.
        objectives: (2,) largest normal forces over the reference forces.
        payload_limit: [kg].
        peak_normal_force, peak_resultant_force: (2,) [N].
        least_friction_margin: (2,) least share of the friction that is left.
        peak_pressure_shift: (2,) [m].
        peak_point_moment_residual, peak_moment_residual: [N m].
        joint_use: (n joints,) largest use of each joint by limit, both arms in order.
    """

    status: TimingStatus
    reason: str
    duration: Figure
    iterations: Count
    slowed: Figure
    seconds: Figure
    use: Mapping[str, Excess]
    objectives: Pair | None = None
    payload_limit: float | None = None
    peak_normal_force: Pair | None = None
    peak_resultant_force: Pair | None = None
    least_friction_margin: Pair | None = None
    peak_pressure_shift: Pair | None = None
    peak_point_moment_residual: float | None = None
    peak_moment_residual: float | None = None
    joint_use: Mapping[str, Row] | None = None


@dataclass(frozen=True)
class StoredJerk:
    """A carry's timing within limits on jerk, see `hybrid_opt.timing.records.JerkTiming`.

    Attributes:
        status: of its timing.
        duration: [s].
        without: the same without limits on jerk [s]; both NaN where there is no timing.
        joint_use, payload_use: largest jerks over their limits.
    """

    status: TimingStatus
    duration: Figure
    without: Figure
    joint_use: Figure
    payload_use: Figure

    @classmethod
    def of(cls, found: JerkTiming) -> StoredJerk:
        """The record of a timing as it is stored."""
        timing = found.timing
        return cls(timing.status, timing.duration, found.without, *found.jerk_use)


@dataclass(frozen=True)
class TimingDocument:
    """All that timing says of one trajectory, see `TimedTrajectory`.

    Attributes:
        nominal_duration: at the reference speeds without ramps [s].
        timings: by name, the search's first.
        margins: how wrong the cell's description may be.
        force_curve: duration against force limit, None where it was not asked for.
        jerk: what the cell's limits on jerk make of a drivable carry, None without.
    """

    nominal_duration: Figure
    timings: Mapping[str, StoredTiming]
    margins: tuple[Margin, ...]
    force_curve: ForceCurve | None
    jerk: StoredJerk | None = None


def timing_document(timed: TimedTrajectory) -> TimingDocument:
    """The record of a timed trajectory."""
    return TimingDocument(
        nominal_duration=timed.nominal_duration,
        timings={name: stored_timing(timing) for name, timing in timed.timings.items()},
        margins=timed.margins,
        force_curve=timed.curve,
        jerk=None if timed.jerk is None else StoredJerk.of(timed.jerk),
    )


def read_timing(path: Path) -> TimingDocument:
    """Read one file of `timing/` in a results folder.

    Raises:
        ResultsError: it is missing or damaged.
    """
    remedy = "delete stages/timing.json in its folder and continue the study with --resume"
    return read_record(TimingDocument, path, remedy)


def stored_timing(timing: Timing) -> StoredTiming:
    """One timing as it is stored."""
    known = StoredTiming(
        status=timing.status,
        reason=timing.reason,
        duration=timing.duration,
        iterations=timing.iterations,
        slowed=timing.slowed,
        seconds=timing.seconds,
        use=timing.use,
    )
    carry = timing.carry
    if carry is None:
        return known
    return replace(
        known,
        objectives=carry.force_ratio,
        payload_limit=carry.payload_limit,
        peak_normal_force=carry.peak_normal_force,
        peak_resultant_force=carry.peak_resultant_force,
        least_friction_margin=carry.friction_margin.min(axis=0),
        peak_pressure_shift=carry.peak_pressure_shift,
        peak_point_moment_residual=_largest(carry.point_moment_residual),
        peak_moment_residual=_largest(carry.moment_residual),
        joint_use=joint_use(carry, carry.workcell),
    )


def _largest(vectors: Array) -> float:
    """Largest length of vectors (n, 3)."""
    return float(np.linalg.norm(vectors, axis=1).max())
