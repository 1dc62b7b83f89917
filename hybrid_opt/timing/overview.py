"""A trajectory timed in every way: the search's timing, the drivable ones, and the margins."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_opt.timing.analysis import (
    ForceCurve,
    JudgedTiming,
    closest_to_reference_timing,
    duration_against_force_limit,
    fastest_timing,
    force_limited_timing,
    judge_timing,
)
from hybrid_opt.timing.jerk import drive_with_jerk
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.point_limits import duration_at_speed_limits
from hybrid_opt.timing.records import JerkTiming, Timing, TimingLimits
from hybrid_opt.timing.robustness import Margin, robustness_margins
from symbolic.array import Array
from symbolic.records import Workcell


@dataclass(frozen=True)
class TimingReport:
    """A trajectory under the search's timing and under timings that robots can drive.

    Attributes:
        judged: the search's own timing.
        nominal_duration: at the reference speeds without ramps [s].
        fastest, closest: see the functions of those names.
        force_limited: with the given limit, None without one.
        jerk: of a drivable carry within its force limit and the cell's limits on jerk; None under
            other time laws, and without such limits.
    """

    judged: JudgedTiming
    nominal_duration: float
    fastest: Timing
    closest: Timing
    force_limited: Timing | None
    jerk: JerkTiming | None = None

    @property
    def timings(self) -> dict[str, Timing]:
        """The timings by name, the search's first."""
        named = {
            "search": self.judged.timing,
            "closest to reference": self.closest,
            "fastest": self.fastest,
        }
        if self.force_limited is not None:
            named["force limited"] = self.force_limited
        if self.jerk is not None:
            named["within jerk limits"] = self.jerk.timing
        return named


def report_timing(
    model: TimingModel, x: Array, force: float | None = None, own: TimingModel | None = None
) -> TimingReport:
    """All timings of a trajectory beside one another.

    Args:
        model: of the cell that robots drive.
        x: (n_var,) decision vector.
        force: limit on the normal forces for the force-limited timing [N].
        own: of the cell that x was found in, None for the same.

    Raises:
        SettingsError: x does not fit the workcell, or the limit is not a positive force.
    """
    driven = model.workcell.task
    return TimingReport(
        judged=judge_timing(own or model, x),
        nominal_duration=duration_at_speed_limits(
            model, model.path_motion(x), TimingLimits(reference_speed=True)
        ),
        fastest=fastest_timing(model, x),
        closest=closest_to_reference_timing(model, x),
        force_limited=None if force is None else force_limited_timing(model, x, force),
        jerk=drive_with_jerk(model, x) if len(x) == driven.n_var > driven.n_path else None,
    )


@dataclass(frozen=True)
class TimedTrajectory:
    """All that timing says of one trajectory.

    Attributes:
        report: the search's timing and the drivable ones.
        margins: how wrong the cell's description may be under the timing closest to the reference
            speeds; empty without that timing.
        curve: duration against force limit, None where it was not asked for.
        workcell: the cell.
    """

    report: TimingReport
    margins: tuple[Margin, ...]
    curve: ForceCurve | None
    workcell: Workcell


def timed_trajectory(
    model: TimingModel,
    x: Array,
    force_limit: float | None = None,
    curve_points: int | None = None,
    own: TimingModel | None = None,
) -> TimedTrajectory:
    """Time one decision vector (n_var,) in every way.

    Args:
        model, own: as for `report_timing`.
        force_limit: normal force [N] of a force-limited timing, None for no such timing.
        curve_points: points of the curve of duration against force limit, None for no curve.

    Raises:
        SettingsError: x does not fit the workcell, or the limit is not a positive force.
    """
    report = report_timing(model, x, force_limit, own)
    closest = report.closest.carry
    return TimedTrajectory(
        report,
        () if closest is None else robustness_margins(model, closest),
        None if curve_points is None else duration_against_force_limit(model, x, curve_points),
        model.workcell,
    )
