"""Gathers what a report shows from a results folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.campaign.branch_choice import read_branches
from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.campaign.polish_stage import read_polished
from hybrid_opt.campaign.results import CampaignResults, Replica, read_campaign, read_summary
from hybrid_opt.campaign.simulated import read_simulations
from hybrid_opt.campaign.summary import AlgorithmFigures, CampaignSummary, ReplicaFigures
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import OBJECTIVES, PAPER_OBJECTIVES
from hybrid_opt.indicators.selection import selected_row
from hybrid_opt.job.plan import JobModel
from hybrid_opt.recommending.comparison import level_force
from hybrid_opt.timing import TimingLimits, timed_trajectory
from hybrid_opt.timing.robustness import payload_sensitivity
from hybrid_opt.work.service import Emit, Executor, SerialExecutor, Service, answer_all
from studies.report.data_drivable import gather_drivable
from studies.report.jobs import (
    RECOMMENDED_LABEL,
    DrawnJob,
    JobModelSource,
    JobRequest,
    drawn_job,
)
from studies.report.reach import reach_map
from studies.report.records import (
    AlgorithmRuns,
    DrawnCarry,
    DrivableReport,
    Front,
    ReachMap,
    ReportData,
    Run,
    TimedSelection,
)
from studies.study.terminal import title
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.read.cell_files import collect_cell
from symbolic.records.task import initial_decision

INITIAL_LABEL = "hand-made"
CURVE_POINTS = 12
"""Points of the curve of duration against force limit."""

REACH_SEED = 0
"""Seed of the postures that the reach is drawn from; no result depends on it."""


def gather(results: CampaignResults, executor: Executor | None = None) -> ReportData:
    """Evaluate what is drawn in detail.

    Args:
        results: of a finished study.
        executor: who does what takes long, None for this process.

    Raises:
        ResultsError: the folder is not complete or damaged.
        DualArmError: the workcell's functions cannot be built.
    """
    summary = read_summary(results.root)
    workcell = results.workcell
    maker = _CarryMaker(results)
    geometry = build_geometry(workcell)
    algorithms = _algorithms(results, summary, maker)
    carries = _best(results, algorithms, maker)
    drivable = gather_drivable(results, summary)
    slow: list[Callable[[JobModel], Any]] = [partial(_reach, geometry)]
    slow += [partial(_timing, carry.label, carry.x) for carry in carries]
    files, workers = collect_cell(workcell), executor or SerialExecutor()
    service = Service(JobModelSource(PackedCell.of(files), results.objectives), _called)
    reach, *timings = answer_all(workers, service, slow)
    # Jobs are what robots are told: by the cell that they drive, whose contact model may differ.
    if drivable is not None:
        kind = results.cell.force_kind.drivable
        service = Service(JobModelSource(PackedCell.of(drivable.files), kind), _called)
    asked: list[Callable[[JobModel], Any]] = [
        partial(_job, request) for request in _job_requests(carries, drivable, results.cell)
    ]
    jobs = answer_all(workers, service, asked)
    return ReportData(
        root=results.root,
        workcell=workcell,
        files=files,
        geometry=geometry,
        summary=summary,
        objectives=results.objectives,
        objective_titles=_titles(results),
        static=_static(results, summary),
        algorithms=algorithms,
        initial=carries[0],
        timings=tuple(timings),
        reach=reach,
        branches=read_branches(results.root),
        simulations=read_simulations(results.root),
        level_force=level_force(workcell, results.cell.force_kind),
        drivable=drivable,
        jobs=tuple(jobs),
    )


def _titles(results: CampaignResults) -> tuple[str, ...]:
    """The objectives' titles, with the robots' names for their numbers."""
    titles = [OBJECTIVES[name].title for name in results.objectives]
    for i, robot in enumerate(results.workcell.robots):
        titles = [title.replace(f"robot {i + 1}", robot.name) for title in titles]
    return tuple(titles)


def gather_carries(root: Path) -> tuple[CellGeometry, tuple[DrawnCarry, ...]]:
    """The cell, the hand-made trajectory and every algorithm's best selected one.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    results, summary = read_campaign(root), read_summary(root)
    maker = _CarryMaker(results)
    algorithms = _algorithms(results, summary, maker)
    return build_geometry(results.workcell), _best(results, algorithms, maker)


