"""The start branches of a study whose workcell leaves them to a competition."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybrid_opt.branches import BranchCompetition, search_branches
from hybrid_opt.campaign.folder import ExecutionSettings, require_usable
from hybrid_opt.campaign.settings import BRANCHES, CampaignSettings
from hybrid_opt.cell import Cell
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import read_record, to_json
from symbolic.read.cell import load
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
