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
from hybrid_opt.polishing.drivable.compiled_interior import interior_method
from hybrid_opt.polishing.drivable.memory import Memory
from hybrid_opt.polishing.drivable.proposal import Proposal, Proposer, Reached
from hybrid_opt.polishing.drivable.timed import Goal, PathJudge, TimedPath, force_range
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.placed_carry import CarryReader, PlacedCarry
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.residuals import Residuals
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.smooth_cell import SmoothCell
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Task

LENGTHENED = (2.0, 4.0, 8.0)
"""Times a step that brought more than it promised."""


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
    """Whether drivable carries of a task can be polished: those whose forces have a closed form."""
    return task.allocation != "joint"


class DrivableSolver:
    """Solves for one evaluator's cell. A resource: one per process.

    Attributes:
        evaluator, task, settings: of the cell, and of the polish.
        driver, judge: how carries and paths are timed.
        half: (n_path,) half ranges of the path's variables.
        active, reader, proposer: geometric rows, carries with their places, steps.
    """

    def __init__(
        self, evaluator: CandidateEvaluator, functions: PolishFunctions, settings: PolishSettings
    ) -> None:
        driver, task = evaluator.driver, evaluator.workcell.task
        if driver is None or functions.driven is None or not is_polishable(task):
            raise SettingsError(
                "the polish of drivable carries needs the time law 'optimal' and the allocation "
                "'soft-finger' or 'paper': switch the polish off"
            )
        grid = Grid(task)
        cell = SmoothCell(evaluator.workcell, functions, grid)
        self.evaluator, self.task, self.settings = evaluator, task, settings
        self.active = ActiveSet(Surroundings(evaluator, cell, settings))
        self.reader = CarryReader(evaluator, grid, functions.rows)
        self.proposer = Proposer(
            cell,
            functions.driven,
            driver.timer.intervals,
            settings.drivable,
            interior_method(evaluator.compiled.cache),
            driver.robust,
        )
        self.driver = driver
        self.half = cell.unit.half[: task.n_path]
        self.judge = PathJudge(driver, force_range(driver))

    def solve(self, start: DriveStart) -> Solution:
        """Improve towards the goal, in as many rounds as the settings allow."""
        climb = Climb(self, start.x, start.goal, start.radius)
        climb.finish()
        return climb.solution


