"""The first stage of a study: every algorithm's replicas, spread over the workers. A replica
records every generation and can repeat what was recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.journal import (
    EvaluationTable,
    Key,
    ReplicaLedger,
    ReplicaRequest,
    candidates_in,
    decode_generation,
    encode,
    encode_front,
    encode_generation,
)
from hybrid_opt.campaign.results import finished_replica, is_whole
from hybrid_opt.campaign.settings import (
    DONE,
    EVALUATIONS,
    FRONT,
    JOURNAL,
    FinishedReplica,
    replica_folder,
)
from hybrid_opt.campaign.stages import Stage, with_cell
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations
from hybrid_opt.indicators import metrics
from hybrid_opt.metaheuristics.run import Evaluator, SearchSettings, disarmed, search_carries
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import sha256, to_json, write_atomically, write_json
from hybrid_opt.work.service import Service
from symbolic.array import Array
from symbolic.records.task import initial_decision

EvaluatorSource = Callable[[], Evaluator]
"""Makes the evaluator, in any process; can be pickled and hashed."""


def run_replica(
    evaluator: Evaluator, request: ReplicaRequest, emit: Callable[[bytes], None]
) -> tuple[dict[str, bytes], FinishedReplica]:
    """Run a replica to its end; returns the content of its files by name, and its record.

    The search runs again from its seed; where the journal holds a generation, the evaluations
    are taken from there, so that nothing is evaluated twice.

    Args:
        evaluator: of the campaign's workcell and objectives.
        request: what to run.
        emit: takes the journal's block of each newly evaluated generation.

    Raises:
        ResultsError: the journal holds other candidates than the search asks for.
    """
    settings, algorithm = request.settings, request.algorithm
    recording = _Recording(evaluator, request, emit)
    start = request.x if settings.starts_from_initial(algorithm) else None
    found, generation = search_carries(
        recording,
        algorithm,
        settings.evaluations,
        settings.replica_rng(algorithm, request.replica),
        SearchSettings(settings.algorithms[algorithm], settings.constraint_handling, start),
        task=evaluator.workcell.task if isinstance(evaluator, CandidateEvaluator) else None,
    )
    # Without what was repeated from a journal.
    seconds = sum(recording.seconds) + recording.certification_seconds
    rows = metrics.front_rows(found.objectives, found.feasible)
    table = EvaluationTable(found, generation, evaluator.objective_names)
    files = {EVALUATIONS: encode(table), FRONT: encode_front(table, rows)}
    checksums = {name: sha256(content) for name, content in files.items()}
    return files, FinishedReplica(algorithm, request.replica, len(found), seconds, checksums)


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


def search_stage(source: EvaluatorSource | None = None) -> Stage:
    """The stage that runs all replicas.

    Args:
        source: makes the evaluator; None for that of the folder's workcell.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        evaluator = partial(CandidateEvaluator, objectives=folder.settings.objectives)
        maker = partial(with_cell, evaluator, folder.files)
        _Search(folder).run(source or maker, progress)

    def whole(folder: CampaignFolder) -> bool:
        return all(_is_done(folder.root, *key) for key in _replicas(folder))

    return Stage("search", run, whole=whole)


def _is_done(root: Path, algorithm: str, replica: int) -> bool:
    """Whether a replica is finished and its files are as they were written: a search gives the same
    bits again, so what is damaged is computed anew."""
    read = partial(finished_replica, root, algorithm, replica, (EVALUATIONS, FRONT))
    return is_whole((replica_folder(root, algorithm, replica) / DONE).exists(), read)


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
        self._every = _replicas(folder)
        left = [key for key in self._every if not _is_done(folder.root, *key)]
        super().__init__(folder, {key: replica_folder(folder.root, *key) for key in left})

    def run(self, source: EvaluatorSource, progress: Progress) -> None:
        """Run all open replicas."""
        each = self.folder.settings.evaluations
        with closing(self):
            begun = [k for k, (_, folder) in enumerate(self.left) if (folder / JOURNAL).exists()]
            recorded = [payload for k in begun for payload in self.journal(k).payloads]
            done = (len(self._every) - len(self)) * each + sum(map(candidates_in, recorded))
            service, stage = Service(source, run_replica), ("search", "evaluations")
            self.work(service, progress, stage, len(self._every) * each, done)

    def request(self, index: int) -> ReplicaRequest:
        """See `hybrid_opt.work.service.Ledger`."""
        return self.replica_request(index, initial_decision(self.folder.workcell.task)[None])

    def heard(self, index: int, message: bytes) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        super().heard(index, message)
        self.advance(candidates_in(message))

    def answered(self, index: int, answer: tuple[dict[str, bytes], FinishedReplica]) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        (_, folder), (files, done) = self.left[index], answer
        for name, content in files.items():
            write_atomically(folder / name, content)
        # Written last: with it, the replica is done.
        write_json(folder / DONE, to_json(done))
        self.discard(index)
