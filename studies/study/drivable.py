"""The fronts of a drivable experiment, and the paths of another one that stand beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.results import CampaignResults, read_campaign
from hybrid_opt.campaign.settings import (
    DRIVABLE,
)
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_PAIRS
from hybrid_opt.indicators.selection import select
from symbolic.array import Array
from symbolic.path.pieces import same_paths
from symbolic.records import Task, Workcell

LEAST_FORCE = "least-force"
"""The path that the other experiment ends with, beside which the recommended carry stands."""


def known_paths(root: Path, task: Task) -> Array:
    """Paths (m, n_path) that another experiment ends with: of all polished fronts together the
    balanced one, of each of them both ends and the middle.

    Args:
        root: its results folder.
        task: whose waypoints they are told by.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    campaign = read_campaign(root)
    own, n = campaign.workcell.task, campaign.workcell.task.n_path
    found = [path[None] for path in least_force(campaign, task).values()]
    polished = [front for front in campaign.fronts if front.polished and len(front)]
    found += [same_paths(f.x[[0, len(f) // 2, -1], :n], own, task) for f in polished]
    return np.unique(np.concatenate(found), axis=0) if found else np.empty((0, task.n_path))


def least_force(campaign: CampaignResults, task: Task) -> dict[str, Array]:
    """The balanced path (n_path,) of all fronts of an experiment, by its label; empty where no
    carry was found.

    Args:
        task: the one whose waypoints describe the path.
    """
    evaluator = CandidateEvaluator(campaign.workcell, campaign.objectives)
    chosen = select(evaluator, np.concatenate([front.x for front in campaign.fronts]))
    if chosen is None:
        return {}
    own = campaign.workcell.task
    return {LEAST_FORCE: same_paths(chosen.carry.x[: own.n_path], own, task)[0]}


def is_drivable(workcell: Workcell, objectives: Sequence[str]) -> bool:
    """Whether an experiment already is the search for carries as robots drive them."""
    return workcell.task.time_law == "optimal" and tuple(objectives) in DRIVABLE_PAIRS


def drivable_root(root: Path, workcell: Workcell, objectives: Sequence[str]) -> Path:
    """Folder of a study's drivable experiment: one inside, unless it is the only experiment.

    Args:
        root: the study's results folder.
        workcell, objectives: of its first experiment.
    """
    return root if is_drivable(workcell, objectives) else root / DRIVABLE
