"""The fastest timing of a path by either method, and the check of any timing against every limit,
recomputed from physical quantities alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.timing.model import CarryLimits, PathMotion, SpeedProfile, TimingModel
from hybrid_opt.timing.passes import limit_place, path_failure
from hybrid_opt.timing.records import (
    FRICTION_RATIO,
    PER_JOINT,
    PathTiming,
    Timing,
    TimingLimits,
    TimingStatus,
    Utilisation,
    Validation,
)
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.functions import TIMING_TOLERANCE

FRICTION_ROUNDING = 1e-6
"""Excess of the friction ratio that counts as rounding: least-effort forces are exactly on the
friction cones."""

RECOMPUTED_TOLERANCE = TIMING_TOLERANCE
"""Largest accepted excess of a recomputed limit, as a share of it."""

LEAST_SPEED_FACTOR = 0.98
"""A timing that needs a smaller factor on its speeds to satisfy its limits has not converged."""

FACTOR_TOLERANCE = 1e-4
"""Share of a limit that a factor on the speeds may leave unused."""


def time_path(
    model: TimingModel,
    x: Array,
    limits: TimingLimits | None = None,
    motion: PathMotion | None = None,
) -> Timing:
    """Compute the fastest timing from rest to rest within the workcell's limits and additional
    ones.

    A compiled backward and forward pass over the path computes it. Limits that this method does not
    support are left to `hybrid_opt.timing.topp_ra`, which is many times slower. The timing is
    checked on a finer grid, and slowed down uniformly if it exceeds a limit there.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector, or only its free waypoints (n_path,).
        limits: additional limits; None limits joint torques and pressure shifts.
        motion: geometry of the path; computed if None.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    begin, limits = time.perf_counter(), limits or TimingLimits()
    motion = model.path_motion(x) if motion is None else motion
    timing = path_error(model, motion) or _error_at_rest(model, motion, limits)
    if timing is None:
        solve = _run_passes if model.passes.supports(limits) else _run_programs
        found = solve(model, motion, limits)
        timing = found if isinstance(found, Timing) else _slow_down(model, motion, limits, found)
    return replace(timing, seconds=time.perf_counter() - begin, limits=limits)


