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

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import FEASIBLE, REASONS
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.attempt import Lost, solve_safely
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.plan import Attempt, aimed, points, widest_gap
from hybrid_opt.polishing.point import PolishSolver, Solution, SolveTask
from hybrid_opt.polishing.records import (
    PolishedFront,
    PolishOutcome,
    Status,
)
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.workcell.decision import initial_decision

TIMED_EVALUATIONS = 32
"""Candidates whose evaluation is timed, to express the polish in their unit."""

NO_SOLUTION = Solution(np.empty(0))


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
        run = _Run(self, archive, list(recorded), emit)
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

    def _evaluation_seconds(self, x: Array) -> float:
        """Time of one candidate evaluation; the initial trajectory's for an empty front."""
        sample = x if len(x) else initial_decision(self.evaluator.workcell.task)[None]
        batch = np.resize(sample, (TIMED_EVALUATIONS, self.evaluator.n_var))
        begin = time.perf_counter()
        self.evaluator.evaluate(batch)
        return (time.perf_counter() - begin) / len(batch)


def polish_front(
    evaluator: CandidateEvaluator,
    front_x: Array,
    settings: PolishSettings,
    rng: np.random.Generator,
) -> PolishedFront:
    """Polish one front; see `FrontPolisher`."""
    return FrontPolisher(evaluator, settings).polish(front_x, rng)


class _Run:
    """One polish in progress."""

    def __init__(
        self,
        polisher: FrontPolisher,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
    ) -> None:
        self._evaluator, self._settings = polisher.evaluator, polisher.settings
        self._solver = polisher.solver
        self._archive, self._recorded, self._emit = archive, recorded, emit
        self._tried: set[tuple[int | None, bytes]] = set()
        self._stalls = 0
        self.outcomes: list[PolishOutcome] = []

    def all(self, rng: np.random.Generator) -> None:
        """The front's points first; then ends, middle and gaps in turns, while attempts last."""
        self._do(points(self._archive, self._settings))
        while self._left() > 0:
            for _ in range(self._settings.front.turns_per_gap):
                self._turn((0, 1), rng)
                if self._stalls < self._settings.front.middle_stalls:
                    self._turn((None,), rng)
            self._do(self._gap())

    def _turn(self, objectives: tuple[int | None, ...], rng: np.random.Generator) -> None:
        """An attempt at each of some aims."""
        for objective in objectives:
            before = self._archive.best(objective)[1]
            attempt = aimed(self._archive, objective, self._tried, self._settings, rng)
            self._tried.add((objective, attempt.x.tobytes()))
            self._do([attempt])
            further = self._archive.best(objective)[1] < before - self._settings.front.progress
            if objective is None:
                self._stalls = 0 if further else self._stalls + 1

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

    def _left(self) -> int:
        return self._settings.points - len(self.outcomes)

    def _do(self, attempts: list[Attempt]) -> None:
        """Solve, judge and take in attempts; those on record are not solved again."""
        for attempt in attempts[: max(0, self._left())]:
            known = self._recorded.pop(0) if self._recorded else None
            if isinstance(known, PolishOutcome):
                self._take(attempt, known)
                continue
            begin = time.perf_counter()
            task = SolveTask(attempt.x, attempt.target, attempt.radius)
            outcome = self._judged(attempt, known or solve_safely(self._solver, task), begin)
            self._take(attempt, outcome)
            if known is None:
                self._emit(outcome)

    def _take(self, attempt: Attempt, outcome: PolishOutcome) -> None:
        self.outcomes.append(outcome)
        if outcome.status != "accepted":
            return
        if attempt.aim == "point":
            self._archive.replace(attempt.parent, outcome.x, outcome.objectives)
        else:
            self._archive.add(outcome.x, outcome.objectives)

    def _judged(self, attempt: Attempt, answer: Solution | Lost, begin: float) -> PolishOutcome:
        status, reason, objectives = self._verdict(attempt, answer)
        told = answer if isinstance(answer, Solution) else NO_SOLUTION
        return PolishOutcome(
            aim=attempt.aim,
            parent=attempt.parent,
            status=status,
            reason=reason,
            x=told.x if status == "accepted" else attempt.x,
            start=attempt.start,
            objectives=objectives,
            residuals=told.residuals,
            iterations=told.iterations,
            rounds=told.rounds,
            rows=told.rows,
            seconds=time.perf_counter() - begin,
        )

    def _verdict(self, attempt: Attempt, answer: Solution | Lost) -> tuple[Status, str, Array]:
        if isinstance(answer, Lost):
            return "failed", answer.reason, attempt.start
        if not answer.usable:
            return "failed", answer.message, attempt.start
        if np.array_equal(answer.x, attempt.x):
            return self._not_improved(answer, attempt)
        found = self._evaluator.certified(self._evaluator.evaluate(answer.x))
        reason = int(found.reason[0])
        if reason != FEASIBLE:
            return "rejected", REASONS[reason], attempt.start
        objectives = found.objectives[0]
        gain = attempt.start - objectives
        if attempt.aim == "point":
            if gain.min() < -self._settings.tolerance:
                return "rejected", "an objective became worse", attempt.start
            if gain.max() <= self._settings.tolerance:
                return self._not_improved(answer, attempt)
        elif self._archive.dominates(objectives):
            return "rejected", "dominated", attempt.start
        return "accepted", "", objectives

    def _not_improved(self, answer: Solution, attempt: Attempt) -> tuple[Status, str, Array]:
        if answer.converged or answer.residuals.stationarity <= self._settings.front.optimal:
            return "optimal", "not improved", attempt.start
        return "failed", f"not improved: {answer.message}", attempt.start
