"""The polish of a whole front: its points, its ends, its middle and its gaps.

Points of the front are improved first, each against its own start, so that neither objective gets
worse. From the improved ones the solver goes on to the ends of the front and to its balanced
middle, and then into the widest gaps between neighbours, along the normal of the chord. Every
answer is judged by the full evaluator and certified between the samples before it is believed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hybrid_opt import metrics
from hybrid_opt.evaluation import FEASIBLE, REASONS, CandidateEvaluator
from hybrid_opt.objectives import PAPER_OBJECTIVES
from hybrid_opt.polish.functions import PolishFunctions, polish_functions
from hybrid_opt.polish.pool import Lost, SolverPool
from hybrid_opt.polish.records import (
    UNKNOWN,
    Aim,
    PolishedFront,
    PolishOutcome,
    PolishSettings,
    Status,
)
from hybrid_opt.polish.solver import PolishSolver, Solution, SolveTask
from hybrid_opt.polish.targets import (
    Target,
    balance,
    epsilon_constraint,
    extreme,
    pascoletti_serafini,
)
from symbolic.errors import SettingsError
from symbolic.workcell import Array

LEAST_SPAN = 2e-3
"""Least scale of an objective: of a front of one point, or one that is nearly flat."""

TIMED_EVALUATIONS = 32
"""Candidates whose evaluation is timed, to express the polish in their unit."""

OPTIMAL_STATIONARITY = 1e-3
"""Residual below which a point that could not be improved counts as optimal."""

LEAST_GAP = 0.02
"""Gaps narrower than this are left, in units of the front's extent."""

NO_SOLUTION = Solution(np.empty(0), "", False, False, UNKNOWN, 0, 0, 0)


@dataclass(frozen=True)
class _Attempt:
    aim: Aim
    parent: int
    x: Array
    start: Array
    target: Target