def _algorithms(
    results: CampaignResults, summary: CampaignSummary, maker: _CarryMaker
) -> tuple[AlgorithmRuns, ...]:
    return tuple(
        _algorithm(index, name, results, summary.algorithms[name], maker)
        for index, name in enumerate(results.algorithms)
    )


def _best(
    results: CampaignResults, algorithms: tuple[AlgorithmRuns, ...], maker: _CarryMaker
) -> tuple[DrawnCarry, ...]:
    initial = maker.carry(initial_decision(results.workcell.task), INITIAL_LABEL)
    best = [algorithm.best for algorithm in algorithms]
    return (initial, *(carry for carry in best if carry is not None))


class _CarryMaker:
    """Evaluates trajectories of one campaign in detail."""

    def __init__(self, results: CampaignResults) -> None:
        self.evaluator = results.cell.evaluator

    def carry(self, x: Array, label: str) -> DrawnCarry:
        return shown(label, self.evaluator.carry(x))

    def selected(self, front: Front, label: str) -> DrawnCarry:
        """The trajectory that stands for a front."""
        row = selected_row(self.evaluator, front.x)
        return self.carry(front.x[row], label)


def _called(model: JobModel, call: Callable[[JobModel], Any], emit: Emit) -> Any:
    return call(model)


def _reach(geometry: CellGeometry, model: JobModel) -> ReachMap:
    return reach_map(geometry, np.random.default_rng(REACH_SEED))


def _timing(label: str, x: Array, model: JobModel) -> TimedSelection:
    timed = timed_trajectory(model.timing, x, curve_points=CURVE_POINTS)
    assert timed.curve is not None
    return TimedSelection(label, timed.report, timed.curve, timed.margins)


def _job_requests(
    carries: Sequence[DrawnCarry], drivable: DrivableReport | None, cell: Cell
) -> list[JobRequest]:
    """The recommended carry's job, then those of hand-made and selected ones."""
    found = []
    if drivable is not None and drivable.recommended is not None:
        n_var, force = cell.workcell.task.n_var, float(drivable.recommended[-1])
        within = TimingLimits(force=force, robust=cell.force_kind.robust)
        found.append(JobRequest(RECOMMENDED_LABEL, drivable.recommended[:n_var], within, True))
    limits = TimingLimits(reference_speed=True)
    return found + [JobRequest(carry.label, carry.x, limits, True) for carry in carries]


def _job(request: JobRequest, model: JobModel) -> DrawnJob:
    return drawn_job(model, request)


def shown(label: str, carry: Carry) -> DrawnCarry:
    """A judged carry with what is drawn of it."""
    judgement = carry.judgement
    assert judgement is not None
    objectives = np.array(list(judgement.objectives.values()))
    return DrawnCarry(
        label, carry.x, objectives, carry, payload_sensitivity(carry), judgement.feasible
    )


def _algorithm(
    index: int,
    name: str,
    results: CampaignResults,
    entry: AlgorithmFigures,
    maker: _CarryMaker,
) -> AlgorithmRuns:
    runs = tuple(
        _run(results, replica, figures)
        for replica, figures in zip(results.of(name), entry.replicas, strict=True)
    )
    representative = entry.representative or 0
    front, hybrid = runs[representative].front, runs[representative].hybrid
    return AlgorithmRuns(
        name=name,
        title=title(name),
        index=index,
        runs=runs,
        representative=representative,
        selected=maker.selected(front, title(name)) if len(front) else None,
        hybrid_selected=None
        if hybrid is None or not len(hybrid)
        else maker.selected(hybrid, f"{title(name)}, polished"),
    )


def _run(results: CampaignResults, replica: Replica, figures: ReplicaFigures) -> Run:
    front = Front(replica.front_x, replica.front)
    polished = read_polished(results.root, replica, results.workcell)
    hybrid = None if polished is None else Front(polished.x, polished.objectives)
    return Run(replica.replica, replica.evaluations, front, hybrid, figures, figures.polished)


def _static(results: CampaignResults, summary: CampaignSummary) -> Array:
    """Objectives of the level payload at rest."""
    still = summary.static_hold.normal_force / summary.reference_force
    known = dict(zip(PAPER_OBJECTIVES, still, strict=True))
    return np.array([known.get(name, np.nan) for name in results.objectives])
