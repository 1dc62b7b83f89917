"""One replica: a search that records every generation and can repeat what was recorded."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hybrid_opt import metaheuristics
from hybrid_opt.campaign.evaluations_file import EvaluationTable, encode, encode_front
from hybrid_opt.campaign.journal import decode_generation, encode_generation
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations
from hybrid_opt.indicators import metrics
from hybrid_opt.metaheuristics.problem import CarryProblem, Evaluator, disarmed
from symbolic.array import Array
from symbolic.workcell.archive import CellArchive, archive_from_json, archive_to_json, unpack_cell

EvaluatorSource = Callable[[], Evaluator]
"""Makes the evaluator, in any process; can be pickled and hashed."""


@dataclass(frozen=True)
class CellEvaluatorSource:
    """Makes a workcell's evaluator from nothing but this value.

    Attributes:
        cell: the workcell with its files, JSON of `symbolic.workcell.archive.archive_to_json`.
        objectives: names of the objectives.
    """

    cell: str
    objectives: tuple[str, ...]

    @classmethod
    def of(cls, archive: CellArchive, objectives: tuple[str, ...]) -> CellEvaluatorSource:
        """The source for a stored workcell."""
        return cls(json.dumps(archive_to_json(archive)), objectives)

    def __call__(self) -> CandidateEvaluator:
        """Load the compiled functions, or build them where they are missing."""
        with TemporaryDirectory() as folder:
            workcell = unpack_cell(archive_from_json(json.loads(self.cell)), Path(folder))
            return CandidateEvaluator(workcell, self.objectives)


@dataclass(frozen=True)
class ReplicaTask:
    """A replica to run.

    Attributes:
        settings: the campaign's.
        algorithm, replica: which one.
        initial: (n_var,) the workcell's hand-made trajectory.
        recorded: the journal's blocks of an earlier, interrupted attempt.
    """

    settings: CampaignSettings
    algorithm: str
    replica: int
    initial: Array
    recorded: tuple[bytes, ...] = ()


@dataclass(frozen=True)
class ReplicaOutcome:
    """A finished replica.

    Attributes:
        evaluations: content of its file of candidates, see `evaluations_file`.
        front: content of its file of non-dominated candidates.
        count: evaluated candidates.
        seconds: time that the search and the certification of its front took, without what was
            repeated from a journal.
    """

    evaluations: bytes
    front: bytes
    count: int
    seconds: float


def run_replica(
    evaluator: Evaluator, task: ReplicaTask, emit: Callable[[bytes], None]
) -> ReplicaOutcome:
    """Run a replica to its end.

    The search runs again from its seed; where the journal holds a generation, the evaluations
    are taken from there, so that nothing is evaluated twice.

    Args:
        evaluator: of the campaign's workcell and objectives.
        task: what to run.
        emit: takes the journal's block of each newly evaluated generation.

    Raises:
        ResultsError: the journal holds other candidates than the search asks for.
    """
    settings = task.settings
    recording = _Recording(evaluator, task, emit)
    problem = CarryProblem(recording, settings.constraint_handling)
    start = task.initial[None] if settings.starts_from_initial(task.algorithm) else None
    algorithm = metaheuristics.make(task.algorithm, settings.overrides(task.algorithm), start)
    rng = settings.replica_rng(task.algorithm, task.replica)
    metaheuristics.search(problem, algorithm, settings.evaluations, rng)
    generation = np.repeat(
        np.arange(1, len(problem.batches) + 1), [len(batch) for batch in problem.batches]
    )
    begin = time.perf_counter()
    evaluations = recording.certified(problem.evaluations)
    seconds = sum(recording.seconds) + time.perf_counter() - begin
    table = EvaluationTable(evaluations, generation, evaluator.objective_names)
    front = front_rows(table.evaluations)
    return ReplicaOutcome(encode(table), encode_front(table, front), len(generation), seconds)


def front_rows(evaluations: Evaluations) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """(k,) rows of the feasible candidates that none dominates, by increasing objectives."""
    return metrics.front_rows(evaluations.objectives, evaluations.feasible)


class _Recording:
    """Evaluates, records what is new, and answers from the record what is not."""

    def __init__(
        self, evaluator: Evaluator, task: ReplicaTask, emit: Callable[[bytes], None]
    ) -> None:
        self.objective_names = evaluator.objective_names
        self.n_var = evaluator.n_var
        self.lower, self.upper = evaluator.lower, evaluator.upper
        self.seconds: list[float] = []
        self._evaluator = evaluator
        self._task = task
        self._emit = emit
        self._since = time.perf_counter()

    def evaluate(self, x: Array) -> Evaluations:
        recorded: Sequence[bytes] = self._task.recorded
        if len(self.seconds) < len(recorded):
            seconds, generation = decode_generation(
                recorded[len(self.seconds)], self.n_var, len(self.objective_names)
            )
            if not np.array_equal(generation.x, x):
                raise ResultsError(
                    f"{self._task.algorithm} replica {self._task.replica}: the journal holds "
                    "other candidates than the search asks for, as after a change of the machine "
                    "or of a library; delete the replica's folder to compute it anew"
                )
        else:
            generation = disarmed(self._evaluator.evaluate(x))
            seconds = time.perf_counter() - self._since
            self._emit(encode_generation(seconds, generation))
        self.seconds.append(seconds)
        self._since = time.perf_counter()
        return generation

    def certified(self, evaluations: Evaluations) -> Evaluations:
        return self._evaluator.certified(evaluations)
