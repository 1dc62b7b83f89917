"""Timings of a trajectory: the search's, drivable ones, margins; and all of them as the record that
`timing/*.json` stores."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.progress import ShowProgress, progress_bar
from hybrid_opt.store.files import read_record
from hybrid_opt.timing.candidates import search_carry, search_timing
from hybrid_opt.timing.jerk import applicable_jerk_limits, time_with_jerk
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.passes import limit_place
from hybrid_opt.timing.programs import duration_at_speed_limits
from hybrid_opt.timing.records import (
    JerkTiming,
    Place,
    Timing,
    TimingLimits,
    TimingStatus,
    Utilisation,
    Validation,
)
from hybrid_opt.timing.robustness import Margin, robustness_margins
from hybrid_opt.timing.solve import (
    RECOMPUTED_TOLERANCE,
    check_limits,
    drive_path,
    joint_use,
    most_used,
    path_error,
    time_path,
    validate_timing,
)
from symbolic.array import AllowMissing, Array, Count, Figure, Pair, Row, Shape
from symbolic.errors import SettingsError
from symbolic.path.spline import resample_decisions
from symbolic.records import Workcell

LEAST_FORCE_RATIO = 1.001
"""Smallest force limit of the curve, as a multiple of the force at rest. Below it the box would
have to creep."""


REST_SPEED = 1e-3
"""An arm counts as at rest if every joint is slower than this share of its speed limit."""


@dataclass(frozen=True)
class ForceCurve:
    """Durations of the fastest timings of one path under several limits on the normal forces.

    If the timing model is robust, the limits bound robust forces, else planned forces.

    Attributes:
        force: (n,) force limits [N].
        duration: (n,) duration of the fastest timing within each force limit [s]; infinite if there
            is no timing.
        status: outcome of each timing.
        static_force: largest normal force at rest anywhere on the path [N].
        unlimited_force: largest normal force of the fastest timing without force limit [N]; NaN if
            the path has no timing.
    """

    force: Row
    duration: Annotated[Array, Shape((None,)), AllowMissing()]
    status: tuple[TimingStatus, ...]
    static_force: float
    unlimited_force: Figure


def check_search_timing(model: TimingModel, x: Array) -> Timing:
    """Check a decision vector, with the timing under which searches evaluate it, against all limits
    of the workcell.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector.

    Returns:
        Timing with the utilisation of every limit. Its status is `OK`; or `EXCEEDED` if a limit is
        exceeded or the carry does not start and end at rest; or the status of the error if the path
        has no timing at all.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    carry = search_carry(model, x)
    failure = path_error(model, model.path_motion(x))
    timing = check_limits(model, carry, TimingLimits())
    if failure is not None:
        return replace(failure, carry=carry, use=timing.use)
    excess, jump = most_used(timing.use), _jump(model, carry)
    if excess.ratio > 1.0 + RECOMPUTED_TOLERANCE:
        reason = f"uses {100.0 * excess.ratio:.0f} % of the limit: {excess.place}"
        return replace(timing, status=TimingStatus.EXCEEDED, reason=reason)
    if jump is not None:
        reason = f"the robots would have to be at speed without accelerating: {jump}"
        return replace(timing, status=TimingStatus.EXCEEDED, reason=reason, place=jump)
    return replace(timing, reason=f"within all limits; most used: {excess.place}")


def _jump(model: TimingModel, carry: Carry) -> Place | None:
    """Find the joint that moves at the start or the end of a carry, so that its speed would have to
    jump there. Of several joints it is the one with the largest speed relative to its limit.

    Args:
        model: timing model of the workcell.
        carry: the carry.

    Returns:
        The joint and the end of the carry; None if all joints start and end at rest.
    """
    limit = model.workcell.stack_joint_limits("velocity_max")
    ends = np.abs(carry.stack_arms("q_rate")[[0, -1]]) / limit
    if float(ends.max()) < REST_SPEED:
        return None
    end, joint = np.unravel_index(int(np.argmax(ends)), ends.shape)
    sample = 0 if end == 0 else len(carry.time) - 1
    where = int(joint), sample, float(carry.parameter[sample])
    place = limit_place(model.workcell, model.joint_names, "joint velocity", *where)
    return replace(place, constraint="start from rest" if end == 0 else "stop at rest")


