"""One replica: a search that records every generation and can repeat what was recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.campaign.evaluations_file import EvaluationTable, encode, encode_front
from hybrid_opt.campaign.journal import decode_generation, encode_generation
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.indicators import metrics
from hybrid_opt.metaheuristics.carries import SearchSettings, search_carries
from hybrid_opt.metaheuristics.problem import Evaluator, disarmed
from symbolic.array import Array

EvaluatorSource = Callable[[], Evaluator]
"""Makes the evaluator, in any process; can be pickled and hashed."""


@dataclass(frozen=True)
class CellEvaluatorSource:
    """Makes a workcell's evaluator from nothing but this value.

    Attributes:
        cell: the workcell.
        objectives: names of the objectives.
    """

    cell: PackedCell
    objectives: tuple[str, ...]

    def __call__(self) -> CandidateEvaluator:
        """Load the compiled functions, or build them where they are missing."""
        return self.cell.make(lambda workcell: CandidateEvaluator(workcell, self.objectives))


@dataclass(frozen=True)
class ReplicaRequest:
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
    evaluator: Evaluator, request: ReplicaRequest, emit: Callable[[bytes], None]
) -> ReplicaOutcome:
    """Run a replica to its end.

    The search runs again from its seed; where the journal holds a generation, the evaluations
    are taken from there, so that nothing is evaluated twice.

    Args:
        evaluator: of the campaign's workcell and objectives.
        request: what to run.
        emit: takes the journal's block of each newly evaluated generation.

    Raises:
        ResultsError: the journal holds other candidates than the search asks for.
    """
    settings = request.settings
    recording = _Recording(evaluator, request, emit)
    start = request.initial[None] if settings.starts_from_initial(request.algorithm) else None
    found = search_carries(
        recording,
        request.algorithm,
        settings.evaluations,
        settings.replica_rng(request.algorithm, request.replica),
        SearchSettings(settings.overrides(request.algorithm), settings.constraint_handling, start),
    )
    seconds = sum(recording.seconds) + recording.certification_seconds
    table = EvaluationTable(found.evaluations, found.generation, evaluator.objective_names)
    front = front_rows(table.evaluations)
    return ReplicaOutcome(encode(table), encode_front(table, front), len(found.generation), seconds)


def front_rows(evaluations: Evaluations) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """(k,) rows of the feasible candidates that none dominates, by increasing objectives."""
    return metrics.front_rows(evaluations.objectives, evaluations.feasible)


class _Recording:
    """Evaluates, records what is new, and answers from the record what is not."""

    def __init__(
        self, evaluator: Evaluator, request: ReplicaRequest, emit: Callable[[bytes], None]
    ) -> None:
        self.objective_names = evaluator.objective_names
        self.n_var = evaluator.n_var
        self.lower, self.upper = evaluator.lower, evaluator.upper
        self.seconds: list[float] = []
        self.certification_seconds = 0.0
        self._evaluator = evaluator
        self._request = request
        self._emit = emit
        self._since = time.perf_counter()

    def evaluate(self, x: Array) -> Evaluations:
        recorded: Sequence[bytes] = self._request.recorded
        if len(self.seconds) < len(recorded):
            seconds, generation = self._repeated(recorded[len(self.seconds)])
            if not np.array_equal(generation.x, x):
                raise self._unusable(
                    "the journal holds other candidates than the search asks for, as after a "
                    "change of the machine or of a library"
                )
        else:
            generation = disarmed(self._evaluator.evaluate(x))
            seconds = time.perf_counter() - self._since
            self._emit(encode_generation(seconds, generation))
        self.seconds.append(seconds)
        self._since = time.perf_counter()
        return generation

    def _repeated(self, block: bytes) -> tuple[float, Evaluations]:
        try:
            return decode_generation(block, self.n_var, len(self.objective_names))
        except ResultsError as error:
            raise self._unusable(str(error)) from error

    def _unusable(self, why: str) -> ResultsError:
        return ResultsError(
            f"{self._request.algorithm} replica {self._request.replica}: {why}; delete the "
            "replica's folder to compute it anew"
        )

    def certified(self, evaluations: Evaluations) -> Evaluations:
        begin = time.perf_counter()
        certified = self._evaluator.certified(evaluations)
        self.certification_seconds = time.perf_counter() - begin
        return certified
