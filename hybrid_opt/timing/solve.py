"""Time-optimal timing of a carry by a sequence of linear problems. docs/timing.md explains it.

Limits that are convex in (u'', u'^2) enter as supporting lines, added where the last timing
exceeds them: the sequence approaches the exact limit from outside (Kelley's cutting planes).
Joint torques and pressure shifts depend on the least-effort forces in a way that is not convex;
they are linearised about the last timing and solved again until recomputed values hold.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from hybrid_opt.timing import rows as rows_of
from hybrid_opt.timing.adapter import SolverFailure, fastest_speed
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.path_check import path_failure
from hybrid_opt.timing.path_motion import PathMotion
from hybrid_opt.timing.point_limits import POINT_TOLERANCE, PointLimits
from hybrid_opt.timing.records import Place, Timing, TimingLimits, TimingStatus
from hybrid_opt.timing.refined import refined_carry
from hybrid_opt.timing.rows import INTERVAL_ENDS, PointRows
from hybrid_opt.timing.use import (
    RECOMPUTED_TOLERANCE,
    limit_ratios,
    limit_use,
    worst,
)
from symbolic.array import Array

MAX_ITERATIONS = 25
SETTLED = 2e-4
"""Relative change of duration below which linearised limits count as settled."""

NEAR = 0.6
"""Torques and shifts that stay below this share of their limit get no rows."""

LEAST_SPEED = 0.98
"""A timing that needs more slowing than this to hold its limits has not converged."""


@dataclass
class _State:
    """State of the iteration between one linear problem and the next.

    Attributes:
        cuts: supporting lines of convex limits.
        tightened: (intervals,) divisor of an interval's bounds, above one where a limit is exceeded
            between the points at which it is imposed.
        near: which of the limits that are not convex came near their bound so far.
        linearised: their rows, about the last timing.
        duration: of the last timing, in the scaled coordinate.
    """

    cuts: list[PointRows]
    tightened: Array
    near: NDArray[np.bool_]
    linearised: PointRows | None = None
    duration: float = float("inf")


def time_path(
    model: TimingModel, x: Array, limits: TimingLimits, motion: PathMotion | None = None
) -> Timing:
    """The fastest timing from rest to rest within the workcell's and the given limits.

    Args:
        x: (n_var,) decision vector, or its free waypoints (n_path,).
        motion: the path's geometry, where it is known already.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    begin = time.perf_counter()
    motion = model.path_motion(x) if motion is None else motion
    timing = path_failure(model, motion) or _failure_at_rest(model, motion, limits)
    timing = timing or _Problem(model, motion, limits).solve()
    seconds = time.perf_counter() - begin
    return replace(timing, seconds=seconds, limits=limits)


