"""A front during its polish: its archive, and the processing of every attempt.

Attempts are solved, evaluated and recorded one after the other. The full evaluator checks every
answer and certifies it between the samples before it is accepted.
"""

from __future__ import annotations

import ctypes
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import casadi
import numpy as np

from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, CandidateEvaluator, Evaluations
from hybrid_opt.evaluate.objectives import non_dominated
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.records import Aim, PolishOutcome, Status
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.array import Array

LEAST_SPAN = 2e-3
"""Least scale of an objective, for a front with one point or a nearly flat front."""

OWN_SHARE = 1.0 / 8.0
"""Share of the attempts that start at points of the given front."""

IMPROVEMENT_TOLERANCE = 1e-6
"""Largest improvement of an objective with which a point still counts as unimproved."""

OPTIMAL_STATIONARITY = 1e-3
"""Stationarity residual below which an unimproved point counts as optimal."""


class ParetoArchive:
    """Points of a front during its polish: the points of the given front, and new points.

    Attributes:
        x: decision vectors (n_var,), one per point.
        objectives: objectives (2,) of each point.
        parent: index of each point in the given front, -1 for a new point.
        polished: True for each point that the polish made.
    """

    def __init__(self, x: Array, objectives: Array, parent: list[int]) -> None:
        self.x, self.objectives = list(x), list(objectives)
        self.parent, self.polished = list(parent), [False] * len(x)

    def replace(self, parent: int, x: Array, objectives: Array) -> None:
        """Replace a point of the given front by a polished point.

        Args:
            parent: index of the point in the given front.
            x: (n_var,) decision vector of the polished point.
            objectives: (2,) its objectives.
        """
        index = self.parent.index(parent)
        self.x[index], self.objectives[index], self.polished[index] = x, objectives, True

    def dominates(self, objectives: Array) -> bool:
        """Return True if a point of the archive is at least as good as given objectives (2,) in
        each of them.
        """
        return bool(np.any(np.all(np.array(self.objectives) <= objectives, axis=1)))

    def add(self, x: Array, objectives: Array) -> None:
        """Add a new point.

        Args:
            x: (n_var,) decision vector.
            objectives: (2,) its objectives.
        """
        self.x.append(x)
        self.objectives.append(objectives)
        self.parent.append(-1)
        self.polished.append(True)

    def drop(self, indices: Sequence[int]) -> None:
        """Remove the points with these indices; later points get smaller indices."""
        lists: tuple[list[Any], ...] = (self.x, self.objectives, self.parent, self.polished)
        for values in lists:
            values[:] = [value for k, value in enumerate(values) if k not in indices]

    def front_indices(self) -> list[int]:
        """Return the indices of the non-dominated points, sorted by their first objective."""
        values = np.array(self.objectives)
        kept = np.flatnonzero(non_dominated(values))
        return [int(k) for k in kept[np.lexsort(values[kept].T[::-1])]]

    def best(self, objective: int | None) -> tuple[int, float]:
        """Return the index of the front's best point, and its value.

        The best point has the least value: the objective with index `objective`, or the sum of both
        objectives for None.
        """
        wanted = np.ones(2) if objective is None else np.eye(2)[objective]
        values = {k: float(wanted @ self.objectives[k]) for k in self.front_indices()}
        index = min(values, key=lambda k: values[k])
        return index, values[index]

    def span(self) -> Array:
        """Return the range (2,) of each objective over the front, or `LEAST_SPAN` where it is
        smaller."""
        values = np.array(self.objectives)[self.front_indices()]
        return np.asarray(np.maximum(np.ptp(values, axis=0), LEAST_SPAN))


@dataclass(frozen=True)
class Attempt:
    """One attempt to improve a front.

    Attributes:
        aim: what is looked for, see `hybrid_opt.polishing.records.PolishOutcome`.
        parent: index of the point of the given front that is improved, -1 for a new point.
        x: (n_var,) decision vector of the start.
        start: (2,) objectives of the start.
    """

    aim: Aim
    parent: int
    x: Array
    start: Array


AnyAttempt = TypeVar("AnyAttempt", bound=Attempt)


