"""The stage that has selected carries driven in the simulated cell, and its table."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid_opt.campaign import CampaignFolder, Progress, Stage, executor_for
from hybrid_opt.campaign.layout import (
    HAND_MADE,
    RECOMMENDED,
    SELECTED,
    SIMULATED,
    polished_selected_file,
    selected_file,
)
from hybrid_opt.campaign.results import read_summary
from hybrid_opt.campaign.simulated import StoredSimulation, Whose, not_simulated, stored_simulation
from hybrid_opt.display.table import text_table
from hybrid_opt.errors import ResultsError, WitnessError
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import read_record, to_json
from hybrid_opt.store.trajectory_file import StoredTrajectory, read_trajectory
from hybrid_opt.witness.arms import CellWitness, account_of
from hybrid_opt.witness.reference import Control, driven_carry
from hybrid_opt.work.service import Emit, ListLedger, Service
from studies.study.terminal import number, title
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
    whose = Whose(one.label, one.digest, CONTROL)
    with TemporaryDirectory() as folder:
        cell = one.trajectory.open_cell(Path(folder))
        try:
            carry = driven_carry(cell, one.trajectory.x)
            found = account_of(cell, carry, CellWitness(cell.workcell), CONTROL)
        except (WitnessError, SettingsError) as error:
            return not_simulated(whose, str(error))
        return stored_simulation(found, whose)


HEADINGS = (
    "carry",
    "duration [s]",
    "holds from",
    "slips first",
    "pressed with",
    "peak predicted [N]",
    "peak simulated [N]",
    "largest error [%]",
    "slip [mm]",
    "arrives",
)

MEANING = (
    "Holds from: multiple of the planned forces, between a run that slips and one that holds. The "
    "other columns: a run pressed as said, forces of both robots, their error over the reference."
)


def simulation_rows(found: Sequence[StoredSimulation]) -> list[tuple[str, ...]]:
    """One row per carry, cells in the order of `HEADINGS`."""
    return [
        (
            one.label,
            number(one.duration, 2),
            f"{one.slips:.3f} to {one.holds:.3f}" if math.isfinite(one.holds) else one.problem,
            f"pad {one.pad} at {one.begins:.2f} s" if one.pad else "-",
            "robust forces" if one.robust else f"{number(one.factor, 1)} times the plan",
            *(" / ".join(number(force, 2) for force in forces) for forces in one.peaks),
            number(100.0 * one.largest_error, 1),
            number(1e3 * one.slip, 3),
            "yes" if one.arrives else "NO",
        )
        for one in found
    ]


def simulation_text(found: Sequence[StoredSimulation]) -> str:
    """The table for a terminal."""
    rows = [HEADINGS, *simulation_rows(found)]
    return f"In the simulated cell\n{text_table(rows, left=(0, 2, 3, 4))}\n{MEANING}"