class _Archive:
    """The points that stand so far: rows of the given front, and new ones."""

    def __init__(self, x: Array, objectives: Array, parent: list[int]) -> None:
        self.x, self.objectives = list(x), list(objectives)
        self.parent, self.polished = list(parent), [False] * len(x)

    def replace(self, parent: int, x: Array, objectives: Array) -> None:
        index = self.parent.index(parent)
        self.x[index], self.objectives[index], self.polished[index] = x, objectives, True

    def dominates(self, objectives: Array) -> bool:
        """Whether a point is as good in both objectives."""
        return bool(np.any(np.all(np.array(self.objectives) <= objectives, axis=1)))

    def add(self, x: Array, objectives: Array) -> None:
        self.x.append(x)
        self.objectives.append(objectives)
        self.parent.append(-1)
        self.polished.append(True)

    def rows(self) -> list[int]:
        """Indices of the non-dominated points by increasing first objective."""
        values = np.array(self.objectives)
        kept = np.flatnonzero(metrics.non_dominated(values))
        return [int(k) for k in kept[np.lexsort(values[kept].T[::-1])]]

    def span(self) -> Array:
        """(2,) the scale of each objective."""
        values = np.array(self.objectives)[self.rows()]
        return np.asarray(np.maximum(np.ptp(values, axis=0), LEAST_SPAN))


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
        self._solver = PolishSolver(
            evaluator, functions or polish_functions(evaluator.workcell), settings
        )

    def polish(
        self,
        front_x: Array,
        rng: np.random.Generator,
        jobs: int = 1,
        recorded: Sequence[PolishOutcome] = (),
        emit: Callable[[PolishOutcome], None] = lambda outcome: None,
    ) -> PolishedFront:
        """Polish a front.

        Args:
            front_x: (k, n_var) decision vectors; k may be 0.
            rng: spreads the starts of attempts at the balanced middle.
            jobs: child processes; has no influence on the result.
            recorded: outcomes of an earlier, interrupted polish of the same front, not repeated.
            emit: takes each new outcome.
        """
        begin = time.perf_counter()
        x = np.asarray(front_x, dtype=float).reshape(-1, self.evaluator.n_var)
        unit = self._evaluation_seconds(x)
        found = self.evaluator.certified(self.evaluator.evaluate(x))
        feasible = np.flatnonzero(found.feasible)
        archive = _Archive(x[feasible], found.objectives[feasible], feasible.tolist())
        run = _Run(self, archive, list(recorded), emit)
        if len(feasible) and self.settings.points:
            with SolverPool(self._solver, jobs, self.settings.max_seconds) as run.pool:
                run.all(rng)
        rows = archive.rows() if len(feasible) else []
        return PolishedFront(
            x=np.array([archive.x[k] for k in rows]).reshape(-1, self.evaluator.n_var),
            objectives=np.array([archive.objectives[k] for k in rows]).reshape(-1, 2),
            parent=np.array([archive.parent[k] for k in rows], dtype=np.int64),
            polished=np.array([archive.polished[k] for k in rows], dtype=bool),
            outcomes=tuple(run.outcomes),
            seconds=time.perf_counter() - begin + sum(o.seconds for o in recorded),
            evaluation_seconds=unit,
        )

    def _evaluation_seconds(self, x: Array) -> float:
        """Time of one candidate evaluation; the initial trajectory's for an empty front."""
        sample = x if len(x) else self.evaluator.workcell.task.initial.reshape(1, -1)
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

    pool: SolverPool

    def __init__(
        self,
        polisher: FrontPolisher,
        archive: _Archive,
        recorded: list[PolishOutcome],
        emit: Callable[[PolishOutcome], None],
    ) -> None:
        self._evaluator, self._settings = polisher.evaluator, polisher.settings
        self._archive, self._recorded, self._emit = archive, recorded, emit
        self.outcomes: list[PolishOutcome] = []

    def all(self, rng: np.random.Generator) -> None:
        """The front's points first; then ends, middle and gaps in turns, while attempts last."""
        self._do(self._points())
        while self._left() > 0:
            self._do([self._aimed("extreme", objective, rng) for objective in (0, 1)])
            self._do([self._aimed("balance", None, rng)])
            self._do(self._gaps()[:1])

    def _left(self) -> int:
        return self._settings.points - len(self.outcomes)

    def _points(self) -> list[_Attempt]:
        """Evenly spread points of the front, the balanced one among them."""
        archive, rows = self._archive, self._archive.rows()
        count = min(len(rows), (self._settings.points + 2) // 3)
        chosen = {rows[int(k)] for k in np.round(np.linspace(0, len(rows) - 1, count))}
        middle = self._balanced()
        if middle not in chosen and count > 2:
            inner = sorted(chosen - {rows[0], rows[-1]}, key=rows.index)
            chosen.remove(min(inner, key=lambda k: abs(rows.index(k) - rows.index(middle))))
            chosen.add(middle)
        span = archive.span()
        attempts = []
        for k in sorted(chosen, key=rows.index):
            start = archive.objectives[k]
            if self._settings.method == "epsilon":
                objective = int(rows.index(k) >= len(rows) / 2.0)
                target = epsilon_constraint(start, span, objective)
            else:
                target = pascoletti_serafini(start, span)
            attempts.append(_Attempt("point", archive.parent[k], archive.x[k], start, target))
        return attempts

    def _aimed(self, aim: Aim, objective: int | None, rng: np.random.Generator) -> _Attempt:
        """An attempt at an end of the front or at its balanced middle.

        It goes on from the best point. Where the last attempt did not get further from there, it
        starts from any point of the front: another region may lead further down.
        """
        archive, rows = self._archive, self._archive.rows()
        wanted = np.ones(2) if objective is None else np.eye(2)[objective]
        k = min(rows, key=lambda k: float(wanted @ archive.objectives[k]))
        last = [o for o in self.outcomes if o.aim == aim][-1 if objective is None else -2 :]
        if last and last[objective or 0].status != "accepted":
            k = rows[int(rng.integers(len(rows)))]
        start, span = archive.objectives[k], np.full(2, LEAST_SPAN)
        target = balance(start, span) if objective is None else extreme(start, span, objective)
        return _Attempt(aim, -1, archive.x[k], start, target)

    def _balanced(self) -> int:
        return min(self._archive.rows(), key=lambda k: float(np.sum(self._archive.objectives[k])))

    def _gaps(self) -> list[_Attempt]:
        """The widest gaps between neighbours, as many as attempts are left, at most all."""
        archive, rows, span = self._archive, self._archive.rows(), self._archive.span()
        values = np.array([archive.objectives[k] for k in rows]) / span
        widths = np.linalg.norm(np.diff(values, axis=0), axis=1)
        tried = {outcome.start.tobytes() for outcome in self.outcomes if outcome.aim == "gap"}
        attempts: list[_Attempt] = []
        for gap in np.argsort(-widths, kind="stable").tolist():
            first, second = rows[gap], rows[gap + 1]
            start = (archive.objectives[first] + archive.objectives[second]) / 2.0
            if start.tobytes() in tried or widths[gap] <= LEAST_GAP:
                continue
            chord = np.abs(values[gap + 1] - values[gap])
            normal = chord[::-1] / np.linalg.norm(chord)
            target = pascoletti_serafini(start, span, normal)
            attempts.append(_Attempt("gap", -1, self._between(first, second), start, target))
            if len(attempts) >= max(1, self._left() // 2):
                break
        return attempts

    def _between(self, first: int, second: int) -> Array:
        """Half way between two decision vectors if that is feasible, otherwise the first."""
        half: Array = (self._archive.x[first] + self._archive.x[second]) / 2.0
        return half if self._evaluator.evaluate(half).feasible[0] else self._archive.x[first]

    def _do(self, attempts: list[_Attempt]) -> None:
        """Solve, judge and take in attempts; those on record are not solved again."""
        attempts = attempts[: max(0, self._left())]
        known = self._recorded[: len(attempts)]
        del self._recorded[: len(attempts)]
        for attempt, outcome in zip(attempts, known, strict=False):
            self._take(attempt, outcome)
        fresh = attempts[len(known) :]
        begin = time.perf_counter()
        answers = self.pool.solve([SolveTask(a.x, a.target) for a in fresh])
        each = (time.perf_counter() - begin) / max(1, len(fresh))
        for attempt, answer in zip(fresh, answers, strict=True):
            outcome = self._judged(attempt, answer, each)
            self._take(attempt, outcome)
            self._emit(outcome)

    def _take(self, attempt: _Attempt, outcome: PolishOutcome) -> None:
        self.outcomes.append(outcome)
        if outcome.status != "accepted":
            return
        if attempt.aim == "point":
            self._archive.replace(attempt.parent, outcome.x, outcome.objectives)
        else:
            self._archive.add(outcome.x, outcome.objectives)

    def _judged(self, attempt: _Attempt, answer: Solution | Lost, solving: float) -> PolishOutcome:
        begin = time.perf_counter()
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
            seconds=solving + time.perf_counter() - begin,
        )

    def _verdict(self, attempt: _Attempt, answer: Solution | Lost) -> tuple[Status, str, Array]:
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

    def _not_improved(self, answer: Solution, attempt: _Attempt) -> tuple[Status, str, Array]:
        if answer.converged or answer.residuals.stationarity <= OPTIMAL_STATIONARITY:
            return "optimal", "not improved", attempt.start
        return "failed", f"not improved: {answer.message}", attempt.start
