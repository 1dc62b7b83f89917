"""The cells of a study: start branches that a competition decides, and workcells as values that go
to any process or machine, with resources made from them there."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np

from hybrid_opt.branches import BranchCompetition, search_branches
from hybrid_opt.campaign.folder import ExecutionSettings, require_usable
from hybrid_opt.campaign.settings import BRANCHES, CampaignSettings
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import force_kind
from hybrid_opt.job.plan import JobModel
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import read_record, to_json
from symbolic.read.cell import load
from symbolic.read.cell_files import (
    CellFiles,
    cell_from_json,
    cell_to_json,
    drivable_files,
    unpack_cell,
)
from symbolic.records import SEARCHED, Workcell

_ANEW = "start the study anew"

SHARE = 2
"""The competition may spend as many evaluations as this many replicas."""


def decided_cell(
    workcell: Workcell, settings: CampaignSettings, execution: ExecutionSettings
) -> tuple[Workcell, BranchCompetition | None]:
    """The workcell with its start branches decided, and how; None where its file decides them.

    A campaign that is continued keeps the decision that it began with.

    Raises:
        DualArmError: no pair of branches holds any trajectory, or the stored decision is damaged.
    """
    if SEARCHED not in workcell.start_branch:
        return workcell, None
    stored = execution.output / BRANCHES
    if execution.resume and stored.exists():
        competition = read_record(BranchCompetition, stored, _ANEW)
    else:
        require_usable(execution)
        cell = Cell(workcell, settings.objectives)
        rng = np.random.default_rng(settings.seed)
        competition = search_branches(cell, evaluations=SHARE * settings.evaluations, rng=rng)
    return load(workcell.source, decided=competition.winner, text=workcell.text), competition


def read_branches(root: Path) -> BranchCompetition | None:
    """How the start branches of a study in a results folder were decided; None where its workcell
    decides them.

    Raises:
        ResultsError: the stored decision is damaged.
    """
    stored = root / BRANCHES
    return read_record(BranchCompetition, stored, _ANEW) if stored.exists() else None


def store_branches(root: Path, competition: BranchCompetition | None) -> str:
    """Store a decision in a results folder; what to tell of it, '' without one."""
    if competition is None:
        return ""
    write_json(root / BRANCHES, to_json(competition))
    return f"{str(competition).capitalize()}.\n\n"


Made = TypeVar("Made")


@dataclass(frozen=True)
class PackedCell:
    """A workcell with its files.

    Attributes:
        text: JSON of `symbolic.read.cell_files.cell_to_json`.
    """

    text: str

    @classmethod
    def of(cls, files: CellFiles) -> PackedCell:
        """The value for a stored workcell."""
        return cls(json.dumps(cell_to_json(files)))

    def make(self, of_workcell: Callable[[Workcell], Made]) -> Made:
        """Result of a function of the workcell, whose files exist only as long as it runs."""
        with TemporaryDirectory() as folder:
            return of_workcell(unpack_cell(cell_from_json(json.loads(self.text)), Path(folder)))


@dataclass(frozen=True)
class ReadyCell:
    """A cell with all loaded that judges, times and plans its carries.

    Attributes:
        cell: the cell.
        jobs: plans its jobs; `jobs.timing` times its paths.
    """

    cell: Cell
    jobs: JobModel

    @classmethod
    def of(cls, objectives: tuple[str, ...], workcell: Workcell) -> ReadyCell:
        """Load what is loaded when it is first needed: the cell's files are there only now."""
        cell = Cell(workcell, objectives)
        cell.carry(cell.initial)
        cell.timing_model.search_carry(cell.initial)
        if workcell.task.time_law == "optimal" and cell.force_kind.robust:
            cell.timing_model.search_timing(cell.initial)
        return cls(cell, JobModel(cell.compiled, cell.timing_model))


Cells = tuple[tuple[PackedCell, tuple[str, ...]], ...]
"""Cells of a study, each with its objectives; the last one is the cell that robots drive."""


def cells_of(files: CellFiles, objectives: tuple[str, ...], driven: bool) -> Cells:
    """An experiment's own cell, and the drivable variant of it, whose contact model may differ.

    Args:
        driven: whether robots drive the experiment's own cell.
    """
    own = (PackedCell.of(files), objectives)
    if driven:
        return (own,)
    return (own, (PackedCell.of(drivable_files(files)), force_kind(objectives).drivable))


def ready_cells(cells: Cells) -> tuple[ReadyCell, ...]:
    """Load the cells' compiled functions, or build them where they are missing; in any process."""
    return tuple(cell.make(partial(ReadyCell.of, names)) for cell, names in cells)
