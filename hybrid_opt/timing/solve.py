"""Time-optimal timing of a carry by a sequence of linear problems. docs/timing.md explains it.

Limits that are convex in (u'', u'^2) enter as supporting lines, added where the last timing
exceeds them: the sequence approaches the exact limit from outside (Kelley's cutting planes).
Joint torques and pressure shifts depend on the least-effort forces in a way that is not convex;
they are linearised about the last timing and solved again until recomputed values hold.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.timing import rows as rows_of
from hybrid_opt.timing.adapter import SolverFailure, fastest_speed
from hybrid_opt.timing.model import REFINEMENT, PathMotion, TimingModel, contact_torque
from hybrid_opt.timing.path_check import path_failure
from hybrid_opt.timing.records import Place, TimedCarry, Timing, TimingLimits, TimingStatus
from hybrid_opt.timing.rows import STAGE_POINTS, PointRows
from hybrid_opt.timing.use import limit_use, worst
from symbolic.workcell import Array

MAX_ITERATIONS = 25
POINT_TOLERANCE = 1e-3
"""Largest excess at the points where limits are imposed, as a share of the limit."""

RECOMPUTED_TOLERANCE = 5e-3
"""Largest excess on the refined samples, as a share of the limit."""

SETTLED = 2e-4
"""Relative change of duration below which linearised limits count as settled."""

NEAR = 0.6
"""Torques and shifts that stay below this share of their limit get no rows."""

LEAST_SPEED = 0.98
"""A timing that needs more slowing than this to hold its limits has not converged."""


@dataclass
class _State:
    """What the iteration carries from one linear problem to the next."""

    cuts: list[PointRows]
    linearised: PointRows | None = None
    near: NDArray[np.bool_] | None = None
    duration: float = float("inf")


def time_path(
    model: TimingModel, x: Array, limits: TimingLimits, motion: PathMotion | None = None
) -> Timing:
    """The fastest timing from rest to rest within the workcell's and the given limits.

    Args:
        x: (n_var,) decision vector.
        motion: the path's geometry, where it is known already.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    begin = time.perf_counter()
    motion = model.path_motion(x) if motion is None else motion
    timing = path_failure(model, motion) or _failure_at_rest(model, motion, limits)
    if timing is None:
        timing = _Problem(model, motion, limits).solve()
    seconds = time.perf_counter() - begin
    return Timing(**{**vars(timing), "seconds": seconds})