class PolishRun(ABC, Generic[AnyAttempt]):
    """State of the polish of one front while it runs.

    Attributes:
        outcomes: results of all attempts so far.
    """

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        settings: PolishSettings,
        archive: ParetoArchive,
        on_progress: Callable[[int, int], None],
    ) -> None:
        self._evaluator, self._settings = evaluator, settings
        self._archive = archive
        self.outcomes: list[PolishOutcome] = []
        self._most_attempts, self._expected, self._on_progress = settings.attempts, 0, on_progress

    @abstractmethod
    def attempts(self, rng: np.random.Generator) -> Iterator[AnyAttempt]:
        """Yield the attempts one by one. The result of each attempt is recorded before the next one
        is made.

        Args:
            rng: generator of random starts.
        """

    @abstractmethod
    def _solve(self, attempt: AnyAttempt) -> Solution:
        """Run the solver of an attempt, and return its unchecked result."""

    @abstractmethod
    def _classify(
        self, attempt: AnyAttempt, answer: Solution, objectives: Array
    ) -> tuple[Status, str, Array]:
        """Decide whether a result that the full model found feasible is an improvement.

        Args:
            attempt: the attempt.
            answer: result of its solver.
            objectives: (2,) objectives of the result by the full model.

        Returns:
            Status (accepted, optimal or rejected); the reason, '' if accepted; and the objectives
            (2,) to record: those of the result if accepted, else those of the start.
        """

    def run(self, rng: np.random.Generator) -> None:
        """Solve, check and record attempts as long as there are any.

        Args:
            rng: generator of random starts.
        """
        for attempt in self.attempts(rng):
            if self._attempts_left() <= 0:
                continue
            begin = time.perf_counter()
            try:
                answer = self._solve(attempt)
            except Exception as error:  # ends this attempt only
                message = f"{type(error).__name__}: {error}".splitlines()[0]
                answer = Solution(attempt.x, message)
            status, reason, objectives = self._status(attempt, answer)
            outcome = PolishOutcome(
                aim=attempt.aim,
                parent=attempt.parent,
                status=status,
                reason=reason,
                x=answer.x if status == "accepted" else attempt.x,
                start=attempt.start,
                objectives=objectives,
                residuals=answer.residuals,
                iterations=answer.iterations,
                rounds=answer.rounds,
                rows=answer.rows,
                seconds=time.perf_counter() - begin,
            )
            self._record(attempt, outcome)
            self._announce(max(self._expected - 1, 0))

    def _attempts_left(self) -> int:
        return self._most_attempts - len(self.outcomes)

    def _announce(self, attempts: int) -> None:
        """Report how many further attempts are expected."""
        self._expected = attempts
        self._on_progress(len(self.outcomes), len(self.outcomes) + attempts)

    def _record(self, attempt: AnyAttempt, outcome: PolishOutcome) -> None:
        self.outcomes.append(outcome)
        if outcome.status != "accepted":
            return
        if attempt.aim == "point":
            self._archive.replace(attempt.parent, outcome.x, outcome.objectives)
        else:
            self._archive.add(outcome.x, outcome.objectives)

    def _status(self, attempt: AnyAttempt, answer: Solution) -> tuple[Status, str, Array]:
        """Evaluate a solver's result by the full model, and certify it between the samples.

        Args:
            attempt: the attempt.
            answer: result of its solver.

        Returns:
            Status, reason and objectives (2,) of the attempt, as `PolishOutcome` records them.
        """
        if not answer.usable:
            return "failed", answer.message, attempt.start
        # An answer without any iteration is a point to verify as it is.
        if answer.rounds and np.array_equal(answer.x, attempt.x):
            return self._not_improved(answer, attempt)
        found = self._evaluate(attempt, answer.x)
        reason = int(found.reason[0])
        if reason != FEASIBLE:
            return "rejected", REASONS[reason], attempt.start
        return self._classify(attempt, answer, found.objectives[0])

    def _evaluate(self, attempt: AnyAttempt, x: Array) -> Evaluations:
        """Evaluate the result of an attempt by the full model, and certify it between the samples.

        Args:
            attempt: the attempt; not used.
            x: (n_var,) decision vector of the result.
        """
        return self._evaluator.certified(self._evaluator.evaluate(x))

    def _not_improved(self, answer: Solution, attempt: AnyAttempt) -> tuple[Status, str, Array]:
        if answer.converged or answer.residuals.stationarity <= OPTIMAL_STATIONARITY:
            return "optimal", "not improved", attempt.start
        return "failed", f"not improved: {answer.message}", attempt.start


def use_one_thread() -> None:
    """Limit IPOPT's linear algebra to one thread, so that it does not wait on cores that other
    workers use; its matrices are too small for threads. Its library is loaded with the first solve,
    too late for `codegen.native.one_thread`."""
    for library in Path(casadi.__file__).parent.glob("*openblas*.so*"):
        with suppress(OSError, AttributeError):
            ctypes.CDLL(str(library)).openblas_set_num_threads(1)
