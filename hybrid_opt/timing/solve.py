"""The fastest timing of a path: one front for the methods that compute it."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache

import numpy as np

from hybrid_opt.timing.limits import (
    LEAST_SPEED_FACTOR,
    RECOMPUTED_TOLERANCE,
    SpeedProfile,
    check_limits,
    largest_speed_factor,
    most_used,
    path_error,
)
from hybrid_opt.timing.model import PathMotion, TimingModel
from hybrid_opt.timing.records import PathTiming, Timing, TimingLimits, TimingStatus
from symbolic.array import Array


def time_path(
    model: TimingModel,
    x: Array,
    limits: TimingLimits | None = None,
    motion: PathMotion | None = None,
) -> Timing:
    """Compute the fastest timing from rest to rest within the workcell's and the given limits.

    The compiled passes compute it; limits that they do not support take `topp_ra`, which is many
    times slower. The timing is recomputed on the finer grid, and slowed down uniformly where a
    limit is exceeded there.

    Args:
        x: (n_var,) decision vector, or its free waypoints (n_path,).
        limits: None for the joint torques and the contact patches.
        motion: the path's geometry, if known.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    begin, limits = time.perf_counter(), limits or TimingLimits()
    motion = model.path_motion(x) if motion is None else motion
    timing = path_error(model, motion) or _error_at_rest(model, motion, limits)
    if timing is None:
        compute = _time_by_passes if model.passes.supports(limits) else _time_by_programs
        timing = compute(model, motion, limits)
    return replace(timing, seconds=time.perf_counter() - begin, limits=limits)


def _error_at_rest(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> Timing | None:
    """Return an error if a limit is exceeded at rest, else None.

    Without one a timing exists: slow enough, every quantity is arbitrarily close to its value at
    rest.
    """
    timing = check_limits(model, model.still(motion), limits)
    used = most_used(timing.use)
    if used.ratio < 1.0 - 1e-6:
        return None
    reason = f"standing still already uses {100.0 * used.ratio:.1f} % of the limit: {used.place}"
    return replace(timing, status=TimingStatus.INFEASIBLE_AT_REST, reason=reason, carry=None)


def _time_by_passes(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> Timing:
    (found,) = model.passes.time(model.path_coefficients(motion), [limits])
    if not np.isfinite(found.duration):
        return _pass_error(found, model.intervals)

    carry, factor = SpeedProfile.from_grid_speed(found.grid_speed).carry(model, motion), 1.0
    timing = check_limits(model, carry, limits)
    if most_used(timing.use).ratio > 1.0 + RECOMPUTED_TOLERANCE:

        @cache
        def driven(factor: float) -> Timing:
            speeds = SpeedProfile.from_grid_speed(factor * found.grid_speed)
            return check_limits(model, speeds.carry(model, motion), limits)

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


def _pass_error(found: PathTiming, intervals: int) -> Timing:
    place = found.place
    reason = f"no speed at this place lets the path be finished: {place}"
    if found.status is TimingStatus.SOLVER_FAILED:
        reason = (
            f"no speed at this place lets the path be finished: interval {place.sample} of "
            f"{intervals}, u = {place.parameter:.4f}"
        )
    return Timing(found.status, reason, place, None, iterations=found.sweeps)


def _time_by_programs(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> Timing:
    # Not imported at the top: TOPP-RA takes long to load.
    from hybrid_opt.timing.topp_ra import toppra_timing

    return toppra_timing(model, motion, limits)
