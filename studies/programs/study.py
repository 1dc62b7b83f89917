"""What `studies.run` and `studies.rack` do: the settings that options give, and their study."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings, Progress
from hybrid_opt.campaign.experiment_stage import drivable_settings
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES, FORCE_PAIRS, PAPER_OBJECTIVES
from hybrid_opt.polishing.settings import (
    PolishSettings,
    quick_settings,
    usual_settings,
)
from hybrid_opt.recommending.choice import Wish
from hybrid_opt.witness.box import mujoco_module
from studies.program import load_workcell
from studies.report.stage import follow_looks
from studies.run import QUICK_EVALUATIONS, QUICK_REPLICAS
from studies.study.drivable import is_drivable
from studies.study.stages import StudySettings, run_study

PAGE = "report.html"
"""The report in a results folder."""


def make_study(path: Path, options: argparse.Namespace, with_paper: bool) -> None:
    """Make a study, print its figures, and show what was asked for.

    Args:
        path: the workcell's file.
        with_paper: whether the paper's figures stand beside its own.

    Raises:
        DualArmError: the workcell, an option or the results folder is wrong, or work failed.
    """
    if options.simulate:
        mujoco_module()  # told before hours of work
    cell = load_workcell(path)
    if options.recommend_only:
        drivable = Cell(cell).drivable()  # keeps the file of its workcell
        cell = drivable.workcell
    driven = cell.task.time_law == "optimal"
    settings = campaign_settings(options, DRIVABLE_OBJECTIVES if driven else PAPER_OBJECTIVES)
    alone = is_drivable(cell, settings.objectives)
    polishable = alone or (not driven and settings.objectives in FORCE_PAIRS)
    name = f"{path.stem}-recommended" if options.recommend_only else path.stem
    execution = ExecutionSettings(
        output=options.output or Path("results") / name,
        jobs=options.jobs,
        executor=options.executor,
        scheduler=options.scheduler,
        resume=options.resume,
        overwrite=options.overwrite,
    )
    study = StudySettings(
        polish=polish_settings(options, polishable, usual_settings(cell.task.time_law)),
        drivable=options.drivable,
        drivable_polish=polish_settings(options, True, usual_settings("optimal")),
        wish=Wish(options.duration, options.force_limit, options.payload),
        simulate=options.simulate,
        report=options.report and not options.recommend_only,
        recommend_only=options.recommend_only,
        with_paper=with_paper,
        pdf=not options.quick,
    )
    print(run_study(cell, settings, execution, Progress(not options.quiet), study))
    print(f"\nResults: {execution.output}")
    if study.report:
        print(f"Report: {execution.output / PAGE}")
    follow_looks(execution.output, options)


def campaign_settings(
    options: argparse.Namespace, objectives: tuple[str, ...] = PAPER_OBJECTIVES
) -> CampaignSettings:
    """The settings that the options give.

    Args:
        objectives: what is minimised where the options do not say.

    Returns:
        Those of the drivable experiment where only a recommendation is asked for.

    Raises:
        SettingsError: a value is not allowed.
    """
    usual = CampaignSettings()
    evaluations, replicas = options.evaluations, options.replicas
    if evaluations is None:
        evaluations = QUICK_EVALUATIONS if options.quick else usual.evaluations
    if replicas is None:
        replicas = QUICK_REPLICAS if options.quick else usual.replicas
        replicas = 1 if options.recommend_only else replicas
    algorithms = usual.algorithms[: 1 if options.recommend_only else None]
    settings = CampaignSettings(
        algorithms=tuple(options.algorithm or algorithms),
        evaluations=evaluations,
        replicas=replicas,
        seed=options.seed,
        objectives=tuple(options.objective or objectives),
        constraint_handling=options.constraint_handling,
        first_generation=options.first_generation,
        populations=tuple(options.population or ()),
    )
    return drivable_settings(settings) if options.recommend_only else settings


def polish_settings(
    options: argparse.Namespace, usual: bool, settings: PolishSettings
) -> PolishSettings | None:
    """How the options want fronts polished, None for not at all.

    Args:
        usual: whether they are polished where the options do not say.
        settings: where they say nothing of them.

    Raises:
        SettingsError: a value is not allowed.
    """
    if not (usual if options.polish is None else options.polish):
        return None
    chosen = quick_settings() if options.quick else settings
    asked = options.polish_attempts
    attempts = chosen.attempts if asked is None else asked
    return replace(chosen, attempts=attempts, solver=options.polish_solver)
