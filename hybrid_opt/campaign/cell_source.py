"""The cells of a study: start branches that a competition decides, and workcells as values that go
to any process or machine, with resources made from them there."""

from __future__ import annotations

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
from symbolic.read.cell_files import CellFiles, drivable_files, unpack_cell
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
    """Store a decision in a results folder; returns what to print of it, '' without one."""
    if competition is None:
        return ""
    write_json(root / BRANCHES, to_json(competition))
    return f"{str(competition).capitalize()}.\n\n"


Made = TypeVar("Made")


def with_cell(of_workcell: Callable[[Workcell], Made], files: CellFiles) -> Made:
    """Result of a function of a stored workcell, whose files exist only as long as it runs."""
    with TemporaryDirectory() as folder:
        return of_workcell(unpack_cell(files, Path(folder)))


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


Cells = tuple[tuple[CellFiles, tuple[str, ...]], ...]
"""Files of cells, each with its objectives; the last one is the cell that robots drive."""


def cells_of(files: CellFiles, objectives: tuple[str, ...], driven: bool) -> Cells:
    """An experiment's own cell, and the drivable variant of it, whose contact model may differ.

    Args:
        driven: whether robots drive the experiment's own cell.
    """
    own = (files, objectives)
    if driven:
        return (own,)
    return (own, (drivable_files(files), force_kind(objectives).drivable))


def ready_cells(cells: Cells) -> tuple[ReadyCell, ...]:
    """Load the cells' compiled functions, or build them where they are missing; in any process."""
    return tuple(with_cell(partial(ReadyCell.of, names), files) for files, names in cells)
