"""The step and the judge of drivable carries: a quadratic model of path and timing together.

First a program without the Lagrangian's curvature finds multipliers: they owe nothing to earlier
rounds, which may have been elsewhere. With them the quadratic model is formed and solved, and where
geometric rows bend along the step, it is corrected for that. The judge is the compiled timing of
the path that the step leads to, not the program: a path that is driven no better is refused before
its geometry is looked at. The polish ends where the program's optimality conditions hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.carry import CarryReader
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.constraints.active import RowSelector
from hybrid_opt.polishing.intervals import (
    NEGLIGIBLE_MULTIPLIER,
    IntervalGrid,
    IntervalValues,
    LinearisedRows,
    PathTimingProgram,
)
from hybrid_opt.polishing.point import (
    HALVED,
    QUARTERED,
    Iterate,
    Step,
    StepEvaluation,
    StepMethod,
    TrustRegionSolve,
)
from hybrid_opt.polishing.rows import Row
from hybrid_opt.polishing.solvers.base import Residuals
from hybrid_opt.polishing.solvers.quadratic import (
    BorderedMatrix,
    QuadraticAnswer,
    QuadraticProgram,
    convexify,
    solve_quadratic,
)
from hybrid_opt.robust.path_force import PathPoints, robust_path
from hybrid_opt.timing.drive import CandidateDriver
from hybrid_opt.timing.path_timer import PathTiming
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.path.pieces import by_levels, stated_entries
from symbolic.records import Workcell
from symbolic.records.task import waypoints_of

FIRST_DRIVE_RADIUS, LEAST_DRIVE_RADIUS = 0.3, 1e-4
"""Radii of the box of trust, in half ranges of the waypoints; below the least a point is
left."""

STATIONARITY_TOLERANCE, FEASIBILITY_TOLERANCE = 1e-4, 5e-3
"""Residuals of stationarity and of complementarity, and of feasibility, at which a point counts as
optimal: what is asked of distances moves with the path."""

TIMING_NOISE = 5e-4
"""Relative change of a timing that counts as none: what the timing rounds off."""

LEAST_REDUCTION_RATIO = 0.1
"""Share of the promised gain that a step has to bring, unless the timing may have rounded it
off."""

DRIVE_BACKTRACKING = (1.0, 0.5, 0.25, 0.125)
"""Parts of a step that are tried, the first that is closer is taken: judging costs a tenth of a
round."""

NEWTON_STEP = 0.05
"""Steps shorter than this keep the program's squared speeds, longer ones take those of the new
timing."""

ROW_ROUNDS, ROW_TOLERANCE = 3, 1e-6
"""Times that rows are added to one quadratic program, and the predicted excess of a limit that adds
its row."""

MULTIPLIER_CURVATURE = 1.0
"""Curvature by the path of the program that finds multipliers."""

LARGEST_NONLINEARITY = 0.2
"""Error of geometric rows, by their curvature along a step, above which it is corrected, once."""

DRIVE_EXTRAPOLATION = (2.0, 4.0, 8.0)
"""Times a step that brought more than it promised: judging costs a tenth of a round."""

LEAST_SQUARED, LARGEST_SQUARED = 0.9, 3.0
"""How far a squared speed may fall and rise in a step, as shares of it."""

UNPOLISHABLE = (
    "the polish does not know the allocation 'joint' of two pads that face one another, nor robust "
    "forces of pads whose normals are not opposite"
)
"""Why a cell is not `is_polishable`."""

REST_FORCE_MARGIN = 1e-3
"""The least force limit is this share above the force that holds the box at rest."""


def is_polishable(workcell: Workcell, robust: bool) -> bool:
    """Whether drivable carries of a cell can be polished: those whose planned forces have slopes,
    and where robust ones are limited, of two pads with opposite normals."""
    return workcell.has_force_slopes and (workcell.has_one_squeeze or not robust)


@dataclass(frozen=True)
class EvaluatedPath:
    """A path with its fastest timing within a force limit.

    Attributes:
        duration: [s], infinite where there is none.
        squared: (intervals + 1,) u'^2 at the grid points.
        joints: of both arms at the grid points (intervals + 1, n) [rad].
    """

    duration: float
    squared: Array
    joints: tuple[Array, Array]


class PathEvaluator:
    """Times paths by the compiled passes.

    Attributes:
        force_limit: least and largest [N].
    """

    def __init__(self, driver: CandidateDriver) -> None:
        self._driver, self.force_limit = driver, force_range(driver)

    def fastest_timing(self, x: Array) -> EvaluatedPath:
        """The fastest timing of a decision vector (n_var,)."""
        found, known = self._driver.time_candidate(x)
        duration = found.duration if found.ok else float("inf")
        joints = [np.ascontiguousarray(known[f"q_{arm}"][0][::2]) for arm in (1, 2)]
        return EvaluatedPath(duration, found.grid_speed**2, (joints[0], joints[1]))

    def durations(self, paths: Array, force: float) -> Array:
        """(n,) [s] of paths (n, n_path) within a force, infinite where there is none."""
        found = self._timings(paths, force)
        return np.array([t.duration if t.ok else np.inf for t in found])

    def at_rest(self, paths: Array) -> Array:
        """(n,) [N] what standing still needs of paths (n, n_path), NaN where arms cannot follow."""
        return np.array([timing.limited_force for timing in self._timings(paths, 0.0)])

    def _timings(self, paths: Array, force: float) -> list[PathTiming]:
        limits = [self._driver.limits(force)] * len(paths)
        return self._driver.timer.time_all(np.ascontiguousarray(paths), limits)


def force_range(driver: CandidateDriver) -> tuple[float, float]:
    """The task's least and largest force limit [N]; of robust forces the least is at least what
    holds the box at both ends of every path."""
    workcell = driver.timer.workcell
    least, most = workcell.task.force_limit
    if driver.robust:
        ends = waypoints_of(workcell.task, workcell.task.lower)[[0, -1]]
        (first, second), (a, w) = np.zeros((2, 2, 6)), np.zeros((2, 2))
        held, _ = robust_path(workcell).at(PathPoints(ends, first, second, a, w))
        least = max(least, (1.0 + REST_FORCE_MARGIN) * float(held.max()))
    return least, most


@dataclass(frozen=True)
class DriveIterate(Iterate):
    """A carry whose level is its duration [s].

    Attributes:
        joints: as of its timing.
        squared: (intervals + 1,) u'^2, its timing's or those that a program promised.
        lowest: the least level so far: what the timing rounds off must not add up.
    """

    joints: tuple[Array, Array]
    squared: Array
    best_level: float


@dataclass(frozen=True, kw_only=True)
class DriveStep(Step):
    """A step of a path.

    Attributes:
        d: scaled, of the waypoints that are moved.
        squared: (intervals + 1,) u'^2 that its program promises.
        gain: the share of the duration that it promises to take off.
    """

    d: Array
    squared: Array
    gain: float


@dataclass(frozen=True)
class _StepAnswer:
    """A quadratic program's answer, and the rows that it was given."""

    answer: QuadraticAnswer
    linear: LinearisedRows