def _failure_at_rest(
    model: TimingModel, motion: PathMotion, limits: TimingLimits
) -> Timing | None:
    """A limit that is exceeded even standing still: then no timing exists.

    Otherwise one exists: slow enough, every quantity is as close to its value at rest as wanted.
    """
    still = np.zeros(len(motion.parameter))
    carry = model.carry(motion, still, still, still)
    use = limit_use(carry, model.workcell, limits, model.joint_names)
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
        stages = model.stages
        offsets = np.array([round(REFINEMENT * share) for share in STAGE_POINTS])
        self._index = (REFINEMENT * np.arange(stages)[:, None] + offsets).reshape(-1)
        self._points = motion.at(self._index)
        self._scale = self._nominal_duration()
        self._grid = np.linspace(0.0, self._scale, stages + 1)
        still = np.zeros(len(self._index))
        self._rest = self._ratios(still, still)

    def solve(self) -> Timing:
        """Solve linear problems until recomputed limits hold and nothing changes any more."""
        state = _State(cuts=[self._first_cuts()])
        fixed = rows_of.join(
            [
                rows_of.speed_rows(
                    self._points, self._model.workcell, self._limits, self._scale
                ),
                rows_of.joint_acceleration_rows(self._points, self._model.workcell),
            ]
        )
        squared = np.zeros(0)
        settled = False
        for iteration in range(1, MAX_ITERATIONS + 1):
            parts = [fixed, *state.cuts]
            if state.linearised is not None:
                parts.append(state.linearised)
            linear = rows_of.stage_rows(rows_of.join(parts), self._model.stages, self._scale)
            found = fastest_speed(linear, self._grid)
            if isinstance(found, SolverFailure):
                return self._solver_failure(found, iteration)
            squared = found
            settled = self._advance(state, squared)
            if settled:
                break
        return self._finish(squared, iteration, settled)

    def _advance(self, state: _State, squared: Array) -> bool:
        """Add or renew rows about a timing; whether it already holds and has settled."""
        w, a = self._at_points(squared)
        excess = self._cut(state, a, w)
        ratios = self._ratios(a, w)
        duration = _duration(squared, self._grid)
        change = abs(duration / state.duration - 1.0) if np.isfinite(state.duration) else 1.0
        state.duration = duration
        if ratios.shape[1]:
            excess = max(excess, float(np.abs(ratios).max()) - 1.0)
            near = (np.abs(ratios) > NEAR).any(axis=0)
            state.near = near if state.near is None else state.near | near
            renewed = bool(state.near.any())
            if renewed:
                state.linearised = self._linearise(ratios, state.near, a, w)
            else:
                change = 0.0
        else:
            change = 0.0
        return excess <= POINT_TOLERANCE and change <= SETTLED

    def _nominal_duration(self) -> float:
        """Duration at the reference speeds [s]: scales the path so that speeds are around one."""
        limits = TimingLimits(reference_speed=True)
        squared = rows_of.squared_speed_limit(self._motion, self._model.workcell, limits)
        slowness = 1.0 / np.sqrt(np.minimum(squared, 1e8))
        return float(np.trapezoid(slowness, self._motion.parameter))

    def _at_points(self, squared: Array) -> tuple[Array, Array]:
        """u'^2 and u'' (points,) of a timing (stages + 1,) in the scaled coordinate."""
        slope = np.diff(squared)
        w = squared[:-1, None] + np.outer(slope, STAGE_POINTS)
        a = np.repeat(slope / (2.0 * np.diff(self._grid)), len(STAGE_POINTS))
        return w.reshape(-1) / self._scale**2, a / self._scale

    def _first_cuts(self) -> PointRows:
        """Supporting lines of the convex limits before any timing is known."""
        p, payload = self._points, self._model.workcell.payload
        linear = (p.pose_first[:, :3], p.pose_second[:, :3])
        angular = (p.angular_first, p.angular_second)
        cuts = [
            rows_of.norm_rows(*pair, limit, rows_of.spanning_directions(*pair))
            for pair, limit in (
                (linear, payload.acceleration_max),
                (angular, payload.angular_acceleration_max),
            )
        ]
        still = np.zeros(len(self._index))
        return rows_of.join([*cuts, *self._force_cut(still, still)])

    def _force_cut(self, a: Array, w: Array) -> list[PointRows]:
        if self._limits.force is None:
            return []
        tangent = rows_of.tangent_direction(self._points, self._model.workcell, a, w)
        return [
            rows_of.force_rows(self._points, self._model.workcell, self._limits.force, tangent)
        ]

    def _cut(self, state: _State, a: Array, w: Array) -> float:
        """Add supporting lines of the convex limits that a timing exceeds; the largest excess."""
        p, payload = self._points, self._model.workcell.payload
        worst_excess = -1.0
        for first, second, limit in (
            (p.pose_first[:, :3], p.pose_second[:, :3], payload.acceleration_max),
            (p.angular_first, p.angular_second, payload.angular_acceleration_max),
        ):
            vector = first * a[:, None] + second * w[:, None]
            length = np.linalg.norm(vector, axis=1, keepdims=True)
            excess = float(length.max()) / limit - 1.0
            worst_excess = max(worst_excess, excess)
            if excess > POINT_TOLERANCE:
                direction = vector / np.maximum(length, 1e-12)
                state.cuts.append(rows_of.norm_rows(first, second, limit, direction[:, None, :]))
        if self._limits.force is not None:
            load = self._model.drive(p, np.sqrt(w), a)
            excess = float(load["normal_force"].max()) / self._limits.force - 1.0
            worst_excess = max(worst_excess, excess)
            # What the force limit leaves for the motion is small, so the whole of it counts.
            if excess > POINT_TOLERANCE * FORCE_SHARPNESS:
                state.cuts += self._force_cut(a, w)
                worst_excess = max(worst_excess, 2.0 * POINT_TOLERANCE)
        return worst_excess

    def _ratios(self, a: Array, w: Array) -> Array:
        """Limits that are not convex, over their limits at the points, signed (n, k)."""
        columns: list[Array] = []
        if not (self._limits.torque or self._limits.pressure):
            return np.zeros((len(a), 0))
        p, workcell = self._points, self._model.workcell
        load = self._model.drive(p, np.sqrt(w), a)
        if self._limits.torque:
            own = p.torque_by_acceleration * a[:, None] + p.torque_by_speed * w[:, None]
            torque = contact_torque(p, load) + own + p.torque_at_rest
            columns.append(torque / np.concatenate([r.torque_max for r in workcell.robots]))
        if self._limits.pressure:
            radius = np.array([contact.patch_radius for contact in workcell.contacts])
            columns.append(load["pressure_shift"] / radius)
        return np.concatenate(columns, axis=1)

    def _linearise(
        self, ratios: Array, near: NDArray[np.bool_], a: Array, w: Array
    ) -> PointRows:
        """Rows of the ratios near their limits, by forward differences in (u'', u'^2)."""
        step_a = 1e-5 * max(float(np.abs(a).max()), 1e-6)
        step_w = 1e-5 * max(float(w.max()), 1e-6)
        gradient = np.stack(
            [
                (self._ratios(a + step_a, w) - ratios) / step_a,
                (self._ratios(a, w + step_w) - ratios) / step_w,
            ],
            axis=-1,
        )[:, near]
        z = np.stack([a, w], axis=1)
        value, rest = ratios[:, near], self._rest[:, near]
        return rows_of.join(
            [
                rows_of.linearised_rows(sign * value, sign * gradient, sign * rest, z)
                for sign in (1.0, -1.0)
            ]
        )

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
            grid_speed=np.sqrt(squared) / self._scale,
            iterations=iterations,
            slowed=factor,
        )

    def _refined(self, squared: Array) -> TimedCarry:
        """The carry at `REFINEMENT` samples per stage, both ends of every stage included."""
        stages = self._model.stages
        share = np.linspace(0.0, 1.0, REFINEMENT + 1)
        w = squared[:-1, None] + np.outer(np.diff(squared), share)
        speed = np.sqrt(np.maximum(w, 0.0))
        length = self._grid[1]
        # Average speed over a piece of constant acceleration is that of its ends.
        total = speed[:, :1] + speed
        elapsed = 2.0 * share * length / np.where(total > 0.0, total, 1.0)
        starts = np.concatenate([[0.0], np.cumsum(elapsed[:, -1])])[:-1]
        a = np.repeat(np.diff(squared) / (2.0 * length), REFINEMENT + 1)
        index = REFINEMENT * np.arange(stages)[:, None] + np.arange(REFINEMENT + 1)
        return self._model.carry(
            self._motion.at(index.reshape(-1)),
            (starts[:, None] + elapsed).reshape(-1),
            speed.reshape(-1) / self._scale,
            a / self._scale,
        )

    def _solver_failure(self, failure: SolverFailure, iterations: int) -> Timing:
        point = len(STAGE_POINTS) * failure.stage
        columns = self._rest[point]
        place = Place(
            "path timing", "", "", failure.stage, float(self._points.parameter[point])
        )
        detail = ""
        if columns.size:
            detail = f" (at rest there, limits are used to {100.0 * np.abs(columns).max():.1f} %)"
        return Timing(
            TimingStatus.SOLVER_FAILED,
            f"{failure.reason}: stage {failure.stage} of {self._model.stages}, "
            f"u = {place.parameter:.4f}{detail}",
            place,
            None,
            iterations=iterations,
        )


FORCE_SHARPNESS = 0.02
"""Tolerance of the normal force as a share of `POINT_TOLERANCE`."""


def _duration(squared: Array, grid: Array) -> float:
    speed = np.sqrt(squared)
    return float(np.sum(2.0 * np.diff(grid) / (speed[:-1] + speed[1:])))
