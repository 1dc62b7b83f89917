"""A polish of fronts: the records that it returns and stores, a front during its polish with its
archive and the processing of every attempt, and the polisher of a cell.

Attempts are solved, evaluated and recorded one after the other. The full evaluator checks every
answer and certifies it between the samples before it is accepted.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from codegen.native import one_thread
from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, CandidateEvaluator, Evaluations
from hybrid_opt.evaluate.objectives import non_dominated
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers.base import UNKNOWN, Residuals
from symbolic.array import AllowMissing, Array, Count, Figure, Range, Shape
from symbolic.records.task import initial_decision

TIMED_EVALUATIONS = 32
"""Number of candidates whose evaluation is timed; the cost of a polish is stated in evaluations."""

LEAST_SPAN = 2e-3
"""Least scale of an objective, for a front with one point or a nearly flat front."""

OWN_SHARE = 1.0 / 8.0
"""Share of the attempts that start at points of the given front."""

IMPROVEMENT_TOLERANCE = 1e-6
"""Largest improvement of an objective with which a point still counts as unimproved."""

OPTIMAL_STATIONARITY = 1e-3
"""Stationarity residual below which an unimproved point counts as optimal."""


# --- records of attempts and of the polished front ---


Aim = Literal["point", "extreme", "balance", "gap", "probe"]
Status = Literal["accepted", "optimal", "rejected", "failed"]


@dataclass(frozen=True)
class PolishOutcome:
    """Outcome of one attempt.

    Attributes:
        aim: purpose of the attempt. 'point' improves a point of the given front; 'extreme',
            'balance' and 'gap' look for new points; 'probe' is a short solve that chooses where to
            look.
        parent: index of the point of the given front that is improved, -1 for a new point.
        status: accepted; optimal (no improvement beyond the tolerance, so the start stays);
            rejected by the full evaluation; failed in the solver.
        reason: reason why the attempt was not accepted, else ''.
        x: (n_var,) new decision vector if accepted, otherwise the start.
        start, objectives: (2,) objectives before and after the attempt; equal if nothing was
            accepted.
        residuals: optimality residuals of the solver's last result, accepted or not.
        iterations: solver iterations, over all trust-region iterations.
        rounds: number of trust-region iterations.
        rows: number of rows (scalar inequalities) at points of the path in the last program.
        seconds: wall time of the attempt, full evaluation and certification included.
    """

    aim: Aim
    parent: Annotated[int, Range(-1, 10**9)]
    status: Status
    reason: str
    x: Annotated[Array, Shape((None,)), AllowMissing()]
    start: Annotated[Array, Shape((2,)), AllowMissing()]
    objectives: Annotated[Array, Shape((2,)), AllowMissing()]
    residuals: Residuals
    iterations: Count
    rounds: Count
    rows: Count
    seconds: Figure


@dataclass(frozen=True)
class PolishEffort:
    """Effort and success of a polish.

    Attributes:
        solver: solver of the programs: 'dense', 'ipopt', or 'quadratic' for drivable carries.
        attempts: number of attempts.
        counts: number of attempts by status; attempts not accepted also by 'status: reason'.
        success_share: of the attempts to improve a point of the given front, the share that ended
            as accepted or optimal.
        seconds: total wall time [s].
        median_attempt_seconds: median wall time of an attempt [s].
        equivalent_evaluations: number of candidate evaluations that take as long as the polish.
        widest_gap: largest distance between neighbours, as a share of the front's length along both
            objectives; NaN for fewer than two points.
        worst_stationarity, worst_feasibility, median_stationarity: largest and median optimality
            residuals of those points on the final front that a solve made.
    """

    solver: str
    attempts: Count
    counts: Mapping[str, Count]
    success_share: Figure
    seconds: Annotated[float, Range(0.0, 1e12)]
    median_attempt_seconds: Figure
    equivalent_evaluations: Count
    widest_gap: Figure
    worst_stationarity: Figure
    worst_feasibility: Figure
    median_stationarity: Figure


@dataclass(frozen=True)
class PolishedFront:
    """A polished front as it is stored; arrays are read-only.

    Attributes:
        x: (k, n_var) non-dominated decision vectors, by increasing first objective.
        objectives: (k, 2) objectives by the full evaluator.
        parent: (k,) index of the point of the given front that a point is or replaces, -1 for a new
            point.
        polished: (k,) True for points that the polish made.
        outcomes: all attempts, in order.
        solver: solver of the programs: 'dense', 'ipopt', or 'quadratic' for drivable carries.
        seconds: total time [s].
        evaluation_seconds: measured time of one candidate evaluation [s], the unit of a search's
            effort.
    """

    x: Annotated[Array, Shape((None, None))]
    objectives: Annotated[Array, Shape((None, 2))]
    parent: Annotated[NDArray[np.int64], Shape((None,), int)]
    polished: Annotated[NDArray[np.bool_], Shape((None,), bool)]
    outcomes: tuple[PolishOutcome, ...]
    seconds: Annotated[float, Range(0.0, 1e12)]
    evaluation_seconds: Annotated[float, Range(1e-12, 1e12)]
    solver: str

    def __post_init__(self) -> None:
        """Make the arrays read-only.

        Raises:
            ValueError: the arrays have different lengths.
        """
        arrays = (self.x, self.objectives, self.parent, self.polished)
        if len({len(array) for array in arrays}) > 1:
            raise ValueError("its arrays have different lengths")
        for array in arrays:
            array.setflags(write=False)

    @property
    def widest_gap(self) -> float:
        """Largest distance between neighbouring points, as a share of the front's length. Both are
        sums over the objectives, each divided by its range over the front. NaN for fewer than two
        points.
        """
        if len(self.objectives) < 2:
            return float("nan")
        sides = np.abs(np.diff(self.objectives, axis=0))
        return float((sides / sides.sum(axis=0)).sum(axis=1).max() / 2.0)

    @property
    def counts(self) -> dict[str, int]:
        """Number of attempts by status.

        Attempts that were not accepted are also counted by 'status: reason'.
        """
        listed = Counter[str](outcome.status for outcome in self.outcomes)
        listed.update(f"{o.status}: {o.reason}" for o in self.outcomes if o.reason)
        return dict(listed)

    @property
    def effort(self) -> PolishEffort:
        """Record of the effort and success of the polish."""
        own = [o.status in ("accepted", "optimal") for o in self.outcomes if o.aim == "point"]
        # Others were judged as they are, without a solver.
        solved = [o for o in self.outcomes if o.rounds or o.status == "failed"]
        # What was dominated later, probes most of all, is no result.
        standing = {x.tobytes() for x in self.x}
        accepted = [
            o.residuals for o in solved if o.status == "accepted" and o.x.tobytes() in standing
        ]
        return PolishEffort(
            solver=self.solver,
            attempts=len(solved),
            counts=self.counts,
            success_share=float(np.mean(own)) if own else float("nan"),
            seconds=self.seconds,
            median_attempt_seconds=_median([o.seconds for o in solved]),
            equivalent_evaluations=int(np.ceil(self.seconds / self.evaluation_seconds)),
            widest_gap=self.widest_gap,
            worst_stationarity=max((r.stationarity for r in accepted), default=float("nan")),
            worst_feasibility=max((r.feasibility for r in accepted), default=float("nan")),
            median_stationarity=_median([r.stationarity for r in accepted]),
        )


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")


# --- a front during its polish ---


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
        aim: what is looked for, see `PolishOutcome`.
        parent: index of the point of the given front that is improved, -1 for a new point.
        x: (n_var,) decision vector of the start.
        start: (2,) objectives of the start.
    """

    aim: Aim
    parent: int
    x: Array
    start: Array