def _error_at_rest(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> Timing | None:
    """Return the error of a path on which the box at rest exceeds a limit somewhere, else None.

    Without an error a timing exists: in a slow motion every quantity is close to its value at rest.

    Args:
        model: timing model of the workcell.
        motion: geometry of the path.
        limits: limits in addition to the workcell's.
    """
    timing = check_limits(model, model.still(motion), limits)
    used = most_used(timing.use)
    if used.ratio < 1.0 - 1e-6:
        return None
    reason = f"standing still already uses {100.0 * used.ratio:.1f} % of the limit: {used.place}"
    return replace(timing, status=TimingStatus.INFEASIBLE_AT_REST, reason=reason, carry=None)


def _run_passes(
    model: TimingModel, motion: PathMotion, limits: TimingLimits
) -> PathTiming | Timing:
    (found,) = model.passes.time(model.path_coefficients(motion), limits)
    return found if np.isfinite(found.duration) else _pass_error(found, model.intervals)


def _pass_error(found: PathTiming, intervals: int) -> Timing:
    place = found.place
    reason = f"no speed at this place lets the path be finished: {place}"
    if found.status is TimingStatus.SOLVER_FAILED:
        reason = (
            f"no speed at this place lets the path be finished: interval {place.sample} of "
            f"{intervals}, u = {place.parameter:.4f}"
        )
    return Timing(found.status, reason, place, None, iterations=found.sweeps)


def _run_programs(
    model: TimingModel, motion: PathMotion, limits: TimingLimits
) -> PathTiming | Timing:
    # Not imported at the top: TOPP-RA takes long to load.
    from hybrid_opt.timing.topp_ra import toppra_timing

    return toppra_timing(model, motion, limits)


def time_by_programs(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> Timing:
    """Compute the fastest timing of a path by the linear programs of TOPP-RA, checked on the finer
    grid.

    Args:
        model: timing model of the workcell.
        motion: geometry of a path that both arms follow and on which no limit is exceeded at rest.
        limits: limits in addition to the workcell's.
    """
    found = _run_programs(model, motion, limits)
    return found if isinstance(found, Timing) else _slow_down(model, motion, limits, found)


def validate_timing(model: TimingModel, timing: Timing) -> Validation:
    """Time the path of a timing again by TOPP-RA within the same limits, and compare the durations.

    Args:
        model: timing model of the workcell.
        timing: result of `time_path`.

    Raises:
        SettingsError: there is no timing.
    """
    if timing.carry is None:
        raise SettingsError(f"there is no timing to validate: {timing.reason}", code="no-timing")
    motion = model.path_motion(timing.carry.x)
    return Validation(timing.duration, time_by_programs(model, motion, timing.limits).duration)


def _slow_down(
    model: TimingModel, motion: PathMotion, limits: TimingLimits, found: PathTiming
) -> Timing:
    """Check a timing on a finer grid, and slow it down uniformly if it exceeds a limit there.

    Args:
        model: timing model of the workcell.
        motion: geometry of the path.
        limits: limits in addition to the workcell's.
        found: the timing to check, by the backward and forward pass or by TOPP-RA.
    """

    @cache
    def driven(factor: float) -> Timing:
        speeds = SpeedProfile.from_grid_speed(factor * found.grid_speed)
        return check_limits(model, speeds.carry(model, motion), limits)

    carry, factor = SpeedProfile.from_grid_speed(found.grid_speed).carry(model, motion), 1.0
    timing = check_limits(model, carry, limits)
    if most_used(timing.use).ratio > 1.0 + RECOMPUTED_TOLERANCE:
        factor = largest_speed_factor(lambda slower: most_used(driven(slower).use).ratio)
        timing = driven(factor)
    slowed = factor * found.slowed
    if factor < LEAST_SPEED_FACTOR or not found.ok:
        reason = (
            f"the limits hold, but only after slowing to {slowed:.3f} of the speed found in "
            f"{found.sweeps} iterations; the timing is not the fastest"
        )
        timing = replace(timing, status=TimingStatus.NOT_CONVERGED, reason=reason)
    speed = factor * found.grid_speed
    return replace(timing, grid_speed=speed, iterations=found.sweeps, slowed=slowed)


# --- the check of a timing ---


def path_error(model: TimingModel, motion: PathMotion) -> Timing | None:
    """Return the error of a path that has no timing at any speed, else None. On such a path nothing
    moves, or an arm does not reach a pose, leaves its joint range or is near a singularity.

    Args:
        model: timing model of the workcell.
        motion: geometry of the path.
    """
    arms = motion.lost, motion.limit_margin, motion.manipulability
    failure = path_failure(model.workcell, motion.pose, *arms)
    if failure is None:
        return None
    status, place, reason = failure
    return Timing(status, reason, place, None)


def check_limits(
    model: TimingModel,
    carry: Carry,
    limits: TimingLimits,
    ratios: Mapping[str, Array] | None = None,
) -> Timing:
    """Compute how far a carry uses every limit: the largest ratio of value to limit.

    Args:
        model: timing model of the workcell.
        carry: the carry.
        limits: limits in addition to the workcell's.
        ratios: result of `CarryLimits.ratios`; computed if None.

    Returns:
        Record of the carry with these ratios. Its status is always `OK`, even if a limit is
        exceeded.
    """
    ratios = model.carry_limits.ratios(carry, limits) if ratios is None else ratios
    use = dict[str, Utilisation]()
    for name, ratio in ratios.items():
        sample, column = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
        where = int(column), int(sample), float(carry.parameter[sample])
        place = limit_place(model.workcell, model.joint_names, name, *where)
        use[name] = Utilisation(float(ratio[sample, column]), place)
    place = most_used(use).place
    reason = f"{carry.duration:.3f} s; most used: {place}"
    return Timing(TimingStatus.OK, reason, place, carry, use, limits=limits)


def joint_use(carry: Carry) -> dict[str, Array]:
    """Compute the largest utilisation of every joint over a carry.

    Returns:
        Arrays (all joints,) by name of the joint limit. The entry `contact torque` is the part of
        the joint torque that exerts the contact wrench, relative to the limit of the whole torque.
    """
    limits = CarryLimits(carry.workcell)
    ratios = limits.ratios(carry, TimingLimits())
    use = {name: ratios[name].max(axis=0) for name in PER_JOINT}
    limit = limits.bounds["joint torque"]
    return use | {"contact torque": (np.abs(carry.contact_torque) / limit).max(axis=0)}


def largest_speed_factor(use: Callable[[float], float]) -> float:
    """Return the largest factor on all speeds, at most one, at which no limit is exceeded.

    Args:
        use: function from a factor to the largest utilisation of any limit.

    Returns:
        The factor; one if the full speed exceeds no limit by more than `RECOMPUTED_TOLERANCE`.
    """
    fast = use(1.0)
    if fast <= 1.0 + RECOMPUTED_TOLERANCE:
        return 1.0
    # What limits are about grows about as the square of the speeds does.
    low, high, slow, turn = 0.0, 1.0, 0.0, 0
    while slow < 1.0 - FACTOR_TOLERANCE and high - low > FACTOR_TOLERANCE / 2.0:
        turn += 1
        share = (1.0 - FACTOR_TOLERANCE / 2.0 - slow) / (fast - slow)
        factor = np.sqrt(low**2 + share * (high**2 - low**2))
        # Every third is halfway, in case the guesses come nearer from one side only.
        factor = float((low + high) / 2.0 if turn % 3 == 0 else factor)
        found = use(factor)
        if found > 1.0:
            high, fast = factor, found
        else:
            low, slow = factor, found
    return low


def most_used(use: dict[str, Utilisation]) -> Utilisation:
    """Return the limit with the largest ratio of value to limit.

    Friction counts only if it is exceeded: the least forces use all of it by construction.

    Args:
        use: largest utilisation by name of the limit.
    """
    candidates = [
        excess
        for name, excess in use.items()
        if name != FRICTION_RATIO or excess.ratio > 1.0 + FRICTION_ROUNDING
    ]
    return max(candidates, key=lambda excess: excess.ratio)


def drive_path(
    model: TimingModel,
    x: Array,
    grid_speed: Array,
    limits: TimingLimits,
    motion: PathMotion | None = None,
) -> Timing:
    """Check a given timing of a path against every limit.

    Args:
        model: timing model with as many intervals as the timing.
        limits: limits in addition to the workcell's.
        x: (n_var,) decision vector.
        grid_speed: (intervals + 1,) path speed u' at the grid points [1/s].
        motion: geometry of the path; computed if None.

    Returns:
        Timing with status `OK`; `EXCEEDED` with the limit and the place; or the error of the path.

    Raises:
        SettingsError: x does not fit the workcell, or the speeds do not fit the intervals.
    """
    grid_speed = np.asarray(grid_speed, dtype=float)
    moves = np.all(grid_speed[:-1] + grid_speed[1:] > 0.0) if grid_speed.ndim == 1 else False
    if grid_speed.shape != (model.intervals + 1,) or not moves:
        raise SettingsError(
            f"path speeds of shape {grid_speed.shape}; needs {model.intervals + 1} that never "
            "stand still over an interval",
            code="shape",
        )
    motion = model.path_motion(x) if motion is None else motion
    failure = path_error(model, motion)
    if failure is not None:
        return failure
    timing = check_limits(
        model, SpeedProfile.from_grid_speed(grid_speed).carry(model, motion), limits
    )
    timing, excess = replace(timing, grid_speed=grid_speed), most_used(timing.use)
    if excess.ratio <= 1.0 + RECOMPUTED_TOLERANCE:
        return timing
    reason = f"uses {100.0 * excess.ratio:.1f} % of the limit: {excess.place}"
    return replace(timing, status=TimingStatus.EXCEEDED, reason=reason)
