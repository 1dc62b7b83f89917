"""The polish of a whole front: its points, its ends, its middle and its gaps.

Points of the front are improved first, each against its own start, so that neither objective gets
worse. From the improved ones the solver goes on to the ends of the front and to its balanced
middle, and then into the widest gaps between neighbours, along the normal of the chord. Every
answer is judged by the full evaluator and certified between the samples before it is believed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.attempt import Lost
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.plan import Attempt, PlanState, aimed, points, widest_gap
from hybrid_opt.polishing.point import PolishSolver, Solution, SolveTask
from hybrid_opt.polishing.records import PolishedFront, PolishOutcome
from hybrid_opt.polishing.run import PolishRun
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.workcell.decision import initial_decision

TIMED_EVALUATIONS = 32
"""Candidates whose evaluation is timed, to express the polish in their unit."""


class FrontPolisher:
    """Polishes fronts of one evaluator. A resource: keep it for several fronts."""

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        settings: PolishSettings,
        functions: PolishFunctions | None = None,
    ) -> None:
        """Load or build the smooth problem's functions.

        Raises:
            SettingsError: the evaluator's objectives are not both peak forces.
            DualArmError: the functions cannot be built.
        """
        if evaluator.objective_names != PAPER_OBJECTIVES:
            raise SettingsError(
                f"the polish minimises {' and '.join(PAPER_OBJECTIVES)}; the objectives are "
                f"{', '.join(evaluator.objective_names)}: switch the polish off for them"
            )
        self.evaluator, self.settings = evaluator, settings
        self.solver = PolishSolver(
            evaluator, functions or polish_functions(evaluator.compiled), settings
        )

    def polish(
        self,
        front_x: Array,
        rng: np.random.Generator,
        recorded: Sequence[PolishOutcome | Lost] = (),
        emit: Callable[[PolishOutcome], None] = lambda outcome: None,
    ) -> PolishedFront:
        """Polish a front.

        Args:
            front_x: (k, n_var) decision vectors; k may be 0.
            rng: spreads the starts of attempts at the balanced middle.
            recorded: outcomes of an earlier, interrupted polish of the same front, not repeated;
                `Lost` for an attempt that ended its process.
            emit: takes each new outcome.
        """
        begin = time.perf_counter()
        x = np.asarray(front_x, dtype=float).reshape(-1, self.evaluator.n_var)
        unit = self._evaluation_seconds(x)
        found = self.evaluator.certified(self.evaluator.evaluate(x))
        feasible = np.flatnonzero(found.feasible)
        archive = GrowingFront(x[feasible], found.objectives[feasible], feasible.tolist())
        run = self._run(archive, list(recorded), emit)
        if len(feasible) and self.settings.points:
            run.all(rng)
        rows = archive.rows() if len(feasible) else []
        return PolishedFront(
            x=np.array([archive.x[k] for k in rows]).reshape(-1, self.evaluator.n_var),
            objectives=np.array([archive.objectives[k] for k in rows]).reshape(-1, 2),
            parent=np.array([archive.parent[k] for k in rows], dtype=np.int64),
            polished=np.array([archive.polished[k] for k in rows], dtype=bool),
            outcomes=tuple(run.outcomes),
            seconds=time.perf_counter()
            - begin
            + sum(o.seconds for o in recorded if isinstance(o, PolishOutcome)),
            evaluation_seconds=unit,
        )

    def _run(
        self,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
    ) -> PolishRun[Any]:
        """A polish of one front, about to begin."""
        return ForceRun(self, archive, recorded, emit)

    def _evaluation_seconds(self, x: Array) -> float:
        """Time of one candidate evaluation; the initial trajectory's for an empty front."""
        sample = x if len(x) else initial_decision(self.evaluator.workcell.task)[None]
        batch = np.resize(sample, (TIMED_EVALUATIONS, self.evaluator.n_var))
        begin = time.perf_counter()
        self.evaluator.evaluate(batch)
        return (time.perf_counter() - begin) / len(batch)


class ForceRun(PolishRun[Attempt]):
    """The polish of the paper's two objectives."""

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
