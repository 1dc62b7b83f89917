"""The fastest timing of a path by either method; fast timings of many paths, for searches, without
carries; and the check of any timing against every limit, recomputed from physical quantities alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from hybrid_opt.carry import (
    Carry,
)
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.timing.model import (
    CarryLimits,
    PathMotion,
    SpeedProfile,
    TimingModel,
    require_intervals,
    sample_limits_set,
)
from hybrid_opt.timing.passes import ForwardBackwardPasses, failed_timing, limit_place, path_failure
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
from symbolic.records import Workcell

if TYPE_CHECKING:
    import casadi as ca

    from symbolic.cell_model import CellModel

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


# --- fast timings of many paths ---


PATH_INTERVALS = 100
"""Number of intervals of constant path acceleration."""


class PathTimer:
    """Computes the fastest timings of paths of one workcell.

    They are computed by a compiled backward and forward pass over the path. Limits that it does not
    support are left to `time_path`, which is slow.

    Attributes:
        workcell: the workcell.
        intervals: number of intervals of constant path acceleration.
        passes: the compiled backward and forward pass.
    """

    def __init__(
        self,
        cell: Workcell | CompiledCell,
        intervals: int = PATH_INTERVALS,
        threads: int = 1,
        lanes: int = 0,
    ) -> None:
        """Load or build the compiled functions.

        Args:
            cell: the workcell; give a compiled one to share its functions.
            intervals: number of intervals of constant path acceleration.
            threads: number of threads that share a batch.
            lanes: number of paths that one vector instruction evaluates side by side; 0 for the
                machine's width. One lane builds faster.

        Raises:
            SettingsError: the number of intervals is out of range.
            DualArmError: the model or its code cannot be built.
        """
        require_intervals(intervals)
        compiled = CompiledCell.of(cell)
        self.workcell, self.intervals, self._threads = compiled.workcell, intervals, threads

        def make(model: CellModel) -> dict[str, ca.Function]:
            # Not imported at the top: a warm start needs no CasADi.
            from symbolic.limit_coefficients import path_function

            return {"path": path_function(model, 2 * intervals + 1)}

        paths = compiled.functions("path", make, str(intervals), lanes=lanes, bodies=False)
        self._path, self._limits = paths["path"], sample_limits_set(compiled, lanes)
        self.passes = ForwardBackwardPasses(compiled, intervals, threads)
        # Made here: the cell's files may be gone when the first path is timed.
        has_all = self.passes.supports(TimingLimits(force=1.0, robust=True))
        self._model = None if has_all else TimingModel(compiled, intervals)

    def path_limits(self, x: Array) -> dict[str, Array]:
        """Compute the geometry of n paths and the coefficients of their limits.

        Args:
            x: (n, n_path) free waypoints.

        Returns:
            Outputs of `symbolic.limit_coefficients.path_function` by name. The array `limits` is
            added: (n, 2 intervals + 1, columns of `symbolic.limits.limit_layout`), coefficients at
            both ends and in the middle of every interval.
        """
        # One path is not worth a second thread.
        threads = self._threads if len(x) > 1 else 1
        paths = self._path.batch(np.ascontiguousarray(x, dtype=float), threads=threads)
        shapes = zip(self._limits.input_names, self._limits.input_shapes, strict=True)
        samples = [paths[name].reshape(-1, *shape) for name, shape in shapes]
        rows = self._limits.batch(*samples, threads=threads)["limits"]
        return paths | {"limits": rows.reshape(len(x), 2 * self.intervals + 1, rows.shape[-1])}

    def time(self, x: Array, limits: TimingLimits) -> PathTiming:
        """Compute the fastest timing from rest to rest of one path.

        Args:
            x: (n_path,) free waypoints.
            limits: limits in addition to the workcell's.

        Raises:
            SettingsError: x has the wrong shape or is not finite.
        """
        (timing,) = self.time_all(np.asarray(x, dtype=float)[None], limits)
        return timing

    def path_errors(self, paths: dict[str, Array]) -> list[PathTiming | None]:
        """Find for each of n paths the error that rules out a timing.

        Errors are: no motion, an arm that does not reach the box, joint limits, and manipulability.

        Args:
            paths: result of `path_limits`.

        Returns:
            For each path a record of the error, with infinite duration; None without an error.
        """
        names = ("lost", "limit_margin", "manipulability")
        sides = [np.stack([paths[f"{name}_{arm}"] for arm in (1, 2)], axis=2) for name in names]
        found = [
            path_failure(self.workcell, pose[:, :6], *each)
            for pose, *each in zip(paths["pose"], *sides, strict=True)
        ]
        return [
            None if failure is None else failed_timing(*failure[:2], self.intervals)
            for failure in found
        ]

    def time_all(
        self,
        x: Array,
        limits: TimingLimits,
        force: Array | None = None,
        paths: dict[str, Array] | None = None,
        path_errors: Sequence[PathTiming | None] | None = None,
    ) -> list[PathTiming]:
        """Compute the fastest timing from rest to rest of each of n paths.

        Args:
            x: (n, n_path) free waypoints.
            limits: limits of all paths, in addition to the workcell's.
            force: (n,) force limit of each path [N]; None for the force limit in `limits`.
            paths: result of `path_limits`; computed if None.
            path_errors: result of `path_errors`; computed if None.

        Returns:
            One record per path; without a timing it has infinite duration and states what failed.

        Raises:
            SettingsError: x has the wrong shape or is not finite, or a force limit is not positive.
        """
        x = np.ascontiguousarray(x, dtype=float)
        (n_var,) = self._path.input_shapes[0]
        if x.ndim != 2 or x.shape[1] != n_var or not np.isfinite(x).all():
            raise SettingsError(
                f"waypoints of shape {x.shape}; needs rows of {n_var} finite numbers", code="shape"
            )
        if force is not None and not ((force > 0.0) & (force < np.inf)).all():
            raise SettingsError("force limits of paths: give finite positive forces", code="force")
        paths = self.path_limits(x) if paths is None else paths
        found = list(self.path_errors(paths) if path_errors is None else path_errors)
        rows = [row for row, error in enumerate(found) if error is None]
        if self._model is not None and not self.passes.supports(limits):
            for row in rows:
                own = limits if force is None else replace(limits, force=float(force[row]))
                found[row] = _as_path_timing(self._model, x[row], own)
        elif rows:
            if len(rows) < len(x):
                paths = {name: values[rows] for name, values in paths.items()}
                force = None if force is None else force[rows]
            for row, timing in zip(rows, self.passes.time(paths, limits, force), strict=True):
                found[row] = timing
        return [timing for timing in found if timing is not None]


def _as_path_timing(model: TimingModel, x: Array, limits: TimingLimits) -> PathTiming:
    """Time a path by `time_path` and convert the result to a `PathTiming`.

    Args:
        model: timing model of the workcell.
        x: (n_path,) free waypoints.
        limits: limits in addition to the workcell's.
    """
    timing = time_path(model, x, limits)
    force, robust, carry = np.full(2, np.nan), None, timing.carry
    if timing.status is TimingStatus.INFEASIBLE_AT_REST:
        carry = model.still(model.path_motion(x))
    if carry is not None:
        force = carry.peak_normal_force
        if limits.robust:
            robust = model.carry_limits.limited_force(carry, limits).max(axis=0)
    return PathTiming(
        status=timing.status,
        place=timing.place,
        duration=timing.duration,
        peak_force=force,
        use={name: used.ratio for name, used in timing.use.items()},
        grid_speed=timing.grid_speed,
        sweeps=timing.iterations,
        slowed=timing.slowed,
        robust_force=robust,
    )


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
