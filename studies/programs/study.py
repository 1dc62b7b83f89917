"""A whole study of a workcell: its settings from the options, its stages in order, its figures."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path

from hybrid_opt.campaign import (
    CampaignFolder,
    CampaignSettings,
    ExecutionSettings,
    Stage,
    check_stages,
    open_folder,
    run_stages,
    search_stage,
)
from hybrid_opt.campaign.polish_stage import polish_stage
from hybrid_opt.campaign.settings import ALGORITHMS, DRIVABLE, SUMMARY, chosen
from hybrid_opt.campaign.stages import (
    build_study,
    decided_cell,
    drivable_settings,
    drivable_stage,
    store_branches,
)
from hybrid_opt.cell import Cell
from hybrid_opt.display.table import counted
from hybrid_opt.evaluate.objectives import (
    DRIVABLE_OBJECTIVES,
    FORCE_PAIRS,
    PAPER_OBJECTIVES,
    force_kind,
)
from hybrid_opt.extras.bundles.targets import missing_text
from hybrid_opt.polishing.drive import UNPOLISHABLE, is_polishable
from hybrid_opt.polishing.polisher import has_polishable_forces
from hybrid_opt.polishing.settings import (
    PolishSettings,
    default_settings,
    quick_settings,
)
from hybrid_opt.progress import Progress
from hybrid_opt.recommending.choice import Wish
from hybrid_opt.robust.budget import budget_text
from hybrid_opt.static_hold import require_hold
from studies.options import QUICK_EVALUATIONS, QUICK_REPLICAS
from studies.program import load_workcell
from studies.report import PAGE, TABLES
from studies.study.recommendation import (
    EXPORT_TARGET,
    is_drivable,
    known_paths,
    recommendation_stage,
)
from studies.study.simulation import (
    limits_on_jerk,
    read_simulations,
    simulation_stage,
    timing_stage,
)
from studies.study.summary import read_summary, summary_stage
from studies.study.tables import effort, study_tables
from symbolic.array import Array
from symbolic.records import Workcell

OPENING = ("table1_quality", "simulation")
"""Tables that the terminal shows if the report has all tables; 25 lines in total."""


NOT_ASKED = "drivable carries were not searched for (--no-drivable)"
"""Reason why a study without drivable carries recommends none."""


@dataclass(frozen=True)
class StudySettings:
    """Settings of the parts of a study after its search.

    Attributes:
        polish: settings of the polish; None for no polish.
        drivable: True to search drivable carries too.
        drivable_replicas: number of replicas of the drivable search per algorithm; None for the
            default of `drivable_settings`.
        drivable_polish: settings of the polish of drivable fronts; None for no polish.
        wish: what the recommended carry should be best at.
        target: target of the export that the recommendation names; None for any simulator.
        simulate: True to simulate the selected carries in the whole cell.
        report: True to write figures, tables and the page.
        with_paper: True to show the paper's figures beside the study's.
        paper: True for a report with the paper's pictures.
        pdf: True to write pictures as PDF too.
        recommend_only: True to compute only what the recommendation needs.
    """

    polish: PolishSettings | None = None
    drivable: bool = True
    drivable_replicas: int | None = None
    drivable_polish: PolishSettings | None = None
    wish: Wish = field(default_factory=Wish)
    target: str | None = None
    simulate: bool = False
    report: bool = True
    with_paper: bool = False
    paper: bool = False
    pdf: bool = True
    recommend_only: bool = False


def stages(study: StudySettings, alone: bool = False) -> tuple[Stage, ...]:
    """Return the stages of a study in order.

    Args:
        study: choice of the stages and their settings.
        alone: True if the first experiment already searches for drivable carries, so that the study
            has no second, drivable experiment.
    """
    every = [search_stage()]
    if study.polish is not None:
        every.append(polish_stage(study.polish))
    if study.drivable and not alone:
        inner = []
        if study.drivable_polish is not None:
            beside = _paths_beside if study.polish is not None else None
            inner.append(polish_stage(study.drivable_polish, beside))
        driven = [search_stage(), *inner, summary_stage(), timing_stage(curves=False)]
        every.append(drivable_stage(driven, study.drivable_replicas))
    if study.drivable:
        every.append(recommendation_stage(study.wish, study.target or EXPORT_TARGET))
    every.append(summary_stage("" if study.drivable else NOT_ASKED))
    if study.recommend_only:
        return tuple(every)
    every.append(timing_stage())
    if study.simulate:
        every.append(simulation_stage())
    if study.report:
        every.append(report_stage(study))
    return tuple(every)


def report_stage(study: StudySettings) -> Stage:
    """Return the stage that writes pictures, tables and the page."""
    settings = {"with_paper": study.with_paper, "pdf": study.pdf, "paper": study.paper}

    def run(folder: CampaignFolder, progress: Progress) -> None:
        # Drawing libraries are heavy: they are imported when something is drawn.
        from studies.report.generate import make_report

        make_report(folder.root, settings, progress, folder.workers)

    return Stage("report", run, settings)


def _paths_beside(folder: CampaignFolder) -> Array:
    """Return the paths (m, n_path) with which the polish of a study's drivable experiment starts:
    paths of the fronts of the first experiment.

    Args:
        folder: folder of the drivable experiment, inside that of the study.
    """
    return known_paths(folder.root.parent, folder.workcell.task)


def run_study(
    workcell: Workcell,
    settings: CampaignSettings,
    execution: ExecutionSettings,
    progress: Progress,
    study: StudySettings,
) -> str:
    """Run all stages of a study that are not done yet. Return its results as text for a terminal.

    Args:
        workcell: the cell; it is read again from its file.
        settings: settings of the campaign, which determine its results.
        execution: settings without influence on the results, such as the number of processes.
        progress: receives messages on the progress.
        study: choice of the stages and their settings.

    Raises:
        DualArmError: the workcell, a setting or the results folder is invalid, or a stage failed.
    """
    require_hold(workcell)  # before any work
    progress.note(budget_text(workcell))
    cell, competition = decided_cell(workcell, settings, execution)
    alone = is_drivable(cell, settings.objectives)
    if not alone and not has_polishable_forces(cell, settings.objectives):
        progress.note("the polish of robust forces knows two pads with opposite normals: off")
        study = replace(study, polish=None)
    polish = study.polish if alone else study.drivable_polish
    driven = Cell(cell).drivable().workcell if study.drivable and not alone else cell
    if polish is not None and not is_polishable(driven, force_kind(settings.objectives).robust):
        progress.note(
            f"the drivable carries of this cell are only searched, not polished: {UNPOLISHABLE}"
        )
        study = replace(study, drivable_polish=None, polish=None if alone else study.polish)
    whole = Cell(cell, settings.objectives)

    def prepare() -> None:
        polish = study.polish is not None or study.drivable_polish is not None
        build_study(whole, progress, polish, drivable=study.drivable and not alone)
        whole.require_hold()

    if execution.overwrite:  # a cell that cannot be computed costs no results
        prepare()
    with open_folder(settings, execution, cell) as folder:
        told = store_branches(folder.root, competition)
        every = stages(study, alone)
        check_stages(folder, every)
        prepare()
        run_stages(folder, every, progress)
        return told + study_text(folder.root, study.with_paper, study.recommend_only)


def study_text(root: Path, with_paper: bool, brief: bool = False) -> str:
    """Format the results of a finished study for a terminal: the recommended carry, then tables.

    Args:
        root: results folder of the study.
        with_paper: True to show the paper's values beside those of the study.
        brief: True to show only the recommended carry, if there is one.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    summary = read_summary(root)
    opening = summary.answer(str(root))
    carry = "" if opening is None else opening.terminal()
    if carry and brief:
        return carry
    beside = (root / DRIVABLE / SUMMARY).exists()
    tables = study_tables(
        summary,
        read_summary(root / DRIVABLE) if beside else None,
        limits_on_jerk(root / DRIVABLE if beside else root, summary.recommendation),
        read_simulations(root),
        with_paper,
    )
    if (root / TABLES).exists():
        shown = [table for table in tables if table.name in OPENING]
    else:
        shown = [*tables, effort(summary)]
    settings = summary.settings
    made = (
        f"{summary.workcell.name}: {counted(settings.replicas, 'replica')} of "
        f"{settings.evaluations} evaluations, seed {settings.seed}; all of it in {root}"
    )
    return "\n\n".join([*([carry] if carry else []), *(t.text() for t in shown), made])