@dataclass
class Solution:
    """Result of a trust-region solve, not yet checked by the full evaluator.

    Attributes:
        x: (n_var,) best candidate; the start if nothing improved on it.
        message: text on how the solve ended.
        converged: True if the solver reports that x is a stationary point.
        usable: True if the start could be evaluated.
        residuals: optimality residuals at x, of the last program.
        iterations: number of solver iterations, over all trust-region iterations.
        rounds: number of trust-region iterations.
        rows: number of rows (scalar inequalities) at points of the path in the last program.
    """

    x: Array
    message: str = ""
    converged: bool = False
    usable: bool = False
    residuals: Residuals = UNKNOWN
    iterations: int = 0
    rounds: int = 0
    rows: int = 0


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


class Polisher(ABC):
    """Polishes fronts of one cell. Reuse one object for several fronts, because it loads functions.

    Attributes:
        evaluator: evaluator of candidates by the full model.
        settings: settings of the polish.
    """

    def __init__(self, evaluator: CandidateEvaluator, settings: PolishSettings) -> None:
        self.evaluator, self.settings = evaluator, settings

    @property
    @abstractmethod
    def solver_name(self) -> str:
        """Name of the solver of the programs, see `PolishedFront.solver`."""

    @abstractmethod
    def new_run(
        self, archive: ParetoArchive, on_progress: Callable[[int, int], None], paths: Array
    ) -> PolishRun[Any]:
        """Return the polish of one front, before its first attempt.

        Args:
            archive: the front to be polished.
            on_progress: function called with the number of finished attempts and the expected
                total.
            paths: (m, n_path) free waypoints of known good paths, as for `polish`.
        """

    def polish(
        self,
        front_x: Array,
        rng: np.random.Generator,
        paths: Array | None = None,
        on_progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> PolishedFront:
        """Polish a front.

        Args:
            front_x: (k, n_var) decision vectors of the front; k may be 0.
            rng: generator of random starts.
            paths: (m, n_path) free waypoints of known good paths, not necessarily on the front;
                only the polish of drivable carries uses them. None for none.
            on_progress: function called with the number of finished attempts and the expected
                total.
        """
        begin = time.perf_counter()
        x = np.asarray(front_x, dtype=float).reshape(-1, self.evaluator.n_var)
        unit = self._evaluation_seconds(x)
        found = self.evaluator.certified(self.evaluator.evaluate(x))
        feasible = np.flatnonzero(found.feasible)
        archive = ParetoArchive(x[feasible], found.objectives[feasible], feasible.tolist())
        known = np.empty((0, self.evaluator.workcell.task.n_path)) if paths is None else paths
        run = self.new_run(archive, on_progress, known)
        if len(feasible) and self.settings.attempts:
            with one_thread():
                run.run(rng)
        on_progress(len(run.outcomes), len(run.outcomes))
        rows = archive.front_indices() if len(feasible) else []
        return PolishedFront(
            x=np.array([archive.x[k] for k in rows]).reshape(-1, self.evaluator.n_var),
            objectives=np.array([archive.objectives[k] for k in rows]).reshape(-1, 2),
            parent=np.array([archive.parent[k] for k in rows], dtype=np.int64),
            polished=np.array([archive.polished[k] for k in rows], dtype=bool),
            outcomes=tuple(run.outcomes),
            seconds=time.perf_counter() - begin,
            evaluation_seconds=unit,
            solver=self.solver_name,
        )

    def _evaluation_seconds(self, x: Array) -> float:
        """Measure the time of one candidate's evaluation [s].

        Args:
            x: (k, n_var) candidates to evaluate; the hand-made trajectory if k is 0.
        """
        sample = x if len(x) else initial_decision(self.evaluator.workcell.task)[None]
        batch = np.resize(sample, (TIMED_EVALUATIONS, self.evaluator.n_var))
        begin = time.perf_counter()
        self.evaluator.evaluate(batch)
        return (time.perf_counter() - begin) / len(batch)
