"""The stage of a study that polishes its fronts, and the files it leaves.

Fronts of both peak forces are polished replica by replica. Drivable fronts are polished as one,
their union: the polish begins with the best of all known paths, so the polished fronts of two
replicas would share most of their points.

Per front a folder `polished/ALGORITHM/NN`: `polish.json`, written last, holds the front, every
attempt and what it took; `journal.bin` holds the attempts of a polish in progress, so that an
interrupted one repeats none.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from functools import partial

import numpy as np

from hybrid_opt.campaign.folder import CampaignFolder
from hybrid_opt.campaign.journal import ReplicaLedger, ReplicaRequest
from hybrid_opt.campaign.results import is_whole, read_campaign, read_polished
from hybrid_opt.campaign.settings import JOURNAL, POLISH, polished_folder
from hybrid_opt.campaign.stages import Stage, with_cell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.front import Front
from hybrid_opt.polishing.front import FailedAttempt, use_one_thread
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.records import PolishedFront, PolishOutcome
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers.base import MOST_SOLVE_SECONDS
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import from_json, json_of, to_json, write_json
from hybrid_opt.work.service import Service, give_up
from symbolic.array import Array
from symbolic.read.cell_files import CellFiles
from symbolic.records import Workcell

JUDGING_SECONDS = 540.0
"""Time that an attempt may take besides one solve, or the front before the first one. An idle
core needs ten seconds; the clock is the wall's, and machines with twenty times more work were
seen."""

_ANEW = f"delete {JOURNAL} in its folder of polished fronts to polish it anew"


def polisher_source(
    cell: CellFiles, objectives: tuple[str, ...], settings: PolishSettings
) -> Callable[[], Polisher]:
    """What makes a polisher, in any process."""
    return partial(with_cell, partial(_polisher, objectives, settings), cell)


def _polisher(objectives: tuple[str, ...], settings: PolishSettings, cell: Workcell) -> Polisher:
    use_one_thread()
    return Polisher(CandidateEvaluator(cell, objectives), settings)


def polish_stage(
    settings: PolishSettings, known: Callable[[CampaignFolder], Array] | None = None
) -> Stage:
    """The stage that polishes the fronts of `CampaignResults.to_polish`.

    Args:
        known: paths (m, n_path) that are known beside the fronts; None for none.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        PolishLedger(folder, settings, known).run(progress)

    def whole(folder: CampaignFolder) -> bool:
        # A front that cannot be read is the search's to compute anew.
        return all(_is_polished(folder, front) for front in read_campaign(folder.root).to_polish)

    return Stage("polish", run, asdict(settings), whole)


def _is_polished(folder: CampaignFolder, front: Front) -> bool:
    """Whether a front's polish is there; a damaged one is computed anew."""
    path = polished_folder(folder.root, *front.key) / POLISH
    return is_whole(path.exists(), lambda: read_polished(folder.root, front))


def polish_replica(
    polisher: Polisher, request: ReplicaRequest, emit: Callable[[bytes], None]
) -> PolishedFront:
    """Polish one front; attempts that were recorded are not repeated."""
    rng = request.settings.replica_rng(f"{request.algorithm}/polish", request.replica)
    return polisher.polish(
        request.x,
        rng,
        recorded=[_from_block(block, request) for block in request.recorded],
        on_outcome=lambda outcome: emit(json.dumps(to_json(outcome)).encode()),
        paths=request.paths,
    )


def _from_block(block: bytes, request: ReplicaRequest) -> PolishOutcome | FailedAttempt:
    of = f"{request.algorithm} replica {request.replica}: a recorded attempt of the polish"
    values = json_of(block, of, _ANEW)
    if isinstance(values, dict) and "lost" in values:
        return FailedAttempt(str(values["lost"]))
    return from_json(PolishOutcome, values, of, _ANEW)


class PolishLedger(ReplicaLedger):
    """The fronts that are not polished; see `ReplicaLedger`."""

    def __init__(
        self,
        folder: CampaignFolder,
        settings: PolishSettings,
        known: Callable[[CampaignFolder], Array] | None,
    ) -> None:
        fronts = read_campaign(folder.root).to_polish
        self._all, self._settings = len(fronts), settings
        self._open = [front for front in fronts if not _is_polished(folder, front)]
        left = {front.key: polished_folder(folder.root, *front.key) for front in self._open}
        super().__init__(folder, left, polish=asdict(settings))
        self._losses = Counter[int]()
        self._paths = known(folder) if known is not None and self._open else None

    def run(self, progress: Progress) -> None:
        """Polish all open fronts."""
        objectives = self.folder.settings.objectives
        source = polisher_source(self.folder.files, objectives, self._settings)
        service = Service(source, polish_replica, patience=MOST_SOLVE_SECONDS + JUDGING_SECONDS)
        with closing(self):
            done = self._all - len(self)
            self.work(service, progress, ("polish", "fronts"), self._all, done)

    def request(self, index: int) -> ReplicaRequest:
        """See `hybrid_opt.work.service.Ledger`."""
        return self.replica_request(index, np.array(self._open[index].x), self._paths)

    def lost(self, index: int, reason: str) -> None:
        """A solver that crashes or hangs costs the attempt at hand only."""
        journal = self.journal(index)
        self._losses[index] += 1
        if self._losses[index] >= self._settings.attempts:
            give_up(reason)
        journal.append(json.dumps({"lost": reason}).encode())

    def answered(self, index: int, answer: PolishedFront) -> None:
        """See `hybrid_opt.work.service.Ledger`."""
        write_json(self.left[index][1] / POLISH, to_json(answer))
        self.discard(index)
        self.advance(1)
