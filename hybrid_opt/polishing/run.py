"""What every polish of a front does with its attempts: solve, judge, take in, report."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import FEASIBLE, REASONS, Evaluations
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.attempt import Lost, solve_safely
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.records import Aim, PolishedFront, PolishOutcome, Status
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.work.threads import one_thread
from symbolic.array import Array
from symbolic.records.task import initial_decision

NO_SOLUTION = Solution(np.empty(0))

TIMED_EVALUATIONS = 32
"""Candidates whose evaluation is timed, to express the polish in their unit."""


class Attempted(Protocol):
    """What every attempt has; see `hybrid_opt.polishing.plan.Attempt`."""

    @property
    def aim(self) -> Aim:
        """What it looks for."""

    @property
    def parent(self) -> int:
        """Row of the given front, or -1."""

    @property
    def x(self) -> Array:
        """(n_var,) decision vector to start from."""

    @property
    def start(self) -> Array:
        """(2,) objectives there."""


AnyAttempt = TypeVar("AnyAttempt", bound=Attempted)


class PolishRun(ABC, Generic[AnyAttempt]):
    """One polish in progress: attempts are solved, judged and taken in, one after the other."""

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        settings: PolishSettings,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
    ) -> None:
        self._evaluator, self._settings = evaluator, settings
        self._archive, self._recorded, self._emit = archive, recorded, emit
        self.outcomes: list[PolishOutcome] = []
        self._most = settings.attempts

    @abstractmethod
    def all(self, rng: np.random.Generator) -> None:
        """Every attempt."""

    @abstractmethod
    def _solution(self, attempt: AnyAttempt) -> Solution:
        """What the solver makes of an attempt."""

    def _left(self) -> int:
        return self._most - len(self.outcomes)

    def _do(self, attempts: list[AnyAttempt]) -> None:
        """Solve, judge and take in attempts; those on record are not solved again."""
        for attempt in attempts[: max(0, self._left())]:
            known = self._recorded.pop(0) if self._recorded else None
            if isinstance(known, PolishOutcome):
                self._take(attempt, known)
                continue
            begin = time.perf_counter()
            answer = known or solve_safely(partial(self._solution, attempt))
            outcome = self._judged(attempt, answer, begin)
            self._take(attempt, outcome)
            if known is None:
                self._emit(outcome)

    def _take(self, attempt: AnyAttempt, outcome: PolishOutcome) -> None:
        self.outcomes.append(outcome)
        if outcome.status != "accepted":
            return
        if attempt.aim == "point":
            self._archive.replace(attempt.parent, outcome.x, outcome.objectives)
        else:
            self._archive.add(outcome.x, outcome.objectives)

    def _judged(self, attempt: AnyAttempt, answer: Solution | Lost, begin: float) -> PolishOutcome:
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

    def _verdict(self, attempt: AnyAttempt, answer: Solution | Lost) -> tuple[Status, str, Array]:
        if isinstance(answer, Lost):
            return "failed", answer.reason, attempt.start
        if not answer.usable:
            return "failed", answer.message, attempt.start
        if np.array_equal(answer.x, attempt.x):
            return self._not_improved(answer, attempt)
        return self._recomputed(attempt, answer)

    def _recomputed(self, attempt: AnyAttempt, answer: Solution) -> tuple[Status, str, Array]:
        """What the full evaluator and the certificate between the samples say of an answer."""
        found = self._evaluated(attempt, answer.x)
        reason = int(found.reason[0])
        if reason != FEASIBLE:
            return "rejected", REASONS[reason], attempt.start
        return self._worth(attempt, answer, found.objectives[0])

    def _evaluated(self, attempt: AnyAttempt, x: Array) -> Evaluations:
        """What the full evaluator and the certificate between the samples say of x (n_var,)."""
        return self._evaluator.certified(self._evaluator.evaluate(x))

    def _worth(
        self, attempt: AnyAttempt, answer: Solution, objectives: Array
    ) -> tuple[Status, str, Array]:
        """Whether a feasible answer is taken in."""
        gain = attempt.start - objectives
        if attempt.aim == "point":
            if gain.min() < -self._settings.tolerance:
                return "rejected", "an objective became worse", attempt.start
            if gain.max() <= self._settings.tolerance:
                return self._not_improved(answer, attempt)
        elif attempt.aim == "probe":
            # Dominated or not: it tells what lies there, and may be continued.
            if gain.max() <= self._settings.tolerance:
                return self._not_improved(answer, attempt)
        elif self._archive.dominates(objectives):
            return "rejected", "dominated", attempt.start
        return "accepted", "", objectives

    def _not_improved(self, answer: Solution, attempt: AnyAttempt) -> tuple[Status, str, Array]:
        if answer.converged or answer.residuals.stationarity <= self._settings.front.optimal:
            return "optimal", "not improved", attempt.start
        return "failed", f"not improved: {answer.message}", attempt.start


class Polisher(ABC):
    """Polishes fronts of one evaluator. A resource: keep it for several fronts.

    Attributes:
        evaluator: judges what is found.
        settings: effort and tolerances.
    """

    def __init__(self, evaluator: CandidateEvaluator, settings: PolishSettings) -> None:
        self.evaluator, self.settings = evaluator, settings

    @abstractmethod
    def _run(
        self,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
        paths: Array,
    ) -> PolishRun[Any]:
        """A polish of one front, about to begin; see `polish`."""

    def polish(
        self,
        front_x: Array,
        rng: np.random.Generator,
        recorded: Sequence[PolishOutcome | Lost] = (),
        emit: Callable[[PolishOutcome], None] = lambda outcome: None,
        paths: Array | None = None,
    ) -> PolishedFront:
        """Polish a front.

        Args:
            front_x: (k, n_var) decision vectors; k may be 0.
            rng: spreads the starts of attempts at the balanced middle.
            recorded: outcomes of an earlier, interrupted polish of the same front, not repeated;
                `Lost` for an attempt that ended its process.
            emit: takes each new outcome.
            paths: (m, n_path) free waypoints that are known to be good, and need not be on the
                front; only the polish of drivable carries uses them. None for none.
        """
        begin = time.perf_counter()
        x = np.asarray(front_x, dtype=float).reshape(-1, self.evaluator.n_var)
        unit = self._evaluation_seconds(x)
        found = self.evaluator.certified(self.evaluator.evaluate(x))
        feasible = np.flatnonzero(found.feasible)
        archive = GrowingFront(x[feasible], found.objectives[feasible], feasible.tolist())
        known = np.empty((0, self.evaluator.workcell.task.n_path)) if paths is None else paths
        run = self._run(archive, list(recorded), emit, known)
        if len(feasible) and self.settings.attempts:
            with one_thread():
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
