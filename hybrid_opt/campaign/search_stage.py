"""The first stage of a study: every algorithm's replicas, spread over the workers."""

from __future__ import annotations

import warnings
from contextlib import closing
from pathlib import Path

from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.campaign.documents import (
    DONE,
    EVALUATIONS,
    FRONT,
    JOURNAL,
    FinishedReplica,
    replica_folder,
)
from hybrid_opt.campaign.execution import executor_for
from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.identity import identity
from hybrid_opt.campaign.journal import Key, ReplicaLedger, candidates_in
from hybrid_opt.campaign.replica import (
    CellEvaluatorSource,
    EvaluatorSource,
    ReplicaOutcome,
    ReplicaRequest,
    run_replica,
)
from hybrid_opt.campaign.stages import Advance, Progress, Stage
from hybrid_opt.errors import DamagedResultsWarning, ResultsError
from hybrid_opt.store.files import read_bytes, sha256, write_atomically, write_json
from hybrid_opt.store.json_records import read_record, to_json
from hybrid_opt.work.service import Service, give_up
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
