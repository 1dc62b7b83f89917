"""A trust-region method for one point of a front.

Each iteration collects the rows near the best candidate, proposes a step within a box (the trust
region) about it, and has the full model evaluate the candidate that it leads to. Rows that the step
violates enter the working set or get a tighter bound; if none of them is new, the radius is halved.
A step that violates nothing and improves the level is accepted, so the answer is never worse than
the start. The solve ends at a stationary point inside the box.

A `StepMethod` proposes and evaluates steps: for both peak forces it solves one nonlinear program
per step (`hybrid_opt.polishing.force`), for path and timing together a quadratic model, evaluated
by the compiled timing (`hybrid_opt.polishing.drive`).

Source: Conn, Gould and Toint, Trust-Region Methods (2000).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from hybrid_opt.polishing.cell import CarryReader, PlacedCarry, SmoothCell
from hybrid_opt.polishing.constraints.kinds import RowSelector
from hybrid_opt.polishing.front import Solution
from hybrid_opt.polishing.rows import MinimisedForces, PathRow, Row
from hybrid_opt.polishing.solvers.base import Residuals
from symbolic.array import Array

OPTIMUM_TOLERANCE = 5e-4
"""Largest excess of the level [unit of the level] with which an optimum that satisfies all rows
replaces a better candidate that may violate some."""

HALVED, QUARTERED, DOUBLED = 0.5, 0.25, 2.0
"""Factors of the radius."""

LARGEST_RADIUS = 2.0
"""Largest radius [half ranges of the decision variables]."""

BOUNDED_SHARE = 0.9
"""Steps shorter than this share of the radius were not bounded by the box."""

HIGH_RATIO, LOW_RATIO = 0.7, 0.3
"""Reduction ratios above which the radius may grow, and below which it shrinks."""

LEAST_TIGHTENING = 1e-4
"""Smallest rise of a required value that counts as new [m, rad, 1]."""

ACTIVE_ROW_LIFETIME = 3
"""Number of programs for which a row stays in the working set after it was last active."""


class TrustRegion:
    """Radius of the trust region and its update rule.

    The region is a box, so that it adds only bounds to a program. If a step violates a row (scalar
    inequality) that its program lacked, the program is repeated at the same radius with this row.

    Attributes:
        radius: half the width of the box [half ranges of the decision variables].
    """

    def __init__(self, radius: float, least: float) -> None:
        """Start with a radius.

        Args:
            radius: half the width of the first box [half ranges of the decision variables].
            least: radius below which the solve ends.
        """
        self.radius, self._least, self._was_good = radius, least, False

    @property
    def is_exhausted(self) -> bool:
        """True if the radius is below its least value."""
        return self.radius < self._least

    def is_step_bounded(self, length: float) -> bool:
        """Return True if the trust region limited a step.

        Args:
            length: largest change of a scaled variable in the step.
        """
        return length >= BOUNDED_SHARE * self.radius

    def on_failed_subproblem(self) -> None:
        """Shrink the radius after a subproblem without a solution."""
        self.radius *= QUARTERED

    def on_no_improvement(self, length: float, factor: float = QUARTERED) -> None:
        """Shrink the radius after a step that violated nothing but did not improve.

        Args:
            length: largest change of a scaled variable in the step.
            factor: factor on the smaller one of radius and length.
        """
        self.radius = min(self.radius, length) * factor

    def on_reject(self, is_new: bool, length: float = np.inf) -> None:
        """Shrink the radius after a step that was rejected because it violates rows (scalar
        inequalities).

        Args:
            is_new: True if a violated row was not in the program. The radius then stays, because
                the incomplete program caused the violation. False halves the radius.
            length: largest change of a scaled variable in the step, from which the radius is halved
                if it is smaller than the radius.
        """
        self._was_good = False
        if not is_new:
            self.radius = HALVED * min(self.radius, length)

    def on_accept(
        self, length: float, reduction_ratio: float | None = None, is_partial: bool = False
    ) -> None:
        """Update the radius after an accepted step.

        The radius doubles if the trust region limited the step and the model is good: the reduction
        ratio is above `HIGH_RATIO` or, without a ratio, no step was rejected since the last
        accepted one. It halves if the ratio is at most `LOW_RATIO`.

        Args:
            length: largest change of a scaled variable in the step.
            reduction_ratio: actual over predicted reduction; None without a prediction.
            is_partial: True if only a fraction of the step was accepted; `length` is that of the
                fraction, and becomes the radius first.
        """
        if is_partial:
            self.radius = length
        grows = self._was_good if reduction_ratio is None else reduction_ratio > HIGH_RATIO
        if grows and self.is_step_bounded(length):
            self.radius = min(DOUBLED * self.radius, LARGEST_RADIUS)
        elif reduction_ratio is not None and reduction_ratio <= LOW_RATIO:
            self.radius *= HALVED
        self._was_good = True


@dataclass(frozen=True)
class Iterate:
    """A candidate evaluated by the full model.

    Attributes:
        x: (n_var,) decision vector.
        carry: the candidate, evaluated at points of the path.
        level: the value that the solve minimises: a scalarisation of peak forces, or the duration
            [s].
    """

    x: Array
    carry: PlacedCarry
    level: float


@dataclass(frozen=True, kw_only=True)
class Step:
    """A step proposed by a `StepMethod`.

    Attributes:
        length: largest change of a scaled variable.
        required: value that each row (scalar inequality) of the program had to exceed.
        residuals: function from an iterate to its optimality residuals in this program.
        iterations: number of solver iterations.
        is_stationary: True if the iterate from which the step starts is stationary.
        converged: True if the solver reports that it solved the program to optimality.
        active_rows: rows at points of the path with a nonzero multiplier.
    """

    length: float
    required: Mapping[Row, float]
    residuals: Callable[[Iterate], Residuals] = field(repr=False)
    iterations: int
    is_stationary: bool = False
    converged: bool = False
    active_rows: tuple[PathRow, ...] = ()


AnyIterate = TypeVar("AnyIterate", bound=Iterate)
AnyStep = TypeVar("AnyStep", bound=Step)


@dataclass(frozen=True)
class StepEvaluation(Generic[AnyIterate]):
    """Evaluation of a step by the full model.

    Attributes:
        trial: iterate after the step; None if the step is no improvement and reveals no row (scalar
            inequality) that the program lacks.
        improved: True if the trial has a lower level than the best iterate.
        factor: factor on the radius after a step without improvement.
        reduction_ratio: actual over predicted reduction of the level; None without a prediction.
        fraction: fraction of the step that leads to the trial.
        exceeds_prediction: True if the reduction is larger than predicted, so that longer steps are
            worth trying.
        keep_active_set: True if the next program keeps the active rows.
    """

    trial: AnyIterate | None
    improved: bool
    factor: float = QUARTERED
    reduction_ratio: float | None = None
    fraction: float = 1.0
    exceeds_prediction: bool = False
    keep_active_set: bool = False


class StepMethod(ABC, Generic[AnyIterate, AnyStep]):
    """Proposes and evaluates the steps of a solve.

    Attributes:
        cell: shared data of the polish.
        active: selects the rows (scalar inequalities) near a candidate.
        reader: evaluates candidates at points of the path.
        half: (n,) half ranges of the variables that steps change [m, rad].
        limits: for each robot, True if its normal force is minimised.
        least_radius: radius below which the solve ends.
        shrinks_below_step: True if a rejected step reduces the radius below the step's own length.
        relaxes_until_improved: True if distance rows require no more than the iterate satisfies
            until a step improves; otherwise only in the first iteration. A start may be nearer to
            obstacles than the wanted clearance.
        backtracking: fractions of a rejected step that are tried in its place, the longest first.
        extrapolation: multiples of a step that are tried after it exceeded its prediction, the
            shortest first.
    """

    limits: MinimisedForces = (True, True)
    least_radius: float
    shrinks_below_step: bool = False
    relaxes_until_improved: bool = False
    backtracking: tuple[float, ...] = ()
    extrapolation: tuple[float, ...] = ()

    def __init__(self, cell: SmoothCell, active: RowSelector, reader: CarryReader) -> None:
        self.cell, self.active, self.reader = cell, active, reader
        self.half = cell.half

    @abstractmethod
    def evaluate(self, x: Array) -> AnyIterate:
        """Evaluate a candidate by the full model.

        Args:
            x: (n_var,) decision vector.
        """

    @abstractmethod
    def propose_step(
        self, best: AnyIterate, required: Mapping[Row, float], radius: float
    ) -> AnyStep | None:
        """Propose a step from the best iterate, by solving an optimisation problem with linear or
        smooth models.

        Args:
            best: the best iterate so far.
            required: value that each row (scalar inequality) has to exceed.
            radius: half the width of the trust region [half ranges of the variables].

        Returns:
            The step; None if the optimisation problem has no solution.
        """

    @abstractmethod
    def evaluate_step(self, best: AnyIterate, step: AnyStep) -> StepEvaluation[AnyIterate]:
        """Evaluate the candidate after a step by the full model.

        Args:
            best: the best iterate so far, from which the step starts.
            step: the step.
        """

    @abstractmethod
    def evaluate_fraction(
        self, begin: AnyIterate, best: AnyIterate, step: AnyStep, share: float
    ) -> AnyIterate | None:
        """Evaluate the candidate after a fraction of a step.

        Args:
            begin: iterate from which the step starts.
            best: the best iterate so far.
            step: the step.
            share: the fraction, or the multiple, of the step.

        Returns:
            The candidate; None if it does not improve on the best iterate.
        """

    def missing_rows(self, trial: AnyIterate) -> set[Row]:
        """Return rows (scalar inequalities) that the optimisation problem of a step should have
        contained.

        The method is called after a step that violated nothing but did not improve.

        Args:
            trial: candidate after the step.
        """
        return set()


class WorkingSet:
    """Rows (scalar inequalities) that a solve keeps in its programs, besides the rows that are near
    their bounds.

    These are rows that a rejected step violated, each with the value that it has to exceed, and
    rows that were active in one of the last programs.

    A rejected step tightens the bounds of the rows that it violates. These bounds hold at the end
    of the rejected step. Bounds of distances are not smooth, so a much shorter step need not
    satisfy them. Therefore only a share of the tightening counts: the share of the way to the
    rejected candidate that the trust region covers. With the full tightening, the only feasible
    step in a small region would lead to that candidate.

    Rows are at local minima along the path. Where two minima are equally low, each step would raise
    the one with a row and lower the other, without end. Therefore, in the polish of drivable
    carries, active rows stay in the working set while steps are short. After a long step they are
    dropped, since they would hold the payload on its former side of an edge.
    """

    def __init__(self, active: RowSelector, half: Array) -> None:
        """Start with no rows.

        Args:
            active: selector of rows, which knows whether a row's tightened bound stays valid at
                other candidates.
            half: (n,) half ranges of the variables that steps change [m, rad].
        """
        self._active, self._half = active, half
        self._tightened: dict[Row, tuple[float, Array]] = {}
        self._active_for: dict[Row, int] = {}

    @property
    def rows(self) -> set[Row]:
        """All rows (scalar inequalities) of the next program apart from those near their bounds."""
        return {*self._tightened, *self._active_for}

    def tighten(self, required: dict[Row, float], x: Array, radius: float) -> None:
        """Raise the values that rows (scalar inequalities) have to exceed in the next step towards
        the tightened bounds that rejected steps gave them.

        A value is raised by a share of its distance to the tightened bound. The share is the radius
        of the trust region over the distance to the candidate at which the bound was tightened, at
        most 1.

        Args:
            required: value that each row has to exceed, changed in place.
            x: decision vector from which the next step starts; its first n entries are the
                variables that steps change.
            radius: radius of the trust region [half ranges of the variables].
        """
        for row, (value, tightened_at) in self._tightened.items():
            n = len(self._half)
            far = float(np.abs((tightened_at[:n] - x[:n]) / self._half).max())
            share = min(1.0, radius / max(far, 1e-300))
            required[row] += share * max(value - required[row], 0.0)

    def learn_from_rejection(
        self, bounds: Mapping[Row, float], x: Array, required: Mapping[Row, float]
    ) -> bool:
        """Add the rows (scalar inequalities) that a rejected step violates.

        Args:
            bounds: tightened bound of each violated row.
            x: (n_var,) decision vector after the step.
            required: value that each row of the program had to exceed.

        Returns:
            True if any row is new, or if its bound rises by more than `LEAST_TIGHTENING`.
        """
        is_new = False
        for row, value in bounds.items():
            tightened = self._tightened[row][0] if row in self._tightened else -np.inf
            is_new |= value > max(required.get(row, -np.inf), tightened) + LEAST_TIGHTENING
            if value > tightened:
                self._tightened[row] = value, x
        return is_new

    def add(self, rows: Iterable[Row], x: Array) -> None:
        """Add rows (scalar inequalities) that the optimisation problem of a step lacked, without
        tightening their bounds.

        Args:
            rows: the missing rows.
            x: (n_var,) decision vector after the step.
        """
        self._tightened.update(dict.fromkeys(rows, (-np.inf, x)))

    def mark_active(self, rows: Iterable[Row]) -> None:
        """Keep rows (scalar inequalities) in the optimisation problems of the next
        `ACTIVE_ROW_LIFETIME` steps.

        Args:
            rows: rows that have a nonzero multiplier in the last step.
        """
        left = {row: count - 1 for row, count in self._active_for.items() if count > 1}
        self._active_for = left | dict.fromkeys(rows, ACTIVE_ROW_LIFETIME)

    def on_new_best(self, keep_active_set: bool = False) -> None:
        """Discard the tightened bounds that are relative to the former best candidate, because a
        better one was found.

        Args:
            keep_active_set: False to discard also the rows that were active in the last programs.
        """
        if not keep_active_set:
            self._active_for = {}
        self._tightened = {
            row: v for row, v in self._tightened.items() if self._active.persists(row)
        }


class TrustRegionSolve(Generic[AnyIterate, AnyStep]):
    """A trust-region solve from one start, which can be continued.

    Attributes:
        solution: the result so far.
        best: the best iterate so far.
    """

    def __init__(self, method: StepMethod[AnyIterate, AnyStep], x: Array, radius: float) -> None:
        """Evaluate the start.

        Args:
            method: proposes and evaluates steps.
            x: (n_var,) feasible decision vector.
            radius: half the width of the first trust region [half ranges of the variables].
        """
        self._method, task = method, method.cell.task
        self.best = method.evaluate(np.clip(x, task.lower, task.upper))
        self._start_level, self._is_relaxed = self.best.level, True
        self._region = TrustRegion(radius, method.least_radius)
        self._working_set = WorkingSet(method.active, method.half)
        self._last_step: Step | None = None
        self.solution = Solution(self.best.x, usable=bool(np.isfinite(self.best.level)))

    @property
    def is_finished(self) -> bool:
        """True if the best iterate is stationary, the trust region is exhausted, or the start could
        not be evaluated: further iterations would change nothing.
        """
        return self.solution.converged or self._region.is_exhausted or not self.solution.usable

    def run(self, rounds: int, least_gain: float = 0.0) -> Solution:
        """Make at most `rounds` iterations, and return the result so far.

        Args:
            rounds: largest number of iterations.
            least_gain: least relative reduction of the level by two successive iterations, below
                which the solve stops. It applies after the first accepted step, because rejected
                steps before it only add rows.
        """
        solution, levels = self.solution, [self.best.level]
        for _ in range(rounds):
            if self.is_finished:
                break
            solution.rounds += 1
            self._iterate()
            if len(levels) > 1 or self.best.level != levels[0]:
                levels.append(self.best.level)
            if len(levels) > 3 and levels[-3] - levels[-1] < least_gain * levels[-1]:
                break
        solution.x = self.best.x
        if self._last_step is not None:
            solution.residuals = self._last_step.residuals(self.best)
            solution.rows = sum(isinstance(row, PathRow) for row in self._last_step.required)
        if not solution.usable:
            solution.message = "the start cannot be judged"
        elif solution.converged:
            solution.message = "stationary"
        else:
            solution.message = "the box of trust is spent" if self.is_finished else "out of rounds"
        return solution

    def _iterate(self) -> None:
        """Propose a step, evaluate it, and accept or reject the candidate after it."""
        method, best, region = self._method, self.best, self._region
        is_relaxed, self._is_relaxed = (
            self._is_relaxed,
            self._is_relaxed and method.relaxes_until_improved,
        )
        rows = method.active.near_rows(best.carry, method.limits) | self._working_set.rows
        required = method.active.required_values(best.carry, rows, is_relaxed)
        self._working_set.tighten(required, best.x, region.radius)
        step = method.propose_step(best, required, region.radius)
        if step is None:
            region.on_failed_subproblem()
            return
        self._last_step = step
        self.solution.iterations += step.iterations
        self._working_set.mark_active(step.active_rows)
        if step.is_stationary:
            self.solution.converged = True
            return
        evaluation = method.evaluate_step(best, step)
        self._is_relaxed = method.relaxes_until_improved and not evaluation.improved
        if (trial := evaluation.trial) is None:
            region.on_no_improvement(step.length, evaluation.factor)
            return
        violated = method.active.violated_rows(trial.carry, best.carry, step.required)
        if violated or not trial.carry.is_reachable:
            bounds = method.active.tightened_bounds(
                trial.carry, best.carry, violated, step.required
            )
            is_new = self._working_set.learn_from_rejection(bounds, trial.x, step.required)
            length = step.length if method.shrinks_below_step else np.inf
            region.on_reject(is_new and trial.carry.is_reachable, length)
            for share in method.backtracking:
                if self._try_fraction(best, step, share):
                    break
        elif evaluation.improved:
            self._accept(step, evaluation, trial)
            for times in method.extrapolation if evaluation.exceeds_prediction else ():
                if not self._try_fraction(best, step, times, evaluation.keep_active_set):
                    break
        else:
            self._keep_best(step, trial)

    def _accept(
        self, step: AnyStep, evaluation: StepEvaluation[AnyIterate], trial: AnyIterate
    ) -> None:
        self._set_best(trial, evaluation.keep_active_set)
        self.solution.converged = step.converged and not self._region.is_step_bounded(step.length)
        self._region.on_accept(
            evaluation.fraction * step.length, evaluation.reduction_ratio, evaluation.fraction < 1.0
        )

    def _keep_best(self, step: AnyStep, trial: AnyIterate) -> None:
        """React to a step that violates nothing but does not improve the candidate.

        Rows (scalar inequalities) that the quadratic program lacked are added. If none was lacking,
        the solve ends for an optimal step inside the trust region; otherwise the radius shrinks.

        Args:
            step: the step.
            trial: candidate after the step.
        """
        asked = self._method.missing_rows(trial) - step.required.keys()
        self._working_set.add(asked, trial.x)
        if step.converged and not asked and not self._region.is_step_bounded(step.length):
            self.solution.converged = True
            if trial.level < min(self._start_level, self.best.level + OPTIMUM_TOLERANCE):
                self._set_best(trial)
        elif not asked:
            self._region.on_no_improvement(step.length)

    def _try_fraction(
        self, begin: AnyIterate, step: AnyStep, share: float, keep_active_set: bool = False
    ) -> bool:
        """Accept the candidate after a fraction of a step if it improves and violates nothing.

        Args:
            begin: iterate from which the step starts.
            step: the step.
            share: the fraction, or the multiple, of the step.
            keep_active_set: True to keep the active rows for the next program.

        Returns:
            True if the candidate was accepted.
        """
        trial = self._method.evaluate_fraction(begin, self.best, step, share)
        if trial is None or not trial.carry.is_reachable:
            return False
        if self._method.active.has_violation(trial.carry, self.best.carry, step.required):
            return False
        self._set_best(trial, keep_active_set)
        return True

    def _set_best(self, trial: AnyIterate, keep_active_set: bool = False) -> None:
        self.best = trial
        self._working_set.on_new_best(keep_active_set)
