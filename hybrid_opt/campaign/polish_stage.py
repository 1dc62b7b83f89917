"""The stage of a study that polishes every replica's front, and the files it leaves.

Per replica a folder `polished/ALGORITHM/NN`: `polish.json`, written last, holds the front, every
attempt and what it took; `journal.bin` holds the attempts of a polish in progress, so that an
interrupted one repeats none.
"""

from __future__ import annotations

import json
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.campaign.documents import PolishDocument, PolishEffort
from hybrid_opt.campaign.execution import executor_for
from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.identity import identity, replica_identity
from hybrid_opt.campaign.journal import Journal
from hybrid_opt.campaign.layout import JOURNAL, POLISH, polished_folder
from hybrid_opt.campaign.polish_document import polish_document
from hybrid_opt.campaign.progress import Advance, Progress
from hybrid_opt.campaign.results import Replica, read_campaign
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.campaign.stages import Stage
from hybrid_opt.errors import DamagedResultsWarning, ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.front import Lost, use_one_thread
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.records import (
    PolishedFront,
    PolishOutcome,
    outcome_from_json,
    outcome_to_json,
)
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers.base import MOST_SECONDS
from hybrid_opt.store.files import read_bytes, write_json
from hybrid_opt.store.json_records import record_of, to_json
from hybrid_opt.work.service import Service, give_up
from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.records import Workcell

JUDGING_SECONDS = 540.0
"""Time that an attempt may take besides one solve, or the front before the first one. An idle
core needs ten seconds; the clock is the wall's, and machines with twenty times more work were
seen."""

KEPT_FRONTS = 64
"""Documents that are remembered by their content: a study's stages read its fronts again and
again."""


@dataclass(frozen=True)
class PolisherSource:
    """Makes a polisher, in any process.

    Attributes:
        cell: the workcell.
        objectives: names of the objectives.
        settings: of the polish.
    """

    cell: PackedCell
    objectives: tuple[str, ...]
    settings: PolishSettings

    def __call__(self) -> Polisher:
        """Load the compiled functions, or build them where they are missing."""
        use_one_thread()
        return self.cell.make(self._polisher)

    def _polisher(self, workcell: Workcell) -> Polisher:
        return Polisher(CandidateEvaluator(workcell, self.objectives), self.settings)


@dataclass(frozen=True)
class PolishRequest:
    """A front to polish.

    Attributes:
        settings: the campaign's, for the seed.
        algorithm, replica: whose front it is.
        front_x: (k, n_var) its decision vectors.
        recorded: the journal's blocks of an earlier, interrupted polish.
        paths: (m, n_path) known beside the front, see `Polisher.polish`; None for none.
    """

    settings: CampaignSettings
    algorithm: str
    replica: int
    front_x: Array
    recorded: tuple[bytes, ...]
    paths: Array | None = None


def polish_stage(
    settings: PolishSettings, known: Callable[[CampaignFolder], Array] | None = None
) -> Stage:
    """The stage that polishes the fronts of all replicas.

    Args:
        known: paths (m, n_path) that are known beside the fronts; None for none.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        PolishLedger(folder, settings, known).run(progress)

    def whole(folder: CampaignFolder) -> bool:
        # A front that cannot be read is the search's to compute anew.
        replicas = read_campaign(folder.root).replicas
        return all(_is_polished(folder, replica) for replica in replicas)

    return Stage("polish", run, asdict(settings), whole)


def _is_polished(folder: CampaignFolder, replica: Replica) -> bool:
    """Whether a front's polish is there; a damaged one is told and computed anew."""
    try:
        return read_polished(folder.root, replica, folder.workcell) is not None
    except ResultsError as error:
        warnings.warn(str(error), DamagedResultsWarning, stacklevel=2)
        return False


def polish_replica(
    polisher: Polisher, request: PolishRequest, emit: Callable[[bytes], None]
) -> PolishedFront:
    """Polish one front; attempts that were recorded are not repeated."""
    rng = request.settings.replica_rng(f"{request.algorithm}/polish", request.replica)
    return polisher.polish(
        request.front_x,
        rng,
        recorded=[_from_block(block, request) for block in request.recorded],
        emit=lambda outcome: emit(json.dumps(outcome_to_json(outcome)).encode()),
        paths=request.paths,
    )


def _block_of(lost: Lost) -> bytes:
    """The journal's block of an attempt that its process did not survive."""
    return json.dumps({"lost": lost.reason}).encode()


def _from_block(block: bytes, request: PolishRequest) -> PolishOutcome | Lost:
    try:
        values = outside.json_value(block)
        if not isinstance(values, dict):
            raise ResultsError("a recorded polish attempt is damaged (it is no object)")
        return Lost(str(values["lost"])) if "lost" in values else outcome_from_json(values)
    except (OutsideError, ResultsError) as error:
        raise ResultsError(
            f"{request.algorithm} replica {request.replica}: {error}; delete {JOURNAL} in its "
            "folder of polished fronts to polish it anew"
        ) from error


