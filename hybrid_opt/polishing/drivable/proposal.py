"""One step of a drivable point's polish: the joint program about an iterate, and its answer.

First a program without the Lagrangian's curvature finds multipliers: they owe nothing to earlier
rounds, which may have been elsewhere. With them the quadratic model is formed and solved, and where
geometric rows bend along the step, it is corrected for that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.drivable import quadratic
from hybrid_opt.polishing.drivable.bordered import BorderedMatrix
from hybrid_opt.polishing.drivable.compiled_interior import Method
from hybrid_opt.polishing.drivable.functions import DrivenFunctions
from hybrid_opt.polishing.drivable.interior import QuadraticProgram
from hybrid_opt.polishing.drivable.intervals import IntervalGrid, IntervalValues
from hybrid_opt.polishing.drivable.memory import Memory
from hybrid_opt.polishing.drivable.program import Iterate, JointProgram, Linear, Multipliers
from hybrid_opt.polishing.drivable.timed import Goal, TimedPath
from hybrid_opt.polishing.layout import PlaceRow, Row
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.program import place_values
from hybrid_opt.polishing.residuals import Residuals
from hybrid_opt.polishing.settings import DrivableSettings
from hybrid_opt.polishing.smooth_cell import SmoothCell
from symbolic.array import Array

LEAST_SQUARED, LARGEST_SQUARED = 0.9, 3.0
"""How far a squared speed may fall and rise in a step, as shares of it."""


@dataclass
class Reached:
    """What a solve has reached."""

    timed: TimedPath
    squared: Array
    x: Array
    carry: PlacedCarry
    lowest: float
    memory: Memory


@dataclass(frozen=True)
class _Found:
    """A quadratic program's answer, and the rows that it was given."""

    step: quadratic.Step
    linear: Linear

    def active(self, negligible: float) -> NDArray[np.bool_]:
        """(rows but the duration's,) which ones have a multiplier."""
        return np.asarray(self.step.rows[: len(self.linear.b)] > negligible)

    def pressing(self, program: JointProgram, negligible: float) -> list[PlaceRow]:
        """Geometric rows with a multiplier."""
        first = len(self.linear.point)
        has = self.active(negligible)[first : first + len(program.place_rows)]
        return [row for row, own in zip(program.place_rows, has, strict=True) if own]

    def multipliers(self, program: JointProgram, negligible: float) -> Multipliers:
        """Of the unscaled rows; negligible ones of the timing are none."""
        linear, m = self.linear, len(self.linear.point)
        rows = self.step.rows[: len(linear.b)] / linear.scale
        timing = np.zeros(program.rows.shape)
        timing[linear.point, linear.kind] = np.where(self.active(negligible)[:m], rows[:m], 0.0)
        duration = 0.0 if linear.whole is None else float(self.step.rows[-1])
        return Multipliers(timing, rows[m:], duration)


@dataclass(frozen=True)
class Proposal:
    """A step of a program's path, with the squared speeds, and what it promises."""

    d: Array
    squared: Array
    gain: float
    required: dict[Row, float]
    pressing: list[PlaceRow]
    residuals: Residuals


