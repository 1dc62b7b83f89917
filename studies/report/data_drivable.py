"""Gathers what a report shows of a study's drivable experiment."""

from __future__ import annotations

import numpy as np

from hybrid_opt.campaign.layout import CONFIGURATION, RECOMMENDED
from hybrid_opt.campaign.results import CampaignResults, read_summary
from hybrid_opt.campaign.summary import CampaignSummary
from hybrid_opt.evaluate.objectives import duration_unit
from hybrid_opt.store.trajectory_file import read_trajectory
from studies.report.records import DrivableFront, DrivableReport
from studies.study.drivable import ReplicaFront, drivable_fronts, drivable_root, jerk_costs
from symbolic.array import Array
from symbolic.read.cell_files import collect_cell


def gather_drivable(study: CampaignResults, summary: CampaignSummary) -> DrivableReport | None:
    """The drivable experiment of a study; None where it has none.

    Args:
        study: its first experiment.
        summary: of the study, which says whether a carry is recommended.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    place = drivable_root(study.root, study.workcell, study.objectives)
    if not (place / CONFIGURATION).exists():
        return None
    found, own = drivable_fronts(place), read_summary(place)
    shown = [
        _front(found.results, front)
        for front in found.fronts
        if own.algorithms[front.algorithm].representative == front.replica and len(front.x)
    ]
    recommended = None
    if summary.recommendation is not None:
        recommended = read_trajectory(study.root / RECOMMENDED).x
    workcell = found.results.workcell
    files, jerk = collect_cell(workcell), jerk_costs(place)
    return DrivableReport(workcell, files, own, tuple(shown), recommended, jerk)


def _front(results: CampaignResults, front: ReplicaFront) -> DrivableFront:
    index = results.algorithms.index(front.algorithm)
    workcell = results.workcell
    scale = np.array([float(workcell.task.reference_force.max()), duration_unit(workcell)])
    cloud: Array = np.zeros((0, 2))
    if not front.polished:
        found = results.of(front.algorithm)[front.replica].evaluations
        cloud = found.objectives[found.feasible][:, ::-1] * scale
    duration, force = (front.objectives * scale[::-1]).T
    return DrivableFront(index, front, force, duration, cloud)