@dataclass(frozen=True)
class PolishedReplica:
    """One replica's polished front; arrays are read-only.

    Attributes:
        x: (k, n_var) non-dominated decision vectors, by increasing first objective.
        objectives: (k, 2).
        polished: (k,) whether the polish made the point.
        figures: what it took.
    """

    x: Array
    objectives: Array
    polished: np.ndarray[tuple[int], np.dtype[np.bool_]]
    figures: PolishEffort


def read_polished(root: Path, replica: Replica, workcell: Workcell) -> PolishedReplica | None:
    """The polished front of a replica; None where it was not polished.

    Raises:
        ResultsError: the file is damaged.
    """
    path = polished_folder(root, replica.algorithm, replica.replica) / POLISH
    if not path.exists():
        return None
    remedy = "--resume polishes it anew"
    document = _document(read_bytes(path), path, remedy)
    task, front = workcell.task, document.front
    if bool(front) != bool(len(replica.front)):
        raise ResultsError(f"{path}: damaged at front: found {len(front)} points; {remedy}")
    for k, point in enumerate(front):
        if len(point.x) != task.n_var:
            problem = f"found {len(point.x)} numbers; allowed are {task.n_var}"
        elif np.any(point.x < task.lower) or np.any(point.x > task.upper):
            problem = "is outside of the decision variables' bounds"
        else:
            continue
        raise ResultsError(f"{path}: damaged at front[{k}].x: {problem}; {remedy}")
    found = PolishedReplica(
        np.array([point.x for point in front]).reshape(-1, task.n_var),
        np.array([point.objectives for point in front]).reshape(-1, 2),
        np.array([point.polished for point in front], dtype=np.bool_),
        document.figures,
    )
    for array in (found.x, found.objectives, found.polished):
        array.setflags(write=False)
    return found


@lru_cache(maxsize=KEPT_FRONTS)
def _document(content: bytes, path: Path, remedy: str) -> PolishDocument:
    return record_of(PolishDocument, content, path, remedy)


class PolishLedger:
    """The fronts that are not polished, and the journals of those that are being worked on."""

    def __init__(
        self,
        folder: CampaignFolder,
        settings: PolishSettings,
        known: Callable[[CampaignFolder], Array] | None,
    ) -> None:
        self._folder, self._settings = folder, settings
        cell = PackedCell.of(folder.files)
        self._service = Service(
            PolisherSource(cell, folder.settings.objectives, settings),
            polish_replica,
            patience=MOST_SECONDS + JUDGING_SECONDS,
        )
        self._identity = {
            "campaign": identity(folder.settings, folder.root, folder.workcell),
            "polish": asdict(settings),
        }
        replicas = read_campaign(folder.root).replicas
        self._all = len(replicas)
        self._open = [replica for replica in replicas if not _is_polished(folder, replica)]
        self._journals: dict[int, Journal] = {}
        self._losses = Counter[int]()
        self._paths = known(folder) if known is not None and self._open else None

    def run(self, progress: Progress) -> None:
        """Polish all open fronts."""
        try:
            if self._open:
                # Compiles what is missing here, once, instead of in every worker.
                self._service.make_context()
            done = self._all - len(self._open)
            with progress.stage("polish", self._all, "fronts", done) as self._advance:
                executor_for(self._folder.execution).run(self._service, self)
        finally:
            self.close()

    def close(self) -> None:
        """Close the journals; they stay where they are."""
        for journal in self._journals.values():
            journal.close()

    _advance: Advance

    def _marker(self, replica: Replica) -> Path:
        return polished_folder(self._folder.root, replica.algorithm, replica.replica) / POLISH

    def _journal(self, index: int) -> Journal:
        if index not in self._journals:
            replica = self._open[index]
            path = self._marker(replica).with_name(JOURNAL)
            key = replica_identity(self._identity, replica.algorithm, replica.replica)
            self._journals[index] = Journal(path, key)
        return self._journals[index]

    def __len__(self) -> int:
        return len(self._open)

    def request(self, index: int) -> PolishRequest:
        """See `hybrid_opt.work.service.Ledger`."""
        replica = self._open[index]
        return PolishRequest(
            self._folder.settings,
            replica.algorithm,
            replica.replica,
            np.array(replica.front_x),
            tuple(self._journal(index).payloads),
            self._paths,
        )

    def heard(self, index: int, message: bytes) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        self._journal(index).append(message)

    def lost(self, index: int, reason: str) -> None:
        """A solver that crashes or hangs costs the attempt at hand only."""
        journal = self._journal(index)
        self._losses[index] += 1
        if self._losses[index] >= self._settings.attempts:
            give_up(reason)
        journal.append(_block_of(Lost(reason)))

    def answered(self, index: int, answer: PolishedFront) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        write_json(self._marker(self._open[index]), to_json(polish_document(answer)))
        self._journals.pop(index).discard()
        self._advance(1)