class Climb:
    """One point's polish, which may be left and gone on with.

    Attributes:
        solution: what it has come to.
        last_gain: what the later half of the rounds that were asked for last took off the level.
    """

    def __init__(
        self, solver: DrivableSolver, x: Array, goal: Goal, radius: float | None = None
    ) -> None:
        """Time the start; arguments as in `DriveStart`, the radius that of the settings."""
        self._driven, self._task, self._half = solver.settings.drivable, solver.task, solver.half
        self._solver, self._goal = solver, goal
        self._radius = self._driven.first_radius if radius is None else radius
        x = np.clip(x, self._task.lower, self._task.upper)
        timed = solver.judge.timed(x[: self._task.n_path], self._goal)
        x = self._with_force(x, timed)
        memory = Memory(solver.active, solver.settings.stricter, solver.half)
        carry, level = solver.reader.read(x), timed.level(self._goal)
        self._best = Reached(timed, timed.squared, x, carry, level, memory)
        self.solution = Solution(x, usable=bool(np.isfinite(timed.duration)))
        self.last_gain = 0.0
        # A start, and what a step came to, may be nearer to obstacles than is wanted. To get away
        # from them must not cost what no step can bring.
        self._lenient = True

    @property
    def x(self) -> Array:
        """(n_var,) the best decision vector so far."""
        return self._best.x

    @property
    def level(self) -> float:
        """What the goal minimises."""
        return self._best.timed.level(self._goal)

    @property
    def ended(self) -> bool:
        """Whether more rounds bring nothing."""
        spent = self._radius <= self._driven.least_radius
        return self.solution.converged or spent or not self.solution.usable

    def go_on(self, rounds: int) -> None:
        """Some more rounds, fewer where it ends."""
        solution, before = self.solution, self.level
        for k in range(rounds):
            if self.ended:
                break
            before = self.level if k == rounds // 2 else before
            solution.rounds += 1
            self._round()
        solution.x = self._best.x
        self.last_gain = before - self.level
        if not solution.usable:
            solution.message = "the start has no timing"
        elif solution.converged:
            solution.message = "stationary"
        else:
            solution.message = "the box of trust is spent" if self.ended else "out of rounds"

    def finish(self) -> None:
        """The rounds of a point, and more of them while these bring much."""
        driven = self._driven
        self.go_on(driven.rounds)
        most = self.solution.rounds - driven.rounds + driven.most_rounds
        while not self.ended and self.last_gain > driven.worth * self.level:
            if self.solution.rounds >= most:
                break
            self.go_on(2 * driven.turn)

    def _round(self) -> None:
        solution, best = self.solution, self._best
        found = self._solver.proposer.step(best, self._goal, self._radius, self._lenient)
        if found is None:
            self._radius *= 0.25
            return
        solution.iterations += 1
        solution.residuals = found.residuals
        self._best.memory.press(found.pressing)
        solution.rows = sum(isinstance(row, PlaceRow) for row in found.required)
        if self._is_optimal(solution.residuals):
            solution.converged = True
        else:
            self._radius = self._try(found)

    def _is_optimal(self, residuals: Residuals) -> bool:
        limit = self._driven
        return (
            residuals.stationarity <= limit.stationary
            and residuals.complementarity <= limit.stationary
            and residuals.feasibility <= limit.feasible
        )

    def _try(self, found: Proposal) -> float:
        """Judge a proposal and go on from it where it is better; the next radius."""
        best, driven, radius = self._best, self._driven, self._radius
        step = float(np.abs(found.d).max())
        start, before = best.x, self.level
        timed = self._timed(start, found.d)
        after = timed.level(self._goal)
        gain = 1.0 - after / before
        # What the timing rounds off may hide a small gain, but must not add up.
        tiny = found.gain <= driven.noise
        kept = after <= best.lowest * (1.0 + driven.noise)
        self._lenient = gain < 0.1 * found.gain and not (tiny and kept)
        if self._lenient:
            return 0.5 * min(radius, step) if np.isfinite(after) else 0.25 * min(radius, step)
        x = self._with_force(self._moved(start, found.d), timed)
        carry = self._solver.reader.read(x)
        violated = self._solver.active.violated(carry, best.carry, found.required)
        if violated or not carry.is_followed:
            path = x[: self._task.n_path]
            learned = best.memory.refuse(carry, best.carry, path, violated, found.required)
            return radius if learned and carry.is_followed else 0.5 * min(radius, step)
        squared = found.squared if step <= driven.newton else timed.squared
        self._take(x, timed, carry, squared)
        if gain > found.gain and not tiny:
            self._lengthen(start, found)
        best.memory.move(step <= driven.newton)
        if gain > 0.7 * found.gain and step > 0.9 * radius:
            return min(2.0 * radius, self._solver.settings.trust.largest)
        return radius if gain > 0.3 * found.gain or tiny else 0.5 * radius

    def _lengthen(self, start: Array, found: Proposal) -> None:
        """Go farther along a step that brought more than it promised, while that brings more:
        judging costs a tenth of a round."""
        for share in LENGTHENED:
            timed = self._timed(start, share * found.d)
            if timed.level(self._goal) >= self.level * (1.0 - self._driven.noise):
                return
            x = self._with_force(self._moved(start, share * found.d), timed)
            carry = self._solver.reader.read(x)
            asked = self._solver.active.violated(carry, self._best.carry, found.required)
            if asked or not carry.is_followed:
                return
            self._take(x, timed, carry, timed.squared)

    def _take(self, x: Array, timed: TimedPath, carry: PlacedCarry, squared: Array) -> None:
        best = self._best
        best.x, best.timed, best.carry, best.squared = x, timed, carry, squared
        best.lowest = min(best.lowest, self.level)

    def _moved(self, x: Array, d: Array) -> Array:
        """(n_path,) the path after a scaled step."""
        n = len(d)
        return np.clip(x[:n] + self._half * d, self._task.lower[:n], self._task.upper[:n])

    def _timed(self, x: Array, d: Array) -> TimedPath:
        return self._solver.judge.timed(self._moved(x, d), self._goal)

    def _with_force(self, x: Array, timed: TimedPath) -> Array:
        """The decision vector whose force limit is that of a timing."""
        return np.append(x[: self._task.n_path], timed.force)