def make_study(path: Path, options: argparse.Namespace, with_paper: bool) -> None:
    """Make a study of a workcell file, print its figures, and show the requested views.

    Args:
        path: path of the workcell file.
        options: parsed command line.
        with_paper: True to show the paper's values beside those of the study.

    Raises:
        DualArmError: the workcell, an option or the results folder is invalid, or a stage failed.
    """
    cell = load_workcell(path)
    if options.target is not None:
        print(missing_text(options.target, cell), flush=True)
    if options.recommend_only:
        drivable = Cell(cell).drivable()  # keeps the file of its workcell
        cell = drivable.workcell
    driven = cell.task.law.is_drivable
    settings = campaign_settings(options, DRIVABLE_OBJECTIVES if driven else PAPER_OBJECTIVES)
    alone = is_drivable(cell, settings.objectives)
    polishable = alone or (not driven and settings.objectives in FORCE_PAIRS)
    execution = ExecutionSettings(
        output=options.output,
        jobs=options.jobs,
        executor=options.executor,
        scheduler=options.scheduler,
        resume=options.resume,
        overwrite=options.overwrite,
    )
    study = StudySettings(
        polish=polish_settings(options, polishable, driven),
        drivable=options.drivable,
        drivable_replicas=options.drivable_replicas,
        drivable_polish=polish_settings(options, True, is_drivable=True),
        wish=Wish(options.duration, options.force_limit, options.payload),
        target=options.target,
        simulate=options.simulate,
        report=options.report and not options.recommend_only,
        recommend_only=options.recommend_only,
        with_paper=with_paper,
        paper=options.paper,
        pdf=not options.quick,
    )
    print(run_study(cell, settings, execution, Progress(not options.quiet), study))
    if study.report:
        print(f"Report: {execution.output / PAGE}; all tables: {execution.output / TABLES}")
    if options.animation or options.view:
        from studies.report.looks import follow_looks

        follow_looks(execution.output, options)