def drivable_timing(model: TimingModel, x: Array) -> Timing:
    """Compute the fastest timing of a path within the force limit, which is the last entry of its
    decision vector.

    A search computes such a timing too, but checks the limits at its grid points only. That timing
    is returned if it satisfies the limits on this model's finer grid as well; otherwise `time_path`
    computes a new one.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    found, limits = search_timing(model, x), model.drive_limits(float(x[-1]))
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
    """Compute the fastest timing from rest to rest in which the box never exceeds the task's
    reference speeds, linear and angular.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector.
    """
    return time_path(model, x, TimingLimits(reference_speed=True))


def duration_against_force_limit(
    model: TimingModel, x: Array, points: int = 12, on_timing: Callable[[], None] = lambda: None
) -> ForceCurve:
    """Compute the fastest timing of one path under each of several limits on the normal forces.

    The limits lie between the force at rest and the largest force of the timing without force
    limit. Their excess over the force at rest grows geometrically.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector.
        points: number of force limits.
        on_timing: called after every timing.

    Returns:
        Durations by force limit; no points if the path has no timing without force limit either.

    Raises:
        SettingsError: fewer than two points, or x does not fit the workcell.
    """
    if points < 2:
        raise SettingsError(f"{points} points of the force curve; give at least 2", code="too-few")
    motion = model.path_motion(x)
    still = np.zeros(len(motion.parameter))
    static = _peak_force(model, model.carry(motion, still, still, still))
    free = time_path(model, x, motion=motion)
    if free.carry is None:
        return ForceCurve(np.zeros(0), np.zeros(0), (free.status,), static, float("nan"))
    top = _peak_force(model, free.carry)
    first = (LEAST_FORCE_RATIO - 1.0) * static
    force = static + np.geomspace(first, max(top - static, 2.0 * first), points)
    timings = []
    for limit in force:
        timings.append(time_path(model, x, model.drive_limits(float(limit)), motion))
        on_timing()
    return ForceCurve(
        force,
        np.array([timing.duration for timing in timings]),
        tuple(timing.status for timing in timings),
        static,
        top,
    )


def _peak_force(model: TimingModel, carry: Carry) -> float:
    """Return the largest normal force of a carry [N]: the robust force if the model is robust, else
    the planned one.

    Args:
        model: timing model of the workcell.
        carry: the carry.
    """
    return float(model.carry_limits.limited_force(carry, model.drive_limits(1.0)).max())


@dataclass(frozen=True)
class TimedTrajectory:
    """One trajectory under the search's timing and under drivable timings.

    Attributes:
        workcell: the workcell.
        nominal_duration: duration of a motion at the reference speeds without ramps [s].
        timings: timing by name. The first is the search's own (`check_search_timing`), the others
            are drivable.
        jerk: timing of a drivable carry within its force limit and the workcell's jerk limits; None
            if the time law is not drivable or the workcell has no jerk limits.
        margins: largest errors of the workcell's description that the timing closest to the
            reference speeds tolerates; empty if there is no such timing.
        curve: duration against force limit; None if not computed.
        validations: comparison with TOPP-RA, by name of the timing.
    """

    workcell: Workcell
    nominal_duration: float
    timings: dict[str, Timing]
    jerk: JerkTiming | None
    margins: tuple[Margin, ...]
    curve: ForceCurve | None
    validations: Mapping[str, Validation]


def time_trajectory(
    model: TimingModel,
    x: Array,
    force_limit: float | None = None,
    curve_points: int | None = None,
    own: TimingModel | None = None,
    progress: ShowProgress = False,
) -> TimedTrajectory:
    """Compute the timings of one trajectory that a report compares.

    They are, by name in the result: 'search', the timing under which the search found x; 'closest
    to reference', the fastest one within the task's reference speeds; 'fastest', without these
    speeds and without force limit; with `force_limit` also 'force limited'. A drivable carry in a
    workcell with jerk limits also has 'within jerk limits'.

    Args:
        model: timing model of the workcell, usually with the drivable time law.
        x: (n_var,) decision vector.
        force_limit: upper bound of the normal forces [N] for the timing 'force limited'; None
            leaves this timing out.
        curve_points: number of points of the curve of duration against force limit; None for no
            curve.
        own: timing model of the workcell in which the search found x, if that has another time law;
            None if it is `model`.
        progress: True for a progress bar, False for none; or a function that is called with the
            number of finished and of all steps. Each timing is a step, and so are the validation by
            TOPP-RA and the robustness margins.

    Raises:
        SettingsError: x does not fit the workcell, or the limit is not a positive force.
    """
    task, found_in = model.workcell.task, own or model
    jerk, kept, limits = None, None, TimingLimits()
    (path,) = resample_decisions(x, found_in.workcell.task, task)
    if len(path) == task.n_var > task.n_path:
        limits = model.drive_limits(float(path[-1]))
        kept = applicable_jerk_limits(model.workcell, limits)
    ways = 5 + (force_limit is not None) + (kept is not None) + (curve_points or 0)
    with progress_bar(progress, "timings", ways) as advance:

        def on_timing() -> None:
            advance(1)

        timings = {"search": check_search_timing(found_in, x)}
        on_timing()
        closest = timings["closest to reference"] = closest_to_reference_timing(model, path)
        on_timing()
        timings["fastest"] = time_path(model, path)
        on_timing()
        if force_limit is not None:
            timings["force limited"] = time_path(model, path, model.drive_limits(force_limit))
            on_timing()
        validations = {
            name: validate_timing(model, timing)
            for name, timing in timings.items()
            if name != "search" and timing.ok
        }
        on_timing()
        if kept is not None:
            jerk = time_with_jerk(model, path, limits, kept)
            timings["within jerk limits"] = jerk.timing
            on_timing()
        nominal = TimingLimits(reference_speed=True)
        nominal_duration = duration_at_speed_limits(model, model.path_motion(path), nominal)
        margins = () if closest.carry is None else robustness_margins(model, closest.carry)
        on_timing()
        curve = None
        if curve_points is not None:
            curve = duration_against_force_limit(model, path, curve_points, on_timing)
    return TimedTrajectory(
        model.workcell, nominal_duration, timings, jerk, margins, curve, validations
    )


@dataclass(frozen=True)
class StoredTiming:
    """One stored `Timing`. The fields after `use` describe its carry and are None if there is no
    carry.

    Pairs have one value per robot.

    Attributes:
        status, reason, iterations, slowed, seconds: the fields of `Timing` of these names.
        duration: [s], NaN if there is no timing.
        use: largest utilisation and its place, by name of the limit.
        objectives: (2,) largest normal forces over the reference forces.
        payload_limit: largest payload mass [kg] at the same timing.
        peak_normal_force, peak_resultant_force: (2,) largest normal and largest total contact force
            [N].
        least_friction_margin: (2,) least unused share of the friction.
        peak_pressure_shift: (2,) largest shift of the centre of pressure [m].
        peak_point_moment_residual, peak_moment_residual: largest moment [N m] that the contact
            forces leave unbalanced if they act at the nominal contact points, and at the shifted
            centres of pressure.
        joint_use: (all joints,) largest utilisation of each joint, by name of the limit.
    """

    status: TimingStatus
    reason: str
    duration: Figure
    iterations: Count
    slowed: Figure
    seconds: Figure
    use: Mapping[str, Utilisation]
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
    """A stored timing within jerk limits: the record of a `JerkTiming`.

    Attributes:
        status: outcome of the timing.
        duration: [s], NaN if there is no timing.
        without: duration of the fastest timing without jerk limits [s], NaN if there is none.
        joint_use, payload_use: largest joint jerk and largest payload jerk, each over its limit.
    """

    status: TimingStatus
    duration: Figure
    without: Figure
    joint_use: Figure
    payload_use: Figure


@dataclass(frozen=True)
class TimingDocument:
    """All timings of one trajectory in stored form: the record of a `TimedTrajectory`.

    Attributes:
        nominal_duration: duration of a motion at the reference speeds without ramps [s].
        timings: timings by name, the search's first.
        margins: largest errors of the workcell's description that the carry tolerates.
        force_curve: duration against force limit; None if not computed.
        jerk: timing of a drivable carry within the workcell's jerk limits; None if there are none.
        validations: comparison with TOPP-RA, by name of the timing.
    """

    nominal_duration: Figure
    timings: Mapping[str, StoredTiming]
    margins: tuple[Margin, ...]
    force_curve: ForceCurve | None
    jerk: StoredJerk | None = None
    validations: Mapping[str, Validation] = field(default_factory=dict)


def timing_document(timed: TimedTrajectory) -> TimingDocument:
    """Convert a timed trajectory to the record that is stored."""
    jerk = timed.jerk
    timings = {name: stored_timing(timing) for name, timing in timed.timings.items()}
    found = TimingDocument(
        timed.nominal_duration,
        timings,
        timed.margins,
        timed.curve,
        validations=timed.validations,
    )
    if jerk is None:
        return found
    kept = StoredJerk(jerk.timing.status, jerk.timing.duration, jerk.without, *jerk.jerk_use)
    return replace(found, jerk=kept)


def read_timing(path: Path) -> TimingDocument:
    """Read one file of `timing/` in a results folder.

    Args:
        path: path of the file.

    Raises:
        ResultsError: the file is missing or damaged.
    """
    remedy = "delete stages/timing.json in its folder and continue the study with --resume"
    return read_record(TimingDocument, path, remedy)


def stored_timing(timing: Timing) -> StoredTiming:
    """Convert a timing to the record that is stored."""
    same = ("status", "reason", "duration", "iterations", "slowed", "seconds", "use")
    known = StoredTiming(*(getattr(timing, name) for name in same))
    carry = timing.carry
    if carry is None:
        return known
    points, moments = (
        float(np.linalg.norm(missing, axis=1).max())
        for missing in (carry.point_moment_residual, carry.moment_residual)
    )
    return replace(
        known,
        objectives=carry.force_ratio,
        payload_limit=carry.payload_limit,
        peak_normal_force=carry.peak_normal_force,
        peak_resultant_force=carry.peak_resultant_force,
        least_friction_margin=carry.friction_margin.min(axis=0),
        peak_pressure_shift=carry.peak_pressure_shift,
        peak_point_moment_residual=points,
        peak_moment_residual=moments,
        joint_use=joint_use(carry),
    )
