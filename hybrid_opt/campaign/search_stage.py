"""The first stage of a study: every algorithm's replicas, spread over the workers. A replica
records every generation and can repeat what was recorded."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.campaign.documents import (
    DONE,
    EVALUATIONS,
    FRONT,
    JOURNAL,
    FinishedReplica,
    replica_folder,
)
from hybrid_opt.campaign.evaluations_file import EvaluationTable, encode, encode_front
from hybrid_opt.campaign.folder import CampaignFolder, executor_for, identity
from hybrid_opt.campaign.journal import (
    Key,
    ReplicaLedger,
    candidates_in,
    decode_generation,
    encode_generation,
)
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.campaign.stages import Advance, Progress, Stage
from hybrid_opt.errors import DamagedResultsWarning, ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.indicators import metrics
from hybrid_opt.metaheuristics.run import Evaluator, SearchSettings, disarmed, search_carries
from hybrid_opt.store.files import read_bytes, sha256, write_atomically, write_json
from hybrid_opt.store.json_records import read_record, to_json
from hybrid_opt.work.service import Service, give_up
from symbolic.array import Array
from symbolic.records.task import initial_decision

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


ANEW = "--resume computes it anew"


def search_stage(source: EvaluatorSource | None = None) -> Stage:
    """The stage that runs all replicas.

    Args:
        source: makes the evaluator; None for that of the folder's workcell.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        cell = PackedCell.of(folder.files)
        maker = source or CellEvaluatorSource(cell, folder.settings.objectives)
        _Search(folder).run(maker, progress)

    def whole(folder: CampaignFolder) -> bool:
        return all(is_whole(folder.root, *key) for key in _replicas(folder))

    return Stage("search", run, whole=whole)


def is_whole(root: Path, algorithm: str, replica: int) -> bool:
    """Whether a replica is finished and its files are as they were written.

    A search gives the same bits again, so what is damaged is told and computed anew.
    """
    folder = replica_folder(root, algorithm, replica)
    if not (folder / DONE).exists():
        return False
    try:
        marker = read_record(FinishedReplica, folder / DONE, ANEW)
        for name in (EVALUATIONS, FRONT):
            if marker.sha256.get(name) != sha256(read_bytes(folder / name)):
                raise ResultsError(f"{folder / name}: damaged, its checksum differs; {ANEW}")
    except ResultsError as error:
        told = str(error).removesuffix(f"; {ANEW}")
        warnings.warn(f"{told}; {ANEW}", DamagedResultsWarning, stacklevel=2)
        return False
    return True


def _replicas(folder: CampaignFolder) -> list[Key]:
    """Every algorithm and number; replica by replica, so that an early look finds all."""
    settings = folder.settings
    return [
        (algorithm, replica)
        for replica in range(settings.replicas)
        for algorithm in settings.algorithms
    ]


class _Search(ReplicaLedger):
    """The replicas that are not done; see `ReplicaLedger`."""

    def __init__(self, folder: CampaignFolder) -> None:
        self._folder, every = folder, _replicas(folder)
        left = {
            key: replica_folder(folder.root, *key)
            for key in every
            if not is_whole(folder.root, *key)
        }
        self._done = (len(every) - len(left)) * folder.settings.evaluations
        super().__init__(left, identity(folder.settings, folder.root, folder.workcell))

    def run(self, source: EvaluatorSource, progress: Progress) -> None:
        """Run all open replicas."""
        settings, service = self._folder.settings, Service(source, run_replica)
        total = len(settings.algorithms) * settings.replicas * settings.evaluations
        with closing(self):
            begun = [k for k, folder in enumerate(self._folders) if (folder / JOURNAL).exists()]
            recorded = [payload for k in begun for payload in self.journal(k).payloads]
            if len(self):
                # Compiles what is missing here, once, instead of in every worker.
                service.make_context()
            done = self._done + sum(map(candidates_in, recorded))
            with progress.stage("search", total, "evaluations", done) as self._advance:
                executor_for(self._folder.execution).run(service, self)

    _advance: Advance

    def request(self, index: int) -> ReplicaRequest:
        """See `hybrid_opt.work.service.Ledger`."""
        initial = initial_decision(self._folder.workcell.task)
        recorded = tuple(self.journal(index).payloads)
        return ReplicaRequest(self._folder.settings, *self._left[index], initial, recorded)

    def heard(self, index: int, message: bytes) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        super().heard(index, message)
        self._advance(candidates_in(message))

    def lost(self, index: int, reason: str) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        give_up(reason)

    def answered(self, index: int, answer: ReplicaOutcome) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        files = {EVALUATIONS: answer.evaluations, FRONT: answer.front}
        for name, content in files.items():
            write_atomically(self._folders[index] / name, content)
        # Written last: with it, the replica is done.
        checksums = {name: sha256(content) for name, content in files.items()}
        done = FinishedReplica(*self._left[index], answer.count, answer.seconds, checksums)
        write_json(self._folders[index] / DONE, to_json(done))
        self.discard(index)
