"""A whole study of a workcell: search, then everything that is made from its results."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from hybrid_opt.building import build_study
from hybrid_opt.campaign import (
    CampaignFolder,
    CampaignSettings,
    ExecutionSettings,
    Progress,
    Stage,
    check_stages,
    open_folder,
    run_stages,
    search_stage,
)
from hybrid_opt.campaign.branch_choice import decided_cell, store_branches
from hybrid_opt.campaign.experiment_stage import drivable_stage
from hybrid_opt.campaign.layout import DRIVABLE, SUMMARY
from hybrid_opt.campaign.polish_stage import polish_stage
from hybrid_opt.campaign.results import read_summary
from hybrid_opt.campaign.simulated import read_simulations
from hybrid_opt.cell import Cell
from hybrid_opt.polishing.drive import is_polishable
from hybrid_opt.polishing.polisher import knows_forces
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.recommending.choice import Wish
from hybrid_opt.static_hold import require_hold
from studies.report.stage import report_stage
from studies.study.drivable import is_drivable, jerk_costs, jerk_text, known_paths
from studies.study.recommendation import recommendation_stage, study_words
from studies.study.simulation import simulation_stage, simulation_text
from studies.study.summary import summary_stage
from studies.study.terminal import terminal_summary
from studies.study.timing import timing_stage
from symbolic.array import Array
from symbolic.records import Workcell

NOT_ASKED = "drivable carries were not searched for (--no-drivable)"
"""Why a study without them recommends none."""


@dataclass(frozen=True)
class StudySettings:
    """Settings of the parts of a study after its search.

    Attributes:
        polish: how fronts are polished, None for not at all.
        drivable: whether carries are also searched for as robots drive them.
        drivable_polish: how their fronts are polished, None for not at all.
        wish: what is asked of the recommended one of them.
        simulate: whether the selected carries are driven in the simulated cell.
        report: whether figures, tables and the page are written.
        with_paper: whether the figures stand beside those that the paper states.
        pdf: whether pictures are also written as PDF.
        recommend_only: whether nothing is made that the recommendation does not need.
    """

    polish: PolishSettings | None = None
    drivable: bool = True
    drivable_polish: PolishSettings | None = None
    wish: Wish = field(default_factory=Wish)
    simulate: bool = False
    report: bool = True
    with_paper: bool = False
    pdf: bool = True
    recommend_only: bool = False


def stages(study: StudySettings, alone: bool = False) -> tuple[Stage, ...]:
    """The stages of a study, in order.

    Args:
        alone: whether its first experiment is the drivable one already, so that it has no other.
    """
    every = [search_stage()]
    if study.polish is not None:
        every.append(polish_stage(study.polish))
    if study.drivable and not alone:
        inner = []
        if study.drivable_polish is not None:
            beside = _paths_beside if study.polish is not None else None
            inner.append(polish_stage(study.drivable_polish, beside))
        driven = [search_stage(), *inner, summary_stage(), timing_stage(last=True)]
        every.append(drivable_stage(driven))
    if study.drivable:
        every.append(recommendation_stage(study.wish))
    every.append(summary_stage("" if study.drivable else NOT_ASKED))
    if study.recommend_only:
        return tuple(every)
    every.append(timing_stage(study.wish.force, last=alone))
    if study.simulate:
        every.append(simulation_stage())
    if study.report:
        every.append(report_stage(study.with_paper, study.pdf))
    return tuple(every)


def _paths_beside(folder: CampaignFolder) -> Array:
    """Paths that a study's first experiment ended with; the drivable one lies in its folder."""
    return known_paths(folder.root.parent)


def run_study(
    workcell: Workcell,
    settings: CampaignSettings,
    execution: ExecutionSettings,
    progress: Progress,
    study: StudySettings,
) -> str:
    """Carry out all stages that are not done, and return the figures as text.

    Args:
        workcell: the cell, read from its file.
        settings: what to compute.
        execution: how.
        progress: where to show it.
        study: what is made of the results.

    Raises:
        DualArmError: the workcell, a setting or the results folder is wrong, or work failed.
    """
    require_hold(workcell)  # before any work
    cell, competition = decided_cell(workcell, settings, execution)
    alone = is_drivable(cell, settings.objectives)
    if not alone and not knows_forces(cell, settings.objectives):
        progress.note("the polish of robust forces knows two round pads that face one another: off")
        study = replace(study, polish=None)
    polish = study.polish if alone else study.drivable_polish
    driven = Cell(cell).drivable().workcell if study.drivable and not alone else cell
    if polish is not None and not is_polishable(driven):
        progress.note(
            "the drivable carries of this cell are not polished, only searched: the polish of time "
            'and force knows the allocation "paper", and "soft-finger" with two pads of opposite '
            f'normals; here it is "{driven.task.allocation}"'
        )
        study = replace(study, drivable_polish=None, polish=None if alone else study.polish)
    with open_folder(settings, execution, cell) as folder:
        told = store_branches(folder.root, competition)
        every = stages(study, alone)
        check_stages(folder, every)
        whole = Cell(cell, settings.objectives)
        build_study(
            whole,
            progress,
            polish=study.polish is not None or study.drivable_polish is not None,
            drivable=study.drivable and not alone,
        )
        whole.require_hold()
        run_stages(folder, every, progress)
        return told + study_text(folder.root, study.with_paper, study.recommend_only)


def study_text(root: Path, with_paper: bool, brief: bool = False) -> str:
    """The figures of a finished study for a terminal, the carry to run first.

    Args:
        with_paper: whether to print what the paper states.
        brief: whether the carry to run is all that is told, where there is one.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    summary = read_summary(root)
    words = study_words(summary, str(root))
    beside = (root / DRIVABLE / SUMMARY).exists()
    drivable = read_summary(root / DRIVABLE) if beside else None
    costs = jerk_text(jerk_costs(root / DRIVABLE if beside else root))
    carry = "" if words is None else words.terminal()
    if carry and brief:
        return carry
    told = terminal_summary(summary, with_paper, carry, drivable, costs)
    simulations = read_simulations(root)
    return f"{told}\n\n{simulation_text(simulations)}" if simulations else told
