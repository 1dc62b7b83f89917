"""The stage that has selected carries driven in the simulated cell, and its table."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid_opt.campaign import CampaignFolder, Progress, Stage, executor_for
from hybrid_opt.campaign.documents import (
    HAND_MADE,
    RECOMMENDED,
    SELECTED,
    SIMULATED,
    polished_selected_file,
    selected_file,
)
from hybrid_opt.campaign.results import read_summary
from hybrid_opt.campaign.simulated import StoredSimulation, stored_simulation
from hybrid_opt.errors import ResultsError, WitnessError
from hybrid_opt.metaheuristics.registry import title
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import read_record, to_json
from hybrid_opt.store.trajectory_file import StoredTrajectory, read_trajectory
from hybrid_opt.witness.arms import CellWitness, account_of
from hybrid_opt.witness.reference import Control, driven_carry
from hybrid_opt.work.service import Emit, ListLedger, Service
from symbolic.errors import SettingsError

CONTROL: Control = "leader"


@dataclass(frozen=True)
class Simulated:
    """A carry to simulate.

    Attributes:
        name: of its file in the results, without suffix.
        label: for people.
        trajectory: as its file has it.
        digest: SHA-256 of that file.
    """

    name: str
    label: str
    trajectory: StoredTrajectory
    digest: str


def simulation_stage() -> Stage:
    """The stage that writes `simulated/`: one document per carry that the report shows."""
    return Stage("simulation", _run, {"control": CONTROL})


def _run(folder: CampaignFolder, progress: Progress) -> None:
    wanted = wanted_carries(folder.root)
    (folder.root / SIMULATED).mkdir(exist_ok=True)
    kept = {one.name for one in wanted}
    for path in (folder.root / SIMULATED).glob("*.json"):
        if path.stem not in kept:
            path.unlink()
    left = [one for one in wanted if not is_done(folder.root, one)]
    with progress.stage("simulation", len(wanted), "carries") as advance:
        for _ in range(len(wanted) - len(left)):
            advance(1)
        ledger = Written(left, folder.root, lambda: advance(1))
        executor_for(folder.execution).run(Service(_nothing, _simulated), ledger)


class Written(ListLedger[Simulated, StoredSimulation]):
    """Writes every answer as it comes, so that what is interrupted goes on from there."""

    def __init__(self, wanted: list[Simulated], root: Path, done: Callable[[], None]) -> None:
        super().__init__(wanted, done)
        self._wanted, self._root = wanted, root

    def answered(self, index: int, answer: StoredSimulation) -> None:
        """See `Ledger`."""
        write_json(_file(self._root, self._wanted[index].name), to_json(answer))
        super().answered(index, answer)


def _file(root: Path, name: str) -> Path:
    return root / SIMULATED / f"{name}.json"


def is_done(root: Path, one: Simulated) -> bool:
    """Whether this very trajectory was simulated."""
    try:
        stored = read_record(StoredSimulation, _file(root, one.name), "")
    except ResultsError:
        return False
    return stored.trajectory == one.digest and stored.controller == CONTROL


def wanted_carries(root: Path) -> list[Simulated]:
    """The carries that a report shows: hand-made, best of each algorithm, recommended."""
    files = {"0-hand-made": ("hand-made", root / SELECTED / HAND_MADE)}
    for place, (name, found) in enumerate(read_summary(root).algorithms.items(), start=1):
        if found.representative is None:
            continue
        polished = polished_selected_file(root, name, found.representative)
        own = selected_file(root, name, found.representative)
        best = (f"{title(name)}, polished", polished) if polished.exists() else (title(name), own)
        files[f"{place}-{name}"] = best
    files["9-recommended"] = ("recommended", root / RECOMMENDED)
    return [
        Simulated(name, label, read_trajectory(path), _digest(path))
        for name, (label, path) in files.items()
        if path.exists()
    ]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _nothing() -> None:
    """Every trajectory brings its own cell."""


def _simulated(_: None, one: Simulated, emit: Emit) -> StoredSimulation:
    whose = (one.label, one.digest, CONTROL)
    with TemporaryDirectory() as folder:
        cell = one.trajectory.open_cell(Path(folder))
        try:
            carry = driven_carry(cell, one.trajectory.x)
            found = account_of(cell, carry, CellWitness(cell.workcell), CONTROL)
        except (WitnessError, SettingsError) as error:
            return StoredSimulation(*whose, problem=str(error))
        return stored_simulation(found, *whose)
