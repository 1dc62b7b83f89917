"""One point's polish, in one page.

Each round gathers the rows that are near the best candidate so far, solves the smooth program in
a box about it, and has the full model judge the step. What the step violates is learned: its rows
are added, or asked for more strictly, and where that is nothing new, the box is halved; the longest
part of the step that violates nothing and comes closer to the target is taken, if there is one. A
step that violates nothing and comes closer is taken as a whole, so that the answer is never worse
than the start. One that ends inside the box at an optimum ends the polish.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.polishing.compiled_interior import dense_method
from hybrid_opt.polishing.constraints.active import ActiveSet
from hybrid_opt.polishing.constraints.kind import Surroundings
from hybrid_opt.polishing.constraints.learned import Learned
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.ipopt import ipopt
from hybrid_opt.polishing.layout import Row
from hybrid_opt.polishing.placed_carry import CarryReader, PlacedCarry
from hybrid_opt.polishing.program import SmoothProgram
from hybrid_opt.polishing.residuals import UNKNOWN, Residuals
from hybrid_opt.polishing.robust_samples import RobustSamples
from hybrid_opt.polishing.settings import PolishSettings, TrustSettings
from hybrid_opt.polishing.smooth_cell import SmoothCell
from hybrid_opt.polishing.solvers import Answer
from hybrid_opt.polishing.targets import Target, level
from hybrid_opt.polishing.trust import TrustRegion
from symbolic.array import Array


@dataclass(frozen=True)
class SolveStart:
    """A start and a target.

    Attributes:
        x: (n_var,) feasible decision vector to start from.
        target: what to aim at.
        radius: of the first box of trust, in halves of the decision variables' ranges.
        wide: whether to look farther than the nearest optimum, with `SolveSettings.wide_barrier`.
        near: whether the start is nearly an optimum of the target, as a neighbour on the front is.
        brief: whether to end after `ProbeSettings.rounds`.
    """

    x: Array
    target: Target
    radius: float = TrustSettings().first
    wide: bool = False
    near: bool = False
    brief: bool = False


@dataclass
class Solution:
    """What a solve has come to; not yet believed.

    Attributes:
        x: (n_var,) the best candidate, the start where nothing was gained.
        message: the solver's status in the last round.
        converged: whether the last step ended inside the box at an optimum, by the solver's word.
        usable: whether the solver returned numbers in any round.
        residuals: at x, in the program of the last round.
        iterations, rounds: in total.
        rows: constraints at places of the path in the round of the residuals.
    """

    x: Array
    message: str = ""
    converged: bool = False
    usable: bool = False
    residuals: Residuals = UNKNOWN
    iterations: int = 0
    rounds: int = 0
    rows: int = 0

    def add(self, answer: Answer) -> None:
        """Count a round."""
        self.message, self.usable = answer.message, self.usable or answer.usable
        self.iterations += answer.iterations
        self.rounds += 1


@dataclass
class _Best:
    """The candidate that a solve has reached, and what its steps taught."""

    x: Array
    carry: PlacedCarry
    learned: Learned


class PolishSolver:
    """Solves for one evaluator's cell. A resource: one per process."""

    def __init__(
        self, evaluator: CandidateEvaluator, functions: PolishFunctions, settings: PolishSettings
    ) -> None:
        grid = Grid(evaluator.workcell.task)
        robust = None
        if evaluator.objective_names == ROBUST_OBJECTIVES:
            robust = RobustSamples(evaluator.workcell)
        rounding = settings.solve.rounding
        cache = evaluator.compiled.cache
        self._cell = SmoothCell(evaluator.workcell, functions, grid, robust, rounding, cache)
        self._settings = settings
        wide = replace(settings.solve, barrier=settings.solve.wide_barrier)
        self._wide = replace(settings, solve=wide)
        self._brief = replace(settings, rounds=settings.probe.rounds)
        near = settings.fill
        self._near = replace(
            settings,
            rounds=near.rounds,
            max_iterations=near.iterations,
            solve=replace(settings.solve, barrier=near.barrier, tolerance=near.tolerance),
        )
        self._solve = ipopt if settings.solve.solver == "ipopt" else dense_method(cache)
        self._active = ActiveSet(Surroundings(evaluator, self._cell, settings))
        self._reader = CarryReader(evaluator, grid, functions.rows, robust)

    def solve(self, start: SolveStart) -> Solution:
        """Improve towards the target."""
        x = np.clip(start.x, self._cell.task.lower, self._cell.task.upper)
        best = _Best(x, self._reader.read(x), self._nothing_learned())
        region = TrustRegion(self._settings.trust, start.radius)
        solution, settings = Solution(x), self._settings_for(start)
        first = level(start.target, best.carry.peak)
        while solution.rounds < settings.rounds and not region.is_spent:
            at, lenient = (best.x, region.radius), solution.rounds == 0
            required = best.learned.required(best.carry, start.target, at, lenient)
            program = SmoothProgram(
                self._cell, required, start.target, best.carry, best.x, region.radius
            )
            answer = self._solve(program, settings)
            solution.add(answer)
            if not answer.usable:
                region.lost()
                continue
            x = program.candidate(answer.z)
            step, carry = self._cell.unit.step(best.x, x), self._reader.read(x)
            violated = self._active.violated(carry, best.carry, required)
            if violated or not carry.is_followed:
                learned = best.learned.refuse(carry, best.carry, x, violated, required)
                region.refused(learned and carry.is_followed)
                if (part := self._part(best, x, required, start.target)) is not None:
                    self._move(best, *part)
            elif level(start.target, carry.peak) >= level(start.target, best.carry.peak):
                higher = self._active.forces.higher(carry, start.target) - required.keys()
                best.learned.ask(higher, x)
                if answer.converged and not higher and not region.holds(step):
                    solution.converged = True
                    worst = level(start.target, best.carry.peak) + settings.solve.settling
                    if level(start.target, carry.peak) < min(first, worst):
                        self._move(best, x, carry)
                    break
                if not higher:
                    region.barren(step)
            else:
                self._move(best, x, carry)
                solution.converged = answer.converged and not region.holds(step)
                region.taken(step)
                if solution.converged:
                    break
        solution.x = best.x
        if solution.usable:
            solution.residuals = program.residuals_at(best.x, best.carry)
        return solution

    def _nothing_learned(self) -> Learned:
        return Learned(self._active, self._settings.stricter, self._cell.unit.half)

    def _settings_for(self, start: SolveStart) -> PolishSettings:
        if start.near:
            return self._near
        if start.brief:
            return self._brief
        return self._wide if start.wide else self._settings

    def _part(
        self, best: _Best, x: Array, required: dict[Row, float], target: Target
    ) -> tuple[Array, PlacedCarry] | None:
        """The longest part of a refused step that violates nothing and comes closer to the target,
        as a candidate and its carry; None if no part does."""
        parts = self._settings.trust.parts
        for k in range(parts, 0, -1):
            part = best.x + k / (parts + 1) * (x - best.x)
            carry = self._reader.read(part)
            if (
                carry.is_followed
                and level(target, carry.peak) < level(target, best.carry.peak)
                and not self._active.violates(carry, best.carry, required)
            ):
                return part, carry
        return None

    def _move(self, best: _Best, x: Array, carry: PlacedCarry) -> None:
        """Go on from a better candidate."""
        best.x, best.carry = x, carry
        best.learned.move()
