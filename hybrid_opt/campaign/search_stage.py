"""The first stage of a study: every algorithm's replicas, spread over the workers."""

from __future__ import annotations

import warnings
from pathlib import Path

from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.campaign.documents import FinishedReplica
from hybrid_opt.campaign.execution import executor_for
from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.identity import identity, replica_identity
from hybrid_opt.campaign.journal import Journal, candidates_in
from hybrid_opt.campaign.layout import DONE, EVALUATIONS, FRONT, JOURNAL, replica_folder
from hybrid_opt.campaign.progress import Advance, Progress
from hybrid_opt.campaign.replica import (
    CellEvaluatorSource,
    EvaluatorSource,
    ReplicaOutcome,
    ReplicaRequest,
    run_replica,
)
from hybrid_opt.campaign.stages import Stage
from hybrid_opt.errors import DamagedResultsWarning, ResultsError
from hybrid_opt.store.files import read_bytes, sha256, write_atomically, write_json
from hybrid_opt.store.json_records import read_record, to_json
from hybrid_opt.work.service import Executor, Service, give_up
from symbolic.records.task import initial_decision

ANEW = "--resume computes it anew"


def search_stage(source: EvaluatorSource | None = None) -> Stage:
    """The stage that runs all replicas.

    Args:
        source: makes the evaluator; None for that of the folder's workcell.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        cell = PackedCell.of(folder.files)
        maker = source or CellEvaluatorSource(cell, folder.settings.objectives)
        _Search(folder, maker).run(executor_for(folder.execution), progress)

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


def _replicas(folder: CampaignFolder) -> list[tuple[str, int]]:
    """Every algorithm and number; replica by replica, so that an early look finds all."""
    settings = folder.settings
    return [
        (algorithm, replica)
        for replica in range(settings.replicas)
        for algorithm in settings.algorithms
    ]


class _Search:
    """The replicas that are not done, and the journals of those that are being worked on."""

    def __init__(self, folder: CampaignFolder, source: EvaluatorSource) -> None:
        self._folder = folder
        self._service = Service(source, run_replica)
        self._identity = identity(folder.settings, folder.root, folder.workcell)
        every = _replicas(folder)
        self._open = [key for key in every if not is_whole(folder.root, *key)]
        self._done = (len(every) - len(self._open)) * folder.settings.evaluations
        self._journals: dict[int, Journal] = {}

    def run(self, executor: Executor, progress: Progress) -> None:
        """Run all open replicas."""
        settings = self._folder.settings
        recorded = self._done + sum(self._begin(index) for index in range(len(self._open)))
        total = len(settings.algorithms) * settings.replicas * settings.evaluations
        try:
            if self._open:
                # Compiles what is missing here, once, instead of in every worker.
                self._service.make_context()
            with progress.stage("search", total, "evaluations", recorded) as self._advance:
                executor.run(self._service, self)
        finally:
            for journal in self._journals.values():
                journal.close()

    _advance: Advance

    def _begin(self, index: int) -> int:
        """Open a replica's journal; the evaluations that it holds."""
        algorithm, replica = self._open[index]
        path = replica_folder(self._folder.root, algorithm, replica) / JOURNAL
        if not path.exists():
            return 0
        journal = self._journal(index)
        return sum(candidates_in(payload) for payload in journal.payloads)

    def _journal(self, index: int) -> Journal:
        if index not in self._journals:
            algorithm, replica = self._open[index]
            path = replica_folder(self._folder.root, algorithm, replica) / JOURNAL
            identity_of = replica_identity(self._identity, algorithm, replica)
            self._journals[index] = Journal(path, identity_of)
        return self._journals[index]

    def __len__(self) -> int:
        return len(self._open)

    def request(self, index: int) -> ReplicaRequest:
        """See `hybrid_opt.work.service.Ledger`."""
        journal = self._journal(index)
        initial = initial_decision(self._folder.workcell.task)
        algorithm, replica = self._open[index]
        return ReplicaRequest(
            self._folder.settings, algorithm, replica, initial, tuple(journal.payloads)
        )

    def heard(self, index: int, message: bytes) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        self._journal(index).append(message)
        self._advance(candidates_in(message))

    def lost(self, index: int, reason: str) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        give_up(reason)

    def answered(self, index: int, answer: ReplicaOutcome) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        algorithm, replica = self._open[index]
        folder = replica_folder(self._folder.root, algorithm, replica)
        files = {EVALUATIONS: answer.evaluations, FRONT: answer.front}
        for name, content in files.items():
            write_atomically(folder / name, content)
        # Written last: with it, the replica is done.
        checksums = {name: sha256(content) for name, content in files.items()}
        done = FinishedReplica(algorithm, replica, answer.count, answer.seconds, checksums)
        write_json(folder / DONE, to_json(done))
        self._journals.pop(index).discard()
