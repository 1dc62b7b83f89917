"""Validation of timings by TOPP-RA: a sequence of its linear programs. docs/explanation/timing.md
explains it.

At a point of the path every limit reads alpha u'' + beta u'^2 <= bound. Joint speeds and
accelerations do so exactly. Limits that are convex in (u'', u'^2) enter as supporting lines, added
where the last timing exceeds them: the sequence approaches the exact limit from outside (Kelley's
cutting planes). Joint torques and pressure shifts depend on the least-effort forces in a way that
is not convex; they are linearised about the last timing and solved again until recomputed values
hold. toppra logs its failures and returns None or NaN: they become records with the reason.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.timing.model import REFINEMENT, PathMotion, SpeedProfile, TimingModel
from hybrid_opt.timing.programs import (
    LINEARISED_ABOVE,
    PathLimits,
    duration_at_speed_limits,
    squared_speed_limit,
)
from hybrid_opt.timing.records import (
    FRICTION_RATIO,
    PathTiming,
    Place,
    Timing,
    TimingLimits,
    TimingStatus,
)
from symbolic.array import Array
from symbolic.functions import TIMING_TOLERANCE

MAX_ITERATIONS = 25
"""Largest number of linear problems per timing."""
SETTLED_CHANGE = 2e-4
"""Linearised limits count as settled if the duration changes by less than this share."""

INTERVAL_ENDS = (0.0, 1.0)
"""Positions within an interval at which limits apply, as shares of its length."""

POINT_TOLERANCE = 1e-3
"""Largest excess at the points where limits are imposed, as a share of the limit."""

FORCE_SHARPNESS = 0.02
"""Tolerance of the normal force as a share of `POINT_TOLERANCE`."""


@dataclass(frozen=True)
class LinearLimits:
    """k linear limits alpha u'' + beta u'^2 <= bound at each of n points of the path, or in each of
    n intervals.

    In an interval, u'' is the constant path acceleration and u'^2 is taken at the beginning.

    Attributes:
        alpha, beta, bound: (n, k) coefficients and bounds.
    """

    alpha: Array
    beta: Array
    bound: Array


def toppra_timing(
    model: TimingModel, motion: PathMotion, limits: TimingLimits
) -> PathTiming | Timing:
    """Compute the fastest timing of a path by a sequence of TOPP-RA's linear programs.

    Args:
        model: timing model of the workcell.
        motion: geometry of a path that both arms follow and on which no limit is exceeded at rest.
        limits: limits in addition to the workcell's.

    Returns:
        The timing, not yet checked on the finer grid, or the solver's failure.
    """
    return _CuttingPlaneProblem(model, motion, limits).solve()


class _CuttingPlaneProblem:
    """Sequence of linear programs that computes the fastest timing of one path within one set of
    limits.

    `_tightened` (intervals,) divides the bounds of each interval; it is above one if a limit was
    exceeded between the points of the interval. `_near` marks the limits that are not convex and
    came near their bounds.
    """

    def __init__(self, model: TimingModel, motion: PathMotion, limits: TimingLimits) -> None:
        self._model, self._motion, self._limits = model, motion, limits
        intervals = model.intervals
        offsets = np.array([round(REFINEMENT * share) for share in INTERVAL_ENDS])
        index = (REFINEMENT * np.arange(intervals)[:, None] + offsets).reshape(-1)
        self._at = PathLimits(model, motion.at(index), limits)
        # The solver's path coordinate is scale times u, so that speeds are around one.
        self._scale = duration_at_speed_limits(model, motion, limits)
        self._grid = np.linspace(0.0, self._scale, intervals + 1)
        still = np.zeros(len(index))
        self._rest = self._at.ratios(still, still)
        self._cuts = list(self._first_rows())
        self._linearised: list[LinearLimits] = []
        self._tightened = np.ones(intervals)
        self._near = np.zeros(self._rest.shape[1], dtype=bool)
        self._duration = np.inf

    def _first_rows(self) -> Iterator[LinearLimits]:
        """Yield the linear limits of the first linear program of TOPP-RA.

        These are the limits on speeds and joint accelerations, and the first supporting lines
        (tangents) of the convex limits.
        """
        limit = squared_speed_limit(self._model, self._at.motion, self._limits)
        limit = np.minimum(limit, SPEED_CEILING / self._scale**2)[:, None]
        one, alpha, beta = np.ones_like(limit), *self._at.joint_accelerations()
        yield LinearLimits(
            np.concatenate([0.0 * one, alpha, -alpha], axis=1),
            np.concatenate([1.0 / limit, beta, -beta], axis=1),
            np.repeat(one, 1 + 2 * alpha.shape[1], axis=1),
        )
        for first, second, bound in self._at.accelerations():
            # Both signs of two orthogonal unit vectors that span both.
            e = _unit(first)
            f = _unit(second - np.sum(second * e, axis=1, keepdims=True) * e)
            yield norm_rows(first, second, bound, np.stack([e, -e, f, -f], axis=1))
        still = np.zeros(len(self._rest))
        for force in self._at.forces(still, still):
            yield tangent_rows(*force, _pairs(still, still))

    def solve(self) -> PathTiming | Timing:
        """Solve linear programs until the timing satisfies all limits and its duration no longer
        changes.

        Returns:
            The timing, with status `NOT_CONVERGED` after `MAX_ITERATIONS` programs; or the failure
            of the solver.
        """
        squared = np.zeros(0)
        settled = False
        for iteration in range(1, MAX_ITERATIONS + 1):
            linear = self._interval_rows([*self._cuts, *self._linearised])
            found = fastest_speed(linear, self._grid)
            if isinstance(found, SolverFailure):
                return self._solver_failure(found, iteration)
            squared = found
            settled = self._advance(squared) and not self._tighten(squared)
            if settled:
                break
        return PathTiming(
            status=TimingStatus.OK if settled else TimingStatus.NOT_CONVERGED,
            place=Place("path timing", "", "", 0, 0.0),
            duration=self._duration,
            peak_force=np.full(2, np.nan),
            use={},
            grid_speed=np.sqrt(squared) / self._scale,
            sweeps=iteration,
        )

    def _interval_rows(self, rows: list[LinearLimits]) -> LinearLimits:
        """Convert limits at the points of each interval to limits on the interval's two unknowns:
        its constant u'', and u'^2 at its beginning. Both are taken in the scaled path coordinate.

        Args:
            rows: limits at all points.
        """
        alpha, beta, bound = (
            np.concatenate([getattr(row, name) for row in rows], axis=1)
            for name in ("alpha", "beta", "bound")
        )
        intervals, scale = self._model.intervals, self._scale
        # Within an interval u'^2 = u'^2_0 + 2 share length u''.
        progress = np.tile(np.array(INTERVAL_ENDS) * 2.0 * scale / intervals, intervals)[:, None]
        alpha, beta = alpha / scale, beta / scale**2
        shape = (intervals, len(INTERVAL_ENDS) * alpha.shape[1])
        return LinearLimits(
            (alpha + progress * beta).reshape(shape),
            beta.reshape(shape),
            bound.reshape(shape) / self._tightened[:, None],
        )

    def _at_points(self, squared: Array) -> tuple[Array, Array]:
        """Return u'' and u'^2 [1/s^2] of a timing at all points, (points,) each.

        Args:
            squared: (intervals + 1,) squared speeds at the grid points in the scaled path
                coordinate.
        """
        slope = np.diff(squared)
        w = squared[:-1, None] + np.outer(slope, INTERVAL_ENDS)
        a = np.repeat(slope / (2.0 * np.diff(self._grid)), len(INTERVAL_ENDS))
        return a / self._scale, w.reshape(-1) / self._scale**2

    def _advance(self, squared: Array) -> bool:
        """Add the rows that the present timing violates to the next linear program.

        Convex limits that the timing exceeds get supporting lines, which exclude the timing. The
        other limits are linearised about it.

        Args:
            squared: (intervals + 1,) squared speeds of the timing in the scaled path coordinate.

        Returns:
            True if no further program is necessary: the timing satisfies the limits and, where
            limits are linearised, its duration no longer changes.
        """
        a, w = self._at_points(squared)
        excess = self._cut(a, w)
        ratios = self._at.ratios(a, w)
        speed = np.sqrt(squared)
        duration = float(np.sum(2.0 * np.diff(self._grid) / (speed[:-1] + speed[1:])))
        change = abs(duration / self._duration - 1.0)
        self._duration = duration
        if ratios.size:
            excess = max(excess, float(np.abs(ratios).max()) - 1.0)
            self._near |= (np.abs(ratios) > LINEARISED_ABOVE).any(axis=0)
        if not self._near.any():
            return excess <= POINT_TOLERANCE
        near, z = self._near, _pairs(a, w)
        gradient = self._at.ratio_slopes(ratios, a, w)[:, near]
        value, rest = ratios[:, near], self._rest[:, near]
        self._linearised = [
            linearised_rows(sign * value, sign * gradient, sign * rest, z) for sign in (1.0, -1.0)
        ]
        return excess <= POINT_TOLERANCE and change <= SETTLED_CHANGE

    def _cut(self, a: Array, w: Array) -> float:
        """Add supporting lines of the convex limits that a timing exceeds, tangent at this timing.

        Args:
            a, w: (points,) path acceleration u'' and squared path speed u'^2 of the timing [1/s^2].

        Returns:
            The largest excess over a convex limit, as a share of the limit; negative if none is
            exceeded.
        """
        worst_excess = -1.0
        for first, second, limit in self._at.accelerations():
            vector = first * a[:, None] + second * w[:, None]
            length = np.linalg.norm(vector, axis=1, keepdims=True)
            excess = float(length.max()) / limit - 1.0
            worst_excess = max(worst_excess, excess)
            if excess > POINT_TOLERANCE:
                direction = vector / np.maximum(length, 1e-12)
                self._cuts.append(norm_rows(first, second, limit, direction[:, None, :]))
        forces = self._at.forces(a, w)
        excess = max((float(force.max()) for force, _ in forces), default=0.0) - 1.0
        worst_excess = max(worst_excess, excess)
        # What the force limit leaves for the motion is small, so the whole of it counts.
        if excess > POINT_TOLERANCE * FORCE_SHARPNESS:
            self._cuts += [tangent_rows(*force, _pairs(a, w)) for force in forces]
            worst_excess = max(worst_excess, 2.0 * POINT_TOLERANCE)
        return worst_excess

    def _tighten(self, squared: Array) -> bool:
        """Tighten the limits of the intervals in which a timing exceeds a limit between the points
        at which the limits apply.

        Args:
            squared: (intervals + 1,) squared speeds of the timing in the scaled path coordinate.

        Returns:
            True if there are any such intervals.
        """
        ratios = self._model.carry_limits.ratios(self._refined(squared), self._limits)
        del ratios[FRICTION_RATIO]
        use = np.max([ratio.max(axis=1) for ratio in ratios.values()], axis=0)
        excess = use.reshape(self._model.intervals, -1).max(axis=1)
        exceeded = excess > 1.0 + TIMING_TOLERANCE / 2.0
        self._tightened = np.where(exceeded, self._tightened * excess, self._tightened)
        return bool(exceeded.any())

    def _refined(self, squared: Array) -> Carry:
        speeds = SpeedProfile.from_grid_speed(np.sqrt(squared) / self._scale)
        return speeds.carry(self._model, self._motion)

    def _solver_failure(self, failure: SolverFailure, iterations: int) -> Timing:
        point = len(INTERVAL_ENDS) * failure.interval
        columns = self._rest[point]
        parameter = float(self._at.motion.parameter[point])
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


def norm_rows(first: Array, second: Array, limit: float, directions: Array) -> LinearLimits:
    """Return supporting lines (tangents) of the limit |first u'' + second u'^2| <= limit on the
    length of a vector.

    Args:
        first: (n, 3) derivative of the vector by u'' at n points.
        second: (n, 3) derivative of the vector by u'^2.
        limit: largest allowed length, in the vector's unit.
        directions: (n, k, 3) unit vectors; each gives one line, a bound on the component along it.
    """
    alpha = np.einsum("nkd,nd->nk", directions, first) / limit
    beta = np.einsum("nkd,nd->nk", directions, second) / limit
    return LinearLimits(alpha, beta, np.ones_like(alpha))


def tangent_rows(value: Array, gradient: Array, z: Array) -> LinearLimits:
    """Return tangents, at z, of k convex functions of (u'', u'^2) that may not exceed one.

    Args:
        value: (n, k) values of the functions at z.
        gradient: (n, k, 2) their gradients at z by (u'', u'^2).
        z: (n, 2) values of (u'', u'^2) at n points.
    """
    bound = 1.0 - value + np.einsum("nkd,nd->nk", gradient, z)
    return LinearLimits(gradient[..., 0], gradient[..., 1], bound)


def linearised_rows(value: Array, gradient: Array, at_rest: Array, z: Array) -> LinearLimits:
    """Linearise k functions of (u'', u'^2), which may not exceed one, about points z, such that
    rest (u'' = u'^2 = 0) stays feasible.

    Where the tangent at z would forbid rest, an affine function replaces it: it has the function's
    values at z and at rest, and the tangent's slope by u''. To shift the tangent until it allows
    rest would not do, because it might then allow z, which exceeds the limit.

    Args:
        value: (n, k) values of the functions at z.
        gradient: (n, k, 2) their gradients at z by (u'', u'^2).
        at_rest: (n, k) their values at rest, below one.
        z: (n, 2) values of (u'', u'^2) at n points.
    """
    lines = tangent_rows(value, gradient, z)
    least = (1.0 - at_rest) / 2.0
    a, w = z[:, :1], z[:, 1:]
    chord = (value - at_rest - lines.alpha * a) / np.maximum(w, 1e-300)
    forbids = (lines.bound < least) & (w > 0.0)
    return LinearLimits(
        lines.alpha,
        np.where(forbids, chord, lines.beta),
        np.where(forbids, 1.0 - at_rest, np.maximum(lines.bound, least)),
    )


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: Array = np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), 0.0)
    return unit


def _pairs(a: Array, w: Array) -> Array:
    return np.stack([a, w], axis=1)


SPEED_CEILING = 1e4
"""Largest squared path speed that toppra's solver admits, in its scaled path coordinate."""


RESCALINGS = (1.0, 0.4, 2.5)
"""Factors on the path coordinate, tried in turn: toppra's linear programs use absolute tolerances
and now and then call a feasible interval infeasible."""


@dataclass(frozen=True)
class SolverFailure:
    """A failure of toppra.

    Attributes:
        reason: what failed.
        interval: index of the interval in which it failed.
    """

    reason: str
    interval: int


def fastest_speed(rows: LinearLimits, grid: Array) -> Array | SolverFailure:
    """Compute the fastest motion from rest to rest within linear limits.

    Args:
        rows: the linear limits of each interval.
        grid: (intervals + 1,) increasing path coordinate, scaled so that speeds are around one.

    Returns:
        (intervals + 1,) squared path speeds at the grid points, zero at both ends; or a failure.
    """
    found: Array | SolverFailure = SolverFailure("not tried", 0)
    for factor in RESCALINGS:
        scaled = LinearLimits(rows.alpha / factor, rows.beta / factor**2, rows.bound)
        found = _solve(scaled, factor * grid)
        if not isinstance(found, SolverFailure):
            return found / factor**2
    return found


def _solve(rows: LinearLimits, grid: Array) -> Array | SolverFailure:
    # Imported late: toppra pulls in plotting.
    from toppra.algorithm import TOPPRA
    from toppra.constraint import LinearConstraint
    from toppra.interpolator import AbstractGeometricPath

    class Line(AbstractGeometricPath):  # type: ignore[misc]
        """Geometric path for toppra that is the path coordinate itself. All geometry is in the
        limits."""

        @property
        def dof(self) -> int:
            return 1

        @property
        def path_interval(self) -> Array:
            return grid[[0, -1]]

        def __call__(self, path_positions: Any, order: int = 0) -> Any:
            raise NotImplementedError

    class ToppraLimits(LinearConstraint):  # type: ignore[misc]
        """Constraint for toppra: rows F w <= g with w = (u'', u'^2)."""

        def compute_constraint_params(self, *_: Any) -> tuple[Any, ...]:
            n = len(grid)
            f = np.zeros((n, rows.alpha.shape[1], 2))
            g = np.ones((n, rows.alpha.shape[1]))
            f[:-1, :, 0], f[:-1, :, 1], g[:-1] = rows.alpha, rows.beta, rows.bound
            ceiling = np.tile([0.0, SPEED_CEILING], (n, 1))
            unit = np.tile([1.0, 0.0], (n, 1))
            return unit, unit[:, ::-1].copy(), np.zeros((n, 2)), f, g, None, ceiling

    with _quiet():
        algorithm = TOPPRA(
            [ToppraLimits()],
            Line(),
            gridpoints=grid,
            solver_wrapper="seidel",
            parametrizer="ParametrizeConstAccel",
        )
        _, speed, _, controllable = algorithm.compute_parameterization(0.0, 0.0, return_data=True)
    if np.isnan(controllable).any():
        interval = int(np.flatnonzero(np.isnan(controllable).any(axis=1))[-1])
        return SolverFailure("no speed at this place lets the path be finished", interval)
    if speed is None:
        return SolverFailure("the path cannot be started from rest", 0)
    if not np.isfinite(speed).all():
        interval = int(np.argmin(np.isfinite(speed)))
        return SolverFailure("the forward pass broke down", min(interval, len(grid) - 2))
    squared: Array = np.asarray(speed, dtype=float) ** 2
    if np.any(squared[:-1] + squared[1:] <= 0.0):
        interval = int(np.argmax(squared[:-1] + squared[1:] <= 0.0))
        return SolverFailure("the motion comes to a standstill", interval)
    return squared


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the log of the package toppra within a `with` block. Its failures are returned as
    `SolverFailure`.
    """
    logger = logging.getLogger("toppra")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)