class Proposer:
    """Forms and solves programs of one evaluator's cell."""

    def __init__(
        self,
        cell: SmoothCell,
        functions: DrivenFunctions,
        intervals: int,
        settings: DrivableSettings,
        method: Method,
        robust: bool = False,
    ) -> None:
        """Prepare programs.

        Args:
            intervals: pieces of constant u''.
            method: solves quadratic programs.
            robust: whether robust forces are limited.
        """
        self._cell, self._functions = cell, functions
        self._task, self._driven = cell.task, settings
        self._intervals = IntervalGrid(cell.workcell, intervals, robust)
        self._half = cell.unit.half[: cell.task.n_path]
        self._method = method

    def step(self, best: Reached, goal: Goal, radius: float, lenient: bool) -> Proposal | None:
        """A step within the box; None where there is none."""
        program, required = self._program(best, goal, radius, lenient)
        box = self._box(best, goal, radius)
        chosen = program.near()
        steady = np.zeros(program.n)
        steady[: program.n_path] = self._driven.steadiness
        plain = program.curvature(None).raised(steady)
        first = self._step(program, chosen, (plain, np.zeros(program.n)), box)
        if first is None:
            return None
        H = program.curvature(first.multipliers(program, self._driven.negligible))
        active = first.active(self._driven.negligible)
        model = quadratic.convex(H, first.linear.A.of(active), first.linear.b[active])
        second = self._step(program, chosen, model, box)
        if second is None:
            return None
        residuals = min(
            (self._residuals(program, best, found) for found in (first, second)),
            key=lambda known: known.stationarity + known.complementarity,
        )
        bent = np.zeros(len(program.geometry))
        for _ in range(self._driven.corrections):
            change = program.geometry_after(second.step.d) - bent
            if np.abs(change).max(initial=0.0) <= self._driven.bend:
                break
            bent = bent + change
            corrected = self._step(program, chosen, model, box, bent)
            if corrected is None:
                break
            second = corrected
        d = second.step.d
        squared = best.squared.copy()
        squared[1:-1] *= 1.0 + d[program.speeds]
        gain = max(program.gain(d), 0.0)
        pressing = second.pressing(program, self._driven.negligible)
        return Proposal(d[: program.n_path], squared, gain, required, pressing, residuals)

    def _step(
        self,
        program: JointProgram,
        chosen: NDArray[np.bool_],
        model: tuple[BorderedMatrix, Array],
        box: tuple[Array, Array],
        bent: Array | float = 0.0,
    ) -> _Found | None:
        """Solve a quadratic model; rows that its answer violates are added. `chosen` grows."""
        g = program.gradient() + model[1]
        for left in reversed(range(self._driven.row_rounds)):
            linear = program.linear(chosen, bent)
            asked = QuadraticProgram(
                model[0], g, linear.A, linear.b, *box, linear.whole, linear.most
            )
            step = quadratic.solve(asked, self._method)
            if not step.solved:
                # What the box has no room for is asked for as far as it is kept now.
                most = max(linear.most, 0.0)
                relaxed = replace(asked, b=np.maximum(linear.b, 0.0), most=most)
                step = quadratic.solve(relaxed, self._method)
            if not step.solved:
                return None
            fresh = (program.predicted(step.d) > self._driven.row_tolerance) & ~chosen
            if not fresh.any():
                break
            chosen |= fresh
            if not left:
                chosen &= ~fresh
        return _Found(step, linear)

    def _program(
        self, best: Reached, goal: Goal, radius: float, lenient: bool
    ) -> tuple[JointProgram, dict[Row, float]]:
        path = best.x[: self._task.n_path]
        required = best.memory.required(best.carry, path, radius, lenient)
        listed = sorted(
            (row for row in required if isinstance(row, PlaceRow)),
            key=lambda row: (repr(row.constraint), row.place),
        )
        values = IntervalValues.at(
            self._intervals, self._functions, best.x, best.squared, best.timed.joints
        )
        duration = goal.limit if goal.aim == "force" else None
        program = JointProgram(
            self._intervals,
            Iterate(best.x, best.squared, best.timed.force, duration),
            values,
            self._half,
            (
                tuple(listed),
                place_values(self._cell, tuple(listed), best.carry),
                np.array([required[row] for row in listed]),
            ),
        )
        return program, required

    def _box(self, best: Reached, goal: Goal, radius: float) -> tuple[Array, Array]:
        """Bounds of a step."""
        n, xi = self._task.n_path, best.x[: self._task.n_path]
        low = [np.maximum((self._task.lower[:n] - xi) / self._half, -radius)]
        high = [np.minimum((self._task.upper[:n] - xi) / self._half, radius)]
        if goal.aim == "force":
            share = np.array(self._task.force_limit) / best.timed.force - 1.0
            low.append(np.minimum(share[:1], 0.0))
            high.append(np.maximum(share[1:], 0.0))
        speeds = np.ones(self._intervals.intervals - 1)
        low, high = [*low, -LEAST_SQUARED * speeds], [*high, LARGEST_SQUARED * speeds]
        return np.concatenate(low), np.concatenate(high)

    def _residuals(self, program: JointProgram, best: Reached, found: _Found) -> Residuals:
        """Of the program at its iterate, with the multipliers of a step."""
        bounds = self._own_bounds(best, found.step)
        return program.residuals(bounds, found.linear, found.step.rows)

    def _own_bounds(self, best: Reached, step: quadratic.Step) -> Array:
        """Multipliers of the variables' own bounds: those of the box of trust do not count."""
        n = self._task.n_path
        x, edge = best.x[:n], 1e-6 * self._half
        own = np.zeros(len(step.bounds))
        at_low = (step.bounds[:n] < 0.0) & (
            x + self._half * step.d[:n] < self._task.lower[:n] + edge
        )
        at_high = (step.bounds[:n] > 0.0) & (
            x + self._half * step.d[:n] > self._task.upper[:n] - edge
        )
        own[:n] = np.where(at_low | at_high, step.bounds[:n], 0.0)
        return own
