"""One drivable point's polish, in one page.

Each round forms the joint program of path and speed profile about the best carry so far, solves
its quadratic model in a box of trust, and times the path of the step anew: the judge is the
compiled timing, not the program. A path that is driven no better is refused, and the box shrinks;
one that violates geometry teaches its rows, as in `hybrid_opt.polishing.point`. A path that is
driven better and violates nothing is taken. The polish ends where the program's optimality
conditions hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.constraints.active import ActiveSet
from hybrid_opt.polishing.constraints.kind import Surroundings
from hybrid_opt.polishing.constraints.learned import Learned
from hybrid_opt.polishing.drivable.proposal import Proposal, Proposer, Reached
from hybrid_opt.polishing.drivable.timed import Goal, PathJudge, TimedPath
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.placed_carry import CarryReader
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.program import SmoothCell
from hybrid_opt.polishing.residuals import Residuals
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.workcell.records import Task


@dataclass(frozen=True)
class DriveStart:
    """A start and a goal.

    Attributes:
        x: (n_var,) feasible decision vector to start from.
        goal: what is wanted.
        radius: of the first box of trust, in halves of the decision variables' ranges.
    """

    x: Array
    goal: Goal
    radius: float


def is_polishable(task: Task) -> bool:
    """Whether drivable carries of a task can be polished: with the paper's allocation of forces,
    whose branches are what the program's rows are made of."""
    return task.allocation == "paper"


class DrivableSolver:
    """Solves for one evaluator's cell. A resource: one per process."""

    def __init__(
        self, evaluator: CandidateEvaluator, functions: PolishFunctions, settings: PolishSettings
    ) -> None:
        driver, task = evaluator.driver, evaluator.workcell.task
        if driver is None or functions.driven is None or not is_polishable(task):
            raise SettingsError(
                "the polish of drivable carries needs the time law 'optimal' and the paper's "
                "allocation of forces: switch the polish off"
            )
        grid = Grid(task)
        self._cell = SmoothCell(evaluator.workcell, functions, grid)
        self._task, self._settings, self._driven = task, settings, settings.drivable
        self._active = ActiveSet(Surroundings(evaluator, self._cell, settings))
        self._reader = CarryReader(evaluator, grid, functions.rows)
        self._proposer = Proposer(
            self._cell, functions.driven, driver.timer.intervals, settings.drivable
        )
        self.driver = driver
        self._half = self._cell.unit.half[: task.n_path]
        self.judge = PathJudge(driver.timer, task.force_limit)

    def solve(self, start: DriveStart) -> Solution:
        """Improve towards the goal."""
        goal, radius = start.goal, start.radius
        x = np.clip(start.x, self._task.lower, self._task.upper)
        timed = self.judge.timed(x[: self._task.n_path], goal)
        x = self._with_force(x, timed)
        learned = Learned(self._active, self._settings.stricter)
        best = Reached(timed, timed.squared, x, self._reader.read(x), timed.level(goal), learned)
        solution = Solution(x)
        if not np.isfinite(timed.duration):
            solution.message = "the start has no timing"
            return solution
        solution.usable = True
        while solution.rounds < self._driven.rounds and radius > self._driven.least_radius:
            solution.rounds += 1
            found = self._proposer.step(best, goal, radius, lenient=solution.rounds == 1)
            if found is None:
                radius *= 0.25
                continue
            solution.iterations += 1
            solution.residuals = found.residuals
            solution.rows = sum(isinstance(row, PlaceRow) for row in found.required)
            step = float(np.abs(found.d).max())
            if self._is_optimal(solution.residuals):
                solution.converged, solution.message = True, "stationary"
                break
            radius = self._try(best, goal, found, step, radius, solution)
        if not solution.message:
            short = radius <= self._driven.least_radius
            solution.message = "the box of trust is spent" if short else "out of rounds"
        solution.x = best.x
        return solution

    def _is_optimal(self, residuals: Residuals) -> bool:
        limit = self._driven
        return (
            residuals.stationarity <= limit.stationary
            and residuals.complementarity <= limit.stationary
            and residuals.feasibility <= limit.feasible
        )

    def _try(
        self,
        best: Reached,
        goal: Goal,
        found: Proposal,
        step: float,
        radius: float,
        solution: Solution,
    ) -> float:
        """Judge a proposal and go on from it where it is better; the next radius."""
        n = self._task.n_path
        x = best.x.copy()
        x[:n] = np.clip(x[:n] + self._half * found.d, self._task.lower[:n], self._task.upper[:n])
        timed = self.judge.timed(x[:n], goal)
        before, after = best.timed.level(goal), timed.level(goal)
        gain = 1.0 - after / before
        # What the timing rounds off may hide a small gain, but must not add up.
        tiny = found.gain <= self._driven.noise
        kept = after <= best.lowest * (1.0 + self._driven.noise)
        if gain < 0.1 * found.gain and not (tiny and kept):
            return 0.5 * min(radius, step) if np.isfinite(after) else 0.25 * min(radius, step)
        x = self._with_force(x, timed)
        carry = self._reader.read(x)
        violated = self._active.violated(carry, best.carry, found.required)
        if violated or not carry.is_followed:
            learned = best.learned.refuse(carry, best.carry, violated, found.required)
            return radius if learned and carry.is_followed else 0.5 * min(radius, step)
        best.timed, best.x, best.carry = timed, x, carry
        best.lowest = min(best.lowest, after)
        best.squared = found.squared if step <= self._driven.newton else timed.squared
        best.learned.move()
        if gain > 0.7 * found.gain and step > 0.9 * radius:
            return min(2.0 * radius, self._settings.trust.largest)
        return radius if gain > 0.3 * found.gain or tiny else 0.5 * radius

    def _with_force(self, x: Array, timed: TimedPath) -> Array:
        """The decision vector whose force limit is that of a timing."""
        return np.append(x[: self._task.n_path], timed.force)
