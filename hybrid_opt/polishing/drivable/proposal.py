"""One step of a drivable point's polish: the joint program about an iterate, and its answer.

First a program without the Lagrangian's curvature finds multipliers: they owe nothing to earlier
rounds, which may have been elsewhere. With them the quadratic model is formed and solved, and where
geometric rows bend along the step, it is corrected for that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.constraints.learned import Learned
from hybrid_opt.polishing.drivable import quadratic
from hybrid_opt.polishing.drivable.functions import DrivenFunctions
from hybrid_opt.polishing.drivable.intervals import IntervalGrid, IntervalValues
from hybrid_opt.polishing.drivable.program import Iterate, JointProgram, Linear, Multipliers
from hybrid_opt.polishing.drivable.timed import Goal, TimedPath
from hybrid_opt.polishing.layout import PlaceRow, Row
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.program import SmoothCell, place_values
from hybrid_opt.polishing.residuals import Residuals
from hybrid_opt.polishing.settings import DrivableSettings
from hybrid_opt.polishing.targets import pascoletti_serafini
from symbolic.array import Array

ANY_TARGET = pascoletti_serafini(np.zeros(2), np.ones(2))
"""Geometric constraints do not look at what is aimed at."""

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
    learned: Learned


@dataclass(frozen=True)
class Proposal:
    """A step of a program and what it promises."""

    d: Array
    squared: Array
    gain: float
    required: dict[Row, float]
    residuals: Residuals


class Proposer:
    """Forms and solves programs of one evaluator's cell."""

    def __init__(
        self,
        cell: SmoothCell,
        functions: DrivenFunctions,
        intervals: int,
        settings: DrivableSettings,
    ) -> None:
        """intervals: pieces of constant u''."""
        self._cell, self._functions = cell, functions
        self._task, self._driven = cell.task, settings
        self._intervals = IntervalGrid(cell.workcell, intervals)
        self._half = cell.unit.half[: cell.task.n_path]

    def step(self, best: Reached, goal: Goal, radius: float, lenient: bool) -> Proposal | None:
        """A step within the box; None where there is none."""
        program, required = self._program(best, goal, lenient)
        low, high = self._box(best, goal, radius)
        chosen = program.near()
        n = program.n_path
        plain = program.curvature(None)
        plain[:n, :n] += self._driven.steadiness * np.eye(n)
        first = self._step(program, chosen, (plain, np.zeros(program.n)), low, high)
        if first is None:
            return None
        multipliers = first[1]
        H = program.curvature(multipliers)
        linear, scales = program.linear(chosen)
        active = self._named(program, chosen, multipliers, scales) > 0.0
        model = quadratic.convex(H, linear.A[active], linear.b[active], n)
        second = self._step(program, chosen, model, low, high)
        if second is None:
            return None
        residuals = min(
            (self._residuals(program, best, found) for found in (first, second)),
            key=lambda known: known.stationarity + known.complementarity,
        )
        bent = np.zeros(len(program.geometry))
        for _ in range(self._driven.corrections):
            change = program.geometry_after(second[0].d) - bent
            if np.abs(change).max(initial=0.0) <= self._driven.bend:
                break
            bent = bent + change
            corrected = self._step(program, chosen, model, low, high, bent)
            if corrected is None:
                break
            second = corrected
        step = second[0]
        d = step.d
        squared = best.squared.copy()
        squared[1:-1] *= 1.0 + d[program.n_path : -1]
        return Proposal(d, squared, max(program.gain(d), 0.0), required, residuals)

    def _step(
        self,
        program: JointProgram,
        chosen: NDArray[np.bool_],
        model: tuple[Array, Array],
        low: Array,
        high: Array,
        bent: Array | float = 0.0,
    ) -> tuple[quadratic.Step, Multipliers, Linear] | None:
        """Solve a quadratic model; rows that its answer violates are added. `chosen` grows."""
        for left in reversed(range(self._driven.row_rounds)):
            linear, scales = program.linear(chosen, bent)
            H, g = model[0], program.gradient() + model[1]
            step = quadratic.solve(H, g, linear.A, linear.b, low, high)
            if not step.solved:
                # What the box has no room for is asked for as far as it is kept now.
                b = np.maximum(linear.b, 0.0)
                step = quadratic.solve(H, g, linear.A, b, low, high)
            if not step.solved:
                return None
            fresh = (program.predicted(step.d) > self._driven.row_tolerance) & ~chosen
            if not fresh.any():
                break
            chosen |= fresh
            if not left:
                chosen &= ~fresh
        point, kind = np.nonzero(chosen)
        timing = np.zeros(chosen.shape)
        m, unscaled = len(point), step.rows / scales
        timing[point, kind] = np.where(
            unscaled[:m] * scales[:m] > self._driven.negligible, unscaled[:m], 0.0
        )
        geometry = dict(
            zip(program.place_rows, unscaled[m : m + len(program.place_rows)].tolist(), strict=True)
        )
        duration = float(unscaled[-1]) if program.has_duration else 0.0
        return step, Multipliers(timing, geometry, duration), linear

    def _named(
        self,
        program: JointProgram,
        chosen: NDArray[np.bool_],
        multipliers: Multipliers,
        scales: Array,
    ) -> Array:
        """(rows,) the last multipliers in the order of a program's rows."""
        point, kind = np.nonzero(chosen)
        geometry = [multipliers.geometry.get(row, 0.0) for row in program.place_rows]
        values = np.zeros(len(scales))
        values[: len(point)] = multipliers.timing[point, kind] * scales[: len(point)]
        values[len(point) : len(point) + len(geometry)] = geometry
        if program.has_duration:
            values[-1] = multipliers.duration
        return np.where(values > self._driven.negligible, values, 0.0)

    def _program(
        self, best: Reached, goal: Goal, lenient: bool
    ) -> tuple[JointProgram, dict[Row, float]]:
        required = best.learned.required(best.carry, ANY_TARGET, lenient)
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
        n = self._task.n_path
        low = np.full(n + self._intervals.intervals, -LEAST_SQUARED)
        high = np.full(len(low), LARGEST_SQUARED)
        xi = best.x[:n]
        low[:n] = np.maximum((self._task.lower[:n] - xi) / self._half, -radius)
        high[:n] = np.minimum((self._task.upper[:n] - xi) / self._half, radius)
        least, largest = self._task.force_limit
        force = best.timed.force
        low[-1], high[-1] = (
            (0.0, 0.0)
            if goal.aim == "duration"
            else (min(least / force - 1.0, 0.0), max(largest / force - 1.0, 0.0))
        )
        return low, high

    def _residuals(
        self,
        program: JointProgram,
        best: Reached,
        found: tuple[quadratic.Step, Multipliers, Linear],
    ) -> Residuals:
        """Of the program at its iterate, with the multipliers of a step."""
        step, _, linear = found
        return program.residuals(self._own_bounds(best, step), linear, step.rows)

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
