"""Step method of drivable carries: a quadratic model of path and timing together.

A first program without the Lagrangian's curvature finds multipliers, which so do not depend on
earlier iterations elsewhere. With them the quadratic model is formed and solved. If geometric rows
are strongly nonlinear along the step, it is corrected to second order. The compiled timing of the
resulting path evaluates the step, not the program: a path without a faster timing is rejected
before its geometry is evaluated. The solve ends where the program's optimality conditions hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.cell import CarryReader, SmoothCell
from hybrid_opt.polishing.constraints.kinds import RowSelector
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
    QuadraticAnswer,
    QuadraticProgram,
    convexify,
    solve_quadratic,
)
from hybrid_opt.robust.path_force import PathPoints, robust_path
from hybrid_opt.timing.candidates import CandidateDriver, TimedCandidate
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.errors import SettingsError
from symbolic.path.spline import coarse_entries, hierarchical_basis, waypoints_of
from symbolic.records import Workcell
from symbolic.records.task import initial_decision

FIRST_DRIVE_RADIUS, LEAST_DRIVE_RADIUS = 0.3, 1e-4
"""First radius of the trust region, and radius below which a solve ends [half ranges of the
waypoints]."""

STATIONARITY_TOLERANCE, FEASIBILITY_TOLERANCE = 1e-4, 5e-3
"""Residuals below which a point counts as optimal: of stationarity and complementarity, and of
feasibility. The latter is larger because required distances change with the path."""

TIMING_NOISE = 5e-4
"""Relative change of a duration that may be caused by rounding in the timing."""

LEAST_REDUCTION_RATIO = 0.1
"""Least reduction ratio of an accepted step, unless rounding in the timing may hide the
reduction."""

DRIVE_BACKTRACKING = (1.0, 0.5, 0.25, 0.125)
"""Fractions of a rejected step, in the order in which they are tried. An evaluation costs a tenth
of an iteration."""

NEWTON_STEP = 0.05
"""After shorter steps the program's squared speeds are kept; after longer ones those of the new
timing are used."""

ROW_ROUNDS, ROW_TOLERANCE = 3, 1e-6
"""Number of times that rows are added to one quadratic program, and the predicted excess over a
limit at which its row is added."""

TIGHT_ROOM = 1e-6
"""Rows with less room than this at the iterate are active at the start of a first solve."""

MULTIPLIER_CURVATURE = 1.0
"""Curvature along the path variables in the program that finds multipliers."""

LARGEST_NONLINEARITY = 0.2
"""Nonlinearity of geometric rows along a step above which the step is corrected to second order
once."""

DRIVE_EXTRAPOLATION = (2.0, 4.0, 8.0)
"""Multiples of a step that are tried if its gain exceeded the prediction. An evaluation costs a
tenth of an iteration."""

LEAST_SQUARED, LARGEST_SQUARED = 0.9, 3.0
"""Largest relative fall and rise of a squared speed in a step."""

UNPOLISHABLE = "the polish does not know robust forces of pads whose normals are not opposite"
"""Message for cells for which `is_polishable` returns False."""

REST_FORCE_MARGIN = 1e-3
"""Share by which the least force limit exceeds the force that holds the box at rest."""


def is_polishable(workcell: Workcell, robust: bool) -> bool:
    """Return True if drivable carries of a cell can be polished.

    Args:
        workcell: the cell.
        robust: True if the force limit applies to robust normal forces, which hold the box in every
            case of the uncertainty. Their polish needs two pads that face each other.
    """
    return command_model(workcell).has_scalar_squeeze or not robust


def force_range(driver: CandidateDriver) -> tuple[float, float]:
    """Return the least and the largest force limit of the task [N].

    If the limit applies to robust normal forces, which hold the box in every case of the
    uncertainty, the least limit is at least the robust force of the box at rest at both ends of the
    path.
    """
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
    """An iterate of a drivable carry; its level, the value that is minimised, is the duration [s].

    Attributes:
        joints: (intervals + 1, n) joint positions of each arm at the grid points of the timing
            [rad].
        squared: (intervals + 1,) squared path speeds u'^2 [1/s^2], of the timing or as predicted by
            a program.
        best_level: least duration so far [s]. Steps are compared with it, so that rounding of the
            timing does not accumulate.
    """

    joints: tuple[Array, Array]
    squared: Array
    best_level: float


@dataclass(frozen=True, kw_only=True)
class DriveStep(Step):
    """A step of path and speeds.

    Attributes:
        d: (n_path,) change of the program's path variables, scaled to [-1, 1] by their bounds.
        squared: (intervals + 1,) predicted squared path speeds u'^2 [1/s^2].
        gain: predicted relative reduction of the duration.
    """

    d: Array
    squared: Array
    gain: float


@dataclass(frozen=True)
class _StepAnswer:
    """Solution of a quadratic program, and the program's rows.

    Attributes:
        answer: the solution.
        linear: linearised rows (scalar inequalities) of the program.
    """

    answer: QuadraticAnswer
    linear: LinearisedRows

    def multipliers_of(self, linear: LinearisedRows) -> Array:
        """Arrange the multipliers of this solution for another selection of rows of the same
        quadratic program.

        Args:
            linear: the selected rows, linearised.

        Returns:
            Multipliers (n + rows,) of the n bounds, then of the selected rows; 0 for rows that were
            not in the program of this solution.
        """
        timing = np.zeros(linear.shape)
        timing[self.linear.point, self.linear.kind] = self.answer.rows[: len(self.linear.point)]
        geometry = self.answer.rows[len(self.linear.point) :]
        return np.concatenate([self.answer.bounds, timing[linear.point, linear.kind], geometry])


class DriveStepMethod(StepMethod[DriveIterate, DriveStep]):
    """Step method that minimises the duration of a drivable carry within its own force limit.

    Create one object per process, because it loads compiled functions.

    Attributes:
        driver: computes timings of candidates and paths.
        force_limit: least and largest force limit [N].
        hand_made: (n_path,) free waypoints of the hand-made trajectory.
        coarse: step method that moves only the waypoints of the workcell file, which the
            intermediate waypoints follow: fewer variables need fewer and cheaper iterations.
            Without intermediate waypoints it is this object itself.
    """

    least_radius, extrapolation = LEAST_DRIVE_RADIUS, DRIVE_EXTRAPOLATION
    shrinks_below_step = relaxes_until_improved = True

    def __init__(self, cell: SmoothCell, is_coarse: bool = False) -> None:
        """Compute from a cell what all steps share: bounds and scales of the path variables, the
        grid of the timing, and the range of force limits.

        Args:
            cell: shared data of the polish.
            is_coarse: True to move only the waypoints of the workcell file; False to move the
                intermediate waypoints too.

        Raises:
            SettingsError: the cell is not drivable (its carries are not timed from rest to rest
                within all limits), or its force limit applies to robust normal forces and its pads
                do not face each other.
        """
        driver, task = cell.evaluator.driver, cell.task
        if driver is None or not is_polishable(cell.workcell, driver.robust):
            raise SettingsError(
                f"the polish of drivable carries needs a drivable cell; {UNPOLISHABLE}: "
                "switch the polish off",
                code="not-polishable",
            )
        super().__init__(cell, RowSelector(cell), CarryReader(cell))
        self.driver, self._n = driver, task.n_path
        self.half = cell.half[: task.n_path]
        self._own = own = coarse_entries(task) if is_coarse else np.arange(task.n_path)
        self._bounds = task.lower[own], task.upper[own]
        by, square = hierarchical_basis(task)
        self._unit = (self.half * square)[own]
        self._newton = NEWTON_STEP * float(square[own].min())
        self._spread = by[:, own] * self._unit
        self.force_limit = force_range(driver)
        self.hand_made = initial_decision(task)[: task.n_path]
        intervals, threads = driver.timer.intervals, cell.evaluator.threads
        self._intervals = IntervalGrid(
            cell.workcell, intervals, self._spread, driver.robust, threads
        )
        self.coarse = self
        if task.pieces > 1 and not is_coarse:
            self.coarse = DriveStepMethod(cell, is_coarse=True)

    def evaluate(self, x: Array) -> DriveIterate:
        """Evaluate a decision vector with its fastest timing.

        Args:
            x: (n_var,) decision vector.
        """
        timed = self.driver.time_candidate(x)
        return self._iterate(x, timed, timed.squared, np.inf)

    def _iterate(
        self, x: Array, timed: TimedCandidate, squared: Array, best_level: float
    ) -> DriveIterate:
        best_level = min(best_level, timed.duration)
        return DriveIterate(
            x, self.reader.read(x), timed.duration, timed.joints, squared, best_level
        )

    def _moved(self, x: Array, d: Array) -> Array:
        """Return the decision vector (n_var,) after a step, clipped to the bounds.

        Args:
            x: (n_var,) decision vector before the step.
            d: (n_path,) change of the path variables of the quadratic program.
        """
        n, task = self._n, self.cell.task
        moved = x[:n] + self._spread @ d
        return np.append(np.clip(moved, task.lower[:n], task.upper[:n]), x[n:])

    def evaluate_step(self, best: DriveIterate, step: DriveStep) -> StepEvaluation[DriveIterate]:
        """Evaluate a step by the fastest timing of the path to which it leads.

        Shorter and shorter fractions of the step are tried until the duration falls by at least
        `LEAST_REDUCTION_RATIO` of the reduction that the quadratic model predicts. If the predicted
        reduction is within the rounding of the timing, a duration equal to the shortest one so far
        suffices; so rounding errors do not accumulate over several steps.

        Args:
            best: the best iterate so far, from which the step starts.
            step: the step.

        Returns:
            The evaluation of the accepted fraction. It has no trial if no fraction is accepted, or
            if a path on the way has no timing.
        """
        tiny = step.gain <= TIMING_NOISE
        for fraction in DRIVE_BACKTRACKING:
            x = self._moved(best.x, fraction * step.d)
            timed = self.driver.time_candidate(x)
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
        """Evaluate the candidate after a fraction of a step by its fastest timing.

        Args:
            begin: iterate from which the step starts.
            best: the best iterate so far.
            step: the step.
            share: the fraction, or the multiple, of the step.

        Returns:
            The candidate; None if it is not faster than the best iterate.
        """
        x = self._moved(begin.x, share * step.d)
        timed = self.driver.time_candidate(x)
        if timed.duration >= best.level * (1.0 - TIMING_NOISE):
            return None
        return self._iterate(x, timed, timed.squared, best.best_level)

    def propose_step(
        self, best: DriveIterate, required: Mapping[Row, float], radius: float
    ) -> DriveStep | None:
        """Solve the quadratic model of path and timing about the best iterate.

        Args:
            best: the best iterate so far.
            required: value that each geometric row (scalar inequality at a point of the path) has
                to exceed.
            radius: half the width of the trust region [half ranges of the variables].

        Returns:
            The step to the solution; None if the model has no solution.
        """
        grid = self._intervals
        values = IntervalValues(
            grid, self.cell.functions, best.carry.waypoints, best.squared, best.joints
        )
        program = PathTimingProgram(
            grid, values, best.x, best.squared, self.cell, required, best.carry
        )
        box, chosen = self._box(best, radius), program.near_rows()
        plain = program.curvature()
        plain[np.diag_indices(program.n_path)] = MULTIPLIER_CURVATURE
        first = self._solved(program, chosen, (plain, np.zeros(program.n)), box)
        if first is None:
            return None
        H = program.curvature(first.linear, first.answer.rows)
        active = first.answer.rows > NEGLIGIBLE_MULTIPLIER
        model = convexify(H, first.linear.A[active], first.linear.b[active])
        second = self._solved(program, chosen, model, box, first)
        if second is None:
            return None
        residuals = min(
            (self._residuals(program, best, found) for found in (first, second)),
            key=lambda known: known.stationarity + known.complementarity,
        )
        bent = program.geometry_after(second.answer.d)
        if np.abs(bent).max(initial=0.0) > LARGEST_NONLINEARITY:
            second = self._solved(program, chosen, model, box, second, bent) or second
        d = second.answer.d
        squared = best.squared.copy()
        squared[1:-1] *= 1.0 + d[program.speeds]
        rows = program.geometric_rows
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
        model: tuple[Array, Array],
        box: tuple[Array, Array],
        found: _StepAnswer | None = None,
        bent: Array | float = 0.0,
    ) -> _StepAnswer | None:
        """Solve the quadratic program of a step repeatedly: each time add the timing rows that the
        last solution violates, until none is violated or `ROW_ROUNDS` programs were solved.

        A timing row is one limit at one point of the timing. If no step satisfies all rows, rows
        that are violated at the iterate may stay violated as much as there.

        Args:
            program: path and timing about the iterate, linearised.
            chosen: (points, kinds) mask of the timing rows that are included. Violated rows are
                added to it in place.
            model: Hessian (n, n) of the quadratic model, and vector (n,) that is added to the
                objective's gradient.
            box: lower and upper bounds (n,) of the step.
            found: solution of a similar quadratic program, in whose active set the solve starts.
                None to start with the rows that are tight at the iterate.
            bent: (geometric rows,) error of the geometric rows' linear model along an earlier step.
                It is added to these rows.

        Returns:
            The last solution with its rows; None if there is no solution.
        """
        g = program.gradient() + model[1]
        for left in reversed(range(ROW_ROUNDS)):
            linear = program.linear(chosen, bent)
            asked = QuadraticProgram(model[0], g, linear.A, linear.b, *box)
            tight = np.append(np.zeros(program.n), linear.b < TIGHT_ROOM)
            start = found.multipliers_of(linear) if found else tight
            answer = solve_quadratic(asked, start)
            if answer is None:
                # Infeasible within the trust region: rows keep their present violation at most.
                answer = solve_quadratic(replace(asked, b=np.maximum(linear.b, 0.0)), start)
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
        """Compute the optimality residuals of an iterate with the multipliers of a step.

        The variables' own bounds count as constraints; the bounds of the trust region do not.

        Args:
            program: path and timing about the iterate, linearised.
            best: the iterate.
            found: solution that contains the step and its multipliers.
        """
        (lower, upper), n, answer = self._bounds, program.n_path, found.answer
        edge, own = 1e-6 * self._unit, answer.bounds[:n]
        reached = best.x[self._own] + self._unit * answer.d[:n]
        at_low = (own < 0.0) & (reached < lower + edge)
        at_high = (own > 0.0) & (reached > upper - edge)
        bounds = np.zeros(program.n)
        bounds[:n] = np.where(at_low | at_high, own, 0.0)
        return program.residuals(bounds, found.linear, answer.rows)

    def solve_from(self, x: Array) -> TrustRegionSolve[DriveIterate, DriveStep]:
        """Prepare a solve that starts from a decision vector x (n_var,); it makes no
        iteration yet."""
        return TrustRegionSolve(self, x, FIRST_DRIVE_RADIUS)


def _is_optimal(residuals: Residuals) -> bool:
    return (
        residuals.stationarity <= STATIONARITY_TOLERANCE
        and residuals.complementarity <= STATIONARITY_TOLERANCE
        and residuals.feasibility <= FEASIBILITY_TOLERANCE
    )
