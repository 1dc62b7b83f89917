"""The polish of a whole front: its points, its ends, its middle and its gaps.

Points of the front are improved first, each against its own start, so that neither objective gets
worse. From the improved ones the solver goes on to the ends of the front and to its balanced
middle, and then into the widest gaps between neighbours, along the normal of the chord. Every
answer is judged by the full evaluator and certified between the samples before it is believed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import FORCE_PAIRS
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.attempt import Lost
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.plan import Attempt, PlanState, aimed, points, widest_gap
from hybrid_opt.polishing.point import PolishSolver, Solution, SolveTask
from hybrid_opt.polishing.records import PolishedFront, PolishOutcome
from hybrid_opt.polishing.run import Polisher, PolishRun
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError


class FrontPolisher(Polisher):
    """Polishes fronts of one evaluator. A resource: keep it for several fronts."""

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        settings: PolishSettings,
        functions: PolishFunctions | None = None,
    ) -> None:
        """Load or build the smooth problem's functions.

        Raises:
            SettingsError: the evaluator's objectives are not both peak forces, planned or robust,
                or its pads are not two round ones that face one another.
            DualArmError: the functions cannot be built.
        """
        if not evaluator.workcell.has_facing_pads:
            raise SettingsError(
                "the polish knows the forces of two round pads that face one another, and no "
                "others: switch it off"
            )
        if evaluator.objective_names not in FORCE_PAIRS:
            named = " or ".join(" and ".join(pair) for pair in FORCE_PAIRS)
            raise SettingsError(
                f"the polish minimises {named}; the objectives are "
                f"{', '.join(evaluator.objective_names)}: switch the polish off for them"
            )
        super().__init__(evaluator, settings)
        known = functions or polish_functions(evaluator.compiled)
        self.solver = PolishSolver(evaluator, known, settings)

    def _run(
        self,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
    ) -> ForceRun:
        return ForceRun(self, archive, recorded, emit)


class ForceRun(PolishRun[Attempt]):
    """The polish of both peak forces."""

    def __init__(
        self,
        polisher: FrontPolisher,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
    ) -> None:
        super().__init__(polisher.evaluator, polisher.settings, archive, recorded, emit)
        self._solver = polisher.solver
        self._tried: set[tuple[int | None, bytes]] = set()
        self._stalls: dict[int | None, int] = {0: 0, 1: 0, None: 0}

    def _solution(self, attempt: Attempt) -> Solution:
        task = SolveTask(attempt.x, attempt.target, attempt.radius, attempt.wide)
        return self._solver.solve(task)

    def all(self, rng: np.random.Generator) -> None:
        """The front's points first; then ends, middle and gaps in turns, while attempts last."""
        self._do(points(self._archive, self._settings))
        while self._left() > 0:
            for _ in range(self._settings.front.turns_per_gap):
                self._turn((0, 1), rng)
                if self._stalls[None] < self._settings.front.middle_stalls:
                    self._turn((None,), rng)
            self._do(self._gap())

    def _turn(self, objectives: tuple[int | None, ...], rng: np.random.Generator) -> None:
        """An attempt at each of some aims, and whether it came further."""
        for objective in objectives:
            before, stalls = self._archive.best(objective)[1], self._stalls[objective]
            search = PlanState(objective, stalls > 0, self._tried)
            attempt = aimed(self._archive, search, self._settings, rng)
            self._tried.add((objective, attempt.x.tobytes()))
            self._do([attempt])
            further = self._archive.best(objective)[1] < before - self._settings.front.progress
            self._stalls[objective] = 0 if further else stalls + 1

    def _gap(self) -> list[Attempt]:
        """An attempt in the widest gap that was not tried, none where all are narrow."""
        tried = {outcome.start.tobytes() for outcome in self.outcomes if outcome.aim == "gap"}
        found = widest_gap(self._archive, tried, self._settings)
        if found is None:
            return []
        attempt, beyond = found
        half = (attempt.x + beyond) / 2.0
        feasible = self._evaluator.evaluate(half).feasible[0]
        return [replace(attempt, x=half) if feasible else attempt]


def polish_front(
    evaluator: CandidateEvaluator,
    front_x: Array,
    settings: PolishSettings,
    rng: np.random.Generator,
) -> PolishedFront:
    """Polish one front; see `FrontPolisher`."""
    return FrontPolisher(evaluator, settings).polish(front_x, rng)
