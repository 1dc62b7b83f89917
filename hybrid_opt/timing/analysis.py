"""Questions about a trajectory's timing, one function each: the search's timing, drivable ones, the
margins; and all of them at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.timing.given import drive_path, path_failure
from hybrid_opt.timing.jerk import drive_with_jerk
from hybrid_opt.timing.limits import (
    RECOMPUTED_TOLERANCE,
    duration_at_speed_limits,
    joint_at,
    joint_use,
    limit_use,
    limited_force,
    worst,
)
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import JerkTiming, Place, Timing, TimingLimits, TimingStatus
from hybrid_opt.timing.robustness import Margin, robustness_margins
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array, Figure, Missing, Row, Shape
from symbolic.errors import SettingsError
from symbolic.records import Workcell

NEAREST_FORCE = 1.001
"""Least force limit of the curve, over the force at rest: below, the motion has to creep."""


REST_SPEED = 1e-3
"""Joint speed over its limit below which an arm counts as standing still."""


@dataclass(frozen=True)
class JudgedTiming:
    """A given timing held against the limits.

    Attributes:
        timing: status `OK` or `EXCEEDED` (also for a carry that starts or ends at speed), or why
            the path itself fails; with every limit's use.
        joint_use: (all joints,) worst use of each joint by constraint, both arms in order.
        start_speed, end_speed: (all joints,) that the timing asks for at its ends, where a
            robot stands still [rad/s].
    """

    timing: Timing
    joint_use: dict[str, Array]
    start_speed: Array
    end_speed: Array


@dataclass(frozen=True)
class ForceCurve:
    """Duration of the fastest timing against the limit on the normal forces, on robust ones where
    the model limits these.

    Attributes:
        force: (n,) limits [N].
        duration: (n,) [s], infinite where there is no timing.
        status: outcome per limit.
        static_force: largest limited force standing still anywhere on the path [N].
        unlimited_force: largest limited force of the fastest timing without force limit [N].
    """

    force: Row
    duration: Annotated[Array, Shape((None,)), Missing()]
    status: tuple[TimingStatus, ...]
    static_force: float
    unlimited_force: Figure


def judge_timing(model: TimingModel, x: Array) -> JudgedTiming:
    """The search's own timing (the task's time law) held against every limit of the workcell.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    carry = model.search_carry(x)
    failure = path_failure(model, model.path_motion(x))
    use = limit_use(carry, model.workcell, TimingLimits(), model.joint_names)
    excess = worst(use)
    status, place = TimingStatus.OK, excess.place
    reason = f"within all limits; most used: {place}"
    jump = _jump(model, carry)
    if excess.ratio > 1.0 + RECOMPUTED_TOLERANCE:
        status = TimingStatus.EXCEEDED
        reason = f"uses {100.0 * excess.ratio:.0f} % of the limit: {place}"
    elif jump is not None:
        status, place = TimingStatus.EXCEEDED, jump
        reason = f"the robots would have to be at speed without accelerating: {place}"
    timing = Timing(status, reason, place, carry, use)
    if failure is not None:
        timing = replace(failure, carry=carry, use=use)
    q_rate = carry.side_by_side("q_rate")
    return JudgedTiming(timing, joint_use(carry, model.workcell), q_rate[0], q_rate[-1])


def _jump(model: TimingModel, carry: Carry) -> Place | None:
    """The joint that moves fastest, for its limit, at the carry's ends; None where all rest."""
    limit = np.concatenate([robot.velocity_max for robot in model.workcell.robots])
    ends = np.abs(carry.side_by_side("q_rate")[[0, -1]]) / limit
    if float(ends.max()) < REST_SPEED:
        return None
    end, joint = np.unravel_index(int(np.argmax(ends)), ends.shape)
    arm, index = joint_at(model.joint_names, int(joint))
    sample = 0 if end == 0 else len(carry.time) - 1
    return Place(
        "start from rest" if end == 0 else "stop at rest",
        model.workcell.robots[arm].name,
        model.joint_names[arm][index],
        sample,
        float(carry.parameter[sample]),
    )


def fastest_timing(model: TimingModel, x: Array) -> Timing:
    """The fastest timing from rest to rest within the robots' and the payload's limits."""
    return time_path(model, x, TimingLimits())


def drivable_timing(model: TimingModel, x: Array) -> Timing:
    """A drivable carry x (n_var,) timed within its own force limit: as the search found it, where
    that holds between its grid points, too; else by `time_path`, which takes many times as long.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    found, limits = model.search_timing(x), model.drive_limits(float(x[-1]))
    pieces = model.intervals / max(len(found.grid_speed) - 1, 1)
    if found.ok and pieces.is_integer():
        # Within an interval u'^2 is linear, so that its pieces are driven as it is.
        ends = np.arange(len(found.grid_speed))
        squared = np.interp(np.arange(model.intervals + 1) / pieces, ends, found.grid_speed**2)
        driven = drive_path(model, x, np.sqrt(squared), limits)
        if driven.ok:
            return driven
    return time_path(model, x, limits)


def closest_to_reference_timing(model: TimingModel, x: Array) -> Timing:
    """The timing from rest to rest that keeps to the reference speeds as far as limits allow.

    It is the fastest of those that never exceed the task's reference speeds, so that the box moves
    at a reference speed wherever no limit forbids it.
    """
    return time_path(model, x, TimingLimits(reference_speed=True))


def force_limited_timing(model: TimingModel, x: Array, force: float) -> Timing:
    """The fastest timing whose normal forces, robust ones where the model limits these, stay below
    a limit while friction holds.

    Args:
        force: largest normal force of each robot [N].

    Raises:
        SettingsError: the limit is not a positive force.
    """
    return time_path(model, x, model.drive_limits(force))


def duration_against_force_limit(model: TimingModel, x: Array, points: int = 12) -> ForceCurve:
    """Durations of the fastest timings between the least force that holds and the unlimited one.

    The limits are spaced evenly in the logarithm of what they leave above the force at rest.

    Raises:
        SettingsError: fewer than two points.
    """
    if points < 2:
        raise SettingsError(f"{points} points of the force curve; give at least 2")
    motion = model.path_motion(x)
    still = np.zeros(len(motion.parameter))
    static = _peak_force(model, model.carry(motion, still, still, still))
    free = time_path(model, x, TimingLimits(), motion)
    if free.carry is None:
        return ForceCurve(np.zeros(0), np.zeros(0), (free.status,), static, float("nan"))
    top = _peak_force(model, free.carry)
    first = (NEAREST_FORCE - 1.0) * static
    force = static + np.geomspace(first, max(top - static, 2.0 * first), points)
    timings = [time_path(model, x, model.drive_limits(float(limit)), motion) for limit in force]
    return ForceCurve(
        force,
        np.array([timing.duration for timing in timings]),
        tuple(timing.status for timing in timings),
        static,
        top,
    )


def _peak_force(model: TimingModel, carry: Carry) -> float:
    """The largest of the forces that the model limits [N]."""
    return float(limited_force(carry, model.workcell, model.drive_limits(1.0)).max())


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