class DriveStepMethod(StepMethod[DriveIterate, DriveStep]):
    """The least duration within the force limit of the start. A resource: one per process.

    Attributes:
        driver, paths: how carries and paths are timed.
        stated: the same by moves of the waypoints that the file states, along which the others
            follow; itself where there are no others. Fewer variables take fewer and cheaper rounds.
    """

    least_radius, extrapolation = LEAST_DRIVE_RADIUS, DRIVE_EXTRAPOLATION
    shrinks_below_step = relaxes_until_improved = True

    def __init__(self, cell: SmoothCell, is_coarse: bool = False) -> None:
        """Prepare programs.

        Args:
            by_stated: whether moves are those of the stated waypoints.

        Raises:
            SettingsError: the time law is not 'optimal', or forces have no closed form.
        """
        driver, task = cell.evaluator.driver, cell.task
        if driver is None or not is_polishable(cell.workcell, driver.robust):
            raise SettingsError(
                f"the polish of drivable carries needs the time law 'optimal'; {UNPOLISHABLE}: "
                "switch the polish off"
            )
        super().__init__(cell, RowSelector(cell), CarryReader(cell))
        self.driver, self._n = driver, task.n_path
        self.half = cell.half[: task.n_path]
        self._own = own = stated_entries(task) if is_coarse else np.arange(task.n_path)
        self._bounds = task.lower[own], task.upper[own]
        by, square = by_levels(task)
        self._unit = (self.half * square)[own]
        self._newton = NEWTON_STEP * float(square[own].min())
        self._spread = by[:, own] * self._unit
        self.paths = PathEvaluator(driver)
        intervals, threads = driver.timer.intervals, cell.evaluator.threads
        self._intervals = IntervalGrid(
            cell.workcell, intervals, self._spread, driver.robust, threads
        )
        self.coarse = self
        if task.pieces > 1 and not is_coarse:
            self.coarse = DriveStepMethod(cell, is_coarse=True)

    def evaluate(self, x: Array) -> DriveIterate:
        """See `StepMethod`."""
        timed = self.paths.fastest_timing(x)
        return self._iterate(x, timed, timed.squared, np.inf)

    def _iterate(
        self, x: Array, timed: EvaluatedPath, squared: Array, best_level: float
    ) -> DriveIterate:
        best_level = min(best_level, timed.duration)
        return DriveIterate(
            x, self.reader.read(x), timed.duration, timed.joints, squared, best_level
        )

    def _moved(self, x: Array, d: Array) -> Array:
        """(n_var,) after a scaled step of the path."""
        n, task = self._n, self.cell.task
        moved = x[:n] + self._spread @ d
        return np.append(np.clip(moved, task.lower[:n], task.upper[:n]), x[n:])

    def evaluate_step(self, best: DriveIterate, step: DriveStep) -> StepEvaluation[DriveIterate]:
        """Evaluate a step by its timing; rounding may hide a small gain, but must not
        accumulate."""
        tiny = step.gain <= TIMING_NOISE
        for fraction in DRIVE_BACKTRACKING:
            x = self._moved(best.x, fraction * step.d)
            timed = self.paths.fastest_timing(x)
            gain = 1.0 - timed.duration / best.level
            is_no_worse = timed.duration <= best.best_level * (1.0 + TIMING_NOISE)
            if gain >= LEAST_REDUCTION_RATIO * fraction * step.gain or (tiny and is_no_worse):
                break
            if not np.isfinite(timed.duration):
                return StepEvaluation(None, improved=False, factor=QUARTERED)
        else:
            return StepEvaluation(None, improved=False, factor=HALVED * fraction)
        share = gain / max(fraction * step.gain, 1e-300)
        keep_active_set = fraction == 1.0 and step.length <= self._newton
        squared = step.squared if keep_active_set else timed.squared
        return StepEvaluation(
            self._iterate(x, timed, squared, best.best_level),
            improved=True,
            reduction_ratio=max(share, 0.5) if tiny else share,
            fraction=fraction,
            exceeds_prediction=fraction == 1.0 and gain > step.gain and not tiny,
            keep_active_set=keep_active_set,
        )

    def evaluate_fraction(
        self, begin: DriveIterate, best: DriveIterate, step: DriveStep, share: float
    ) -> DriveIterate | None:
        """See `StepMethod`."""
        x = self._moved(begin.x, share * step.d)
        timed = self.paths.fastest_timing(x)
        if timed.duration >= best.level * (1.0 - TIMING_NOISE):
            return None
        return self._iterate(x, timed, timed.squared, best.best_level)

    def propose_step(
        self, best: DriveIterate, required: Mapping[Row, float], radius: float
    ) -> DriveStep | None:
        """Form the joint program about the best carry so far, and solve its quadratic model."""
        grid = self._intervals
        values = IntervalValues(grid, self.cell.functions, best.x, best.squared, best.joints)
        program = PathTimingProgram(
            grid, values, best.x, best.squared, self.cell, required, best.carry
        )
        box, chosen = self._box(best, radius), program.near_rows()
        steady = np.zeros(program.n)
        steady[: program.n_path] = MULTIPLIER_CURVATURE
        plain = program.curvature().add_diagonal(steady)
        first = self._solved(program, chosen, (plain, np.zeros(program.n)), box)
        if first is None:
            return None
        H = program.curvature(first.linear, first.answer.rows)
        active = first.answer.rows > NEGLIGIBLE_MULTIPLIER
        model = convexify(H, first.linear.A.select(active), first.linear.b[active])
        second = self._solved(program, chosen, model, box)
        if second is None:
            return None
        residuals = min(
            (self._residuals(program, best, found) for found in (first, second)),
            key=lambda known: known.stationarity + known.complementarity,
        )
        bent = program.geometry_after(second.answer.d)
        if np.abs(bent).max(initial=0.0) > LARGEST_NONLINEARITY:
            second = self._solved(program, chosen, model, box, bent) or second
        d = second.answer.d
        squared = best.squared.copy()
        squared[1:-1] *= 1.0 + d[program.speeds]
        rows = program.place_rows
        is_active = (
            second.answer.rows[len(second.linear.point) :][: len(rows)] > NEGLIGIBLE_MULTIPLIER
        )
        path = d[: program.n_path]
        return DriveStep(
            length=float(np.abs(path).max()),
            required=required,
            residuals=lambda _: residuals,
            iterations=1,
            is_stationary=_is_optimal(residuals),
            active_rows=tuple(row for row, own in zip(rows, is_active, strict=True) if own),
            d=path,
            squared=squared,
            gain=max(program.gain(d), 0.0),
        )

    def _solved(
        self,
        program: PathTimingProgram,
        chosen: NDArray[np.bool_],
        model: tuple[BorderedMatrix, Array],
        box: tuple[Array, Array],
        bent: Array | float = 0.0,
    ) -> _StepAnswer | None:
        """Solve a quadratic model; rows that its answer violates are added. `chosen` grows."""
        g = program.gradient() + model[1]
        found: _StepAnswer | None = None
        for left in reversed(range(ROW_ROUNDS)):
            linear = program.linear(chosen, bent)
            asked = QuadraticProgram(model[0], g, linear.A, linear.b, *box)
            answer = solve_quadratic(asked)
            if answer is None:
                # Rows that the box has no room for are asked for as far as they are kept now.
                answer = solve_quadratic(replace(asked, b=np.maximum(linear.b, 0.0)))
            if answer is None:
                return None
            found = _StepAnswer(answer, linear)
            fresh = (program.predicted(answer.d) > ROW_TOLERANCE) & ~chosen
            if not fresh.any():
                break
            chosen |= fresh
            if not left:
                chosen &= ~fresh
        return found

    def _box(self, best: DriveIterate, radius: float) -> tuple[Array, Array]:
        """Bounds of a step."""
        (lower, upper), xi = self._bounds, best.x[self._own]
        speeds = np.ones(self._intervals.intervals - 1)
        low = np.maximum((lower - xi) / self._unit, -radius)
        high = np.minimum((upper - xi) / self._unit, radius)
        return (
            np.concatenate([low, -LEAST_SQUARED * speeds]),
            np.concatenate([high, LARGEST_SQUARED * speeds]),
        )

    def _residuals(
        self, program: PathTimingProgram, best: DriveIterate, found: _StepAnswer
    ) -> Residuals:
        """Residuals of the program at its iterate, with a step's multipliers. Bounds count where
        they are the variables' own, not the box of trust's."""
        (lower, upper), n, answer = self._bounds, program.n_path, found.answer
        edge, own = 1e-6 * self._unit, answer.bounds[:n]
        reached = best.x[self._own] + self._unit * answer.d[:n]
        at_low = (own < 0.0) & (reached < lower + edge)
        at_high = (own > 0.0) & (reached > upper - edge)
        bounds = np.zeros(program.n)
        bounds[:n] = np.where(at_low | at_high, own, 0.0)
        return program.residuals(bounds, found.linear, answer.rows)

    def solve_from(self, x: Array) -> TrustRegionSolve[DriveIterate, DriveStep]:
        """A climb from a decision vector (n_var,), before its first round."""
        return TrustRegionSolve(self, x, FIRST_DRIVE_RADIUS)


def _is_optimal(residuals: Residuals) -> bool:
    return (
        residuals.stationarity <= STATIONARITY_TOLERANCE
        and residuals.complementarity <= STATIONARITY_TOLERANCE
        and residuals.feasibility <= FEASIBILITY_TOLERANCE
    )