def _failure_at_rest(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> Timing | None:
    """A limit that is exceeded even standing still: then the path is not to be driven.

    Where none is exceeded a timing exists: slow enough, every quantity is as close to its value at
    rest as wanted.
    """
    use = limit_use(model.still(motion), model.workcell, limits, model.joint_names)
    excess = worst(use)
    if excess.ratio < 1.0 - 1e-6:
        return None
    return Timing(
        TimingStatus.INFEASIBLE_AT_REST,
        f"standing still already uses {100.0 * excess.ratio:.1f} % of the limit: {excess.place}",
        excess.place,
        None,
        use,
    )


class _Problem:
    """One path with one set of limits."""

    def __init__(self, model: TimingModel, motion: PathMotion, limits: TimingLimits) -> None:
        self._model = model
        self._motion = motion
        self._limits = limits
        self._at = PointLimits(model, motion, limits)

    def solve(self) -> Timing:
        """Solve linear problems until recomputed limits hold and nothing changes any more."""
        intervals = self._model.intervals
        state = _State(
            [self._at.first_cuts()],
            np.ones(intervals),
            np.zeros(self._at.rest.shape[1], dtype=bool),
        )
        fixed = self._at.fixed()
        squared = np.zeros(0)
        settled = False
        for iteration in range(1, MAX_ITERATIONS + 1):
            parts = [fixed, *state.cuts]
            if state.linearised is not None:
                parts.append(state.linearised)
            linear = rows_of.interval_rows(rows_of.join(parts), intervals, self._at.scale)
            linear.bound[:] /= state.tightened[:, None]
            found = fastest_speed(linear, self._at.grid)
            if isinstance(found, SolverFailure):
                return self._solver_failure(found, iteration)
            squared = found
            settled = self._advance(state, squared) and not self._tighten(state, squared)
            if settled:
                break
        return self._finish(squared, iteration, settled)

    def _advance(self, state: _State, squared: Array) -> bool:
        """Add or renew rows about a timing; whether it already holds and has settled."""
        w, a = self._at.at_points(squared)
        cuts, excess = self._at.cut(a, w)
        state.cuts += cuts
        ratios = self._at.ratios(a, w)
        duration = _duration(squared, self._at.grid)
        change = abs(duration / state.duration - 1.0) if np.isfinite(state.duration) else 1.0
        state.duration = duration
        if ratios.size:
            excess = max(excess, float(np.abs(ratios).max()) - 1.0)
            state.near |= (np.abs(ratios) > NEAR).any(axis=0)
        if not state.near.any():
            return excess <= POINT_TOLERANCE
        state.linearised = self._at.linearise(ratios, state.near, a, w)
        return excess <= POINT_TOLERANCE and change <= SETTLED

    def _tighten(self, state: _State, squared: Array) -> bool:
        """Tighten the intervals that exceed a limit between their points; whether there are any."""
        ratios = limit_ratios(self._refined(squared), self._model.workcell, self._limits)
        del ratios["friction"]
        use = np.max([ratio.max(axis=1) for ratio in ratios.values()], axis=0)
        excess = use.reshape(self._model.intervals, -1).max(axis=1)
        exceeded = excess > 1.0 + RECOMPUTED_TOLERANCE / 2.0
        state.tightened = np.where(exceeded, state.tightened * excess, state.tightened)
        return bool(exceeded.any())

    def _finish(self, squared: Array, iterations: int, settled: bool) -> Timing:
        """Recompute on refined samples; slow down uniformly where a limit is still exceeded."""
        workcell, limits, names = self._model.workcell, self._limits, self._model.joint_names
        factor = 1.0
        carry = self._refined(squared)
        use = limit_use(carry, workcell, limits, names)
        if worst(use).ratio > 1.0 + RECOMPUTED_TOLERANCE:
            low, factor = 0.0, 1.0
            for _ in range(14):
                middle = (low + factor) / 2.0
                trial = self._refined(middle**2 * squared)
                if worst(limit_use(trial, workcell, limits, names)).ratio > 1.0:
                    factor = middle
                else:
                    low = middle
            factor = low
            squared = factor**2 * squared
            carry = self._refined(squared)
            use = limit_use(carry, workcell, limits, names)
        excess = worst(use)
        status, reason = TimingStatus.OK, f"{carry.duration:.3f} s; most used: {excess.place}"
        if factor < LEAST_SPEED or not settled:
            status = TimingStatus.NOT_CONVERGED
            reason = (
                f"the limits hold, but only after slowing to {factor:.3f} of the speed found in "
                f"{iterations} iterations; the timing is not the fastest"
            )
        return Timing(
            status=status,
            reason=reason,
            place=excess.place,
            carry=carry,
            use=use,
            grid_speed=np.sqrt(squared) / self._at.scale,
            iterations=iterations,
            slowed=factor,
        )

    def _refined(self, squared: Array) -> Carry:
        return refined_carry(self._model, self._motion, np.sqrt(squared) / self._at.scale)

    def _solver_failure(self, failure: SolverFailure, iterations: int) -> Timing:
        point = len(INTERVAL_ENDS) * failure.interval
        columns = self._at.rest[point]
        parameter = float(self._at.points.parameter[point])
        place = Place("path timing", "", "", failure.interval, parameter)
        detail = ""
        if columns.size:
            detail = f" (at rest there, limits are used to {100.0 * np.abs(columns).max():.1f} %)"
        return Timing(
            TimingStatus.SOLVER_FAILED,
            f"{failure.reason}: interval {failure.interval} of {self._model.intervals}, "
            f"u = {place.parameter:.4f}{detail}",
            place,
            None,
            iterations=iterations,
        )


def _duration(squared: Array, grid: Array) -> float:
    speed = np.sqrt(squared)
    return float(np.sum(2.0 * np.diff(grid) / (speed[:-1] + speed[1:])))