def campaign_settings(
    options: argparse.Namespace, objectives: tuple[str, ...] = PAPER_OBJECTIVES
) -> CampaignSettings:
    """Return the settings of a campaign from the options of a program.

    If the options request a recommendation only, these are the settings of the drivable experiment.

    Args:
        options: parsed options of the program.
        objectives: objectives of the search unless the options name others.

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
    algorithms = ALGORITHMS[: 1 if options.recommend_only else None]
    settings = CampaignSettings(
        algorithms=chosen(options.algorithm or algorithms, options.population or ()),
        evaluations=evaluations,
        replicas=replicas,
        seed=options.seed,
        objectives=tuple(options.objective or objectives),
        constraint_handling=options.constraint_handling,
        first_generation=options.first_generation,
    )
    beside = drivable_settings(
        settings, options.drivable_replicas
    )  # its errors come before any work
    return replace(beside, replicas=settings.replicas) if options.recommend_only else settings


def polish_settings(
    options: argparse.Namespace, usual: bool, is_drivable: bool
) -> PolishSettings | None:
    """Return the polish settings in the options; None for no polish.

    Args:
        options: options of the program.
        usual: True to polish unless the options forbid it.
        is_drivable: True if the fronts are of a drivable cell.

    Raises:
        SettingsError: a value is not allowed.
    """
    if not (usual if options.polish is None else options.polish):
        return None
    chosen = (quick_settings if options.quick else default_settings)(is_drivable)
    asked = options.polish_attempts
    attempts = chosen.attempts if asked is None else asked
    return replace(chosen, attempts=attempts, solver=options.polish_solver)
