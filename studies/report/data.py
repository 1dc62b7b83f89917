"""Content of a report, gathered once from a results folder and frozen. Pictures, tables and the
page are functions of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.branches import BranchCompetition
from hybrid_opt.campaign.results import CampaignResults, read_campaign
from hybrid_opt.campaign.settings import (
    CONFIGURATION,
    HAND_MADE_FILE,
    RECOMMENDED_FILE,
    SUMMARY,
    UNION,
)
from hybrid_opt.campaign.stages import Cells, ReadyCell, cells_of, read_branches, ready_cells
from hybrid_opt.display.table import Table
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import (
    OBJECTIVES,
    PAPER_OBJECTIVES,
    ForceKind,
    duration_unit,
    force_kind,
)
from hybrid_opt.front import Front, selected_row
from hybrid_opt.metaheuristics.run import title
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing.analysis import TimingDocument, read_timing
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.workers import LocalWorkers, Workers
from studies.report.drawing import RECOMMENDED_STYLE, DrawnCarry, LineStyle, series
from studies.report.page_carries import RECOMMENDED_LABEL, DrawnJob, drawn_job, recommended_job
from studies.report.pictures_cell import ReachMap, reach_map
from studies.study.recommendation import drivable_root, is_drivable
from studies.study.simulation import TIMING, StoredSimulation, limits_on_jerk, read_simulations
from studies.study.summary import CampaignSummary, ReplicaFigures, read_summary
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.read.cell_files import CellFiles, collect_cell
from symbolic.records import Workcell
from symbolic.records.task import initial_decision

INITIAL_LABEL = Path(HAND_MADE_FILE).stem

REACH_SEED = 0
"""Seed of the random postures from which the pictures of the arms' reach are drawn; no result
depends on it."""


@dataclass(frozen=True)
class ReportRun:
    """One replica of one algorithm: its fronts and their indicators.

    Attributes:
        front: front of the search, before a polish.
        hybrid: polished front; None if it was not polished.
        figures: indicators of both fronts, as in summary.json.
    """

    front: Front
    hybrid: Front | None
    figures: ReplicaFigures

    @property
    def feasible(self) -> Array:
        """(k, n_obj) objectives of all feasible candidates of the search."""
        found = self.front.evaluations
        return found.objectives[found.feasible]

    @property
    def fronts(self) -> tuple[Front, ...]:
        """The front of the search, then the polished front if it has points."""
        return (self.front, *([self.hybrid] if self.hybrid else []))


@dataclass(frozen=True)
class AlgorithmRuns:
    """All replicas of one algorithm, and how it is drawn.

    Attributes:
        name: name on the command line.
        title: name for people.
        look: line, colour and marker of the algorithm in all pictures.
        runs: the replicas.
        representative: index in `runs` of the replica with the largest hypervolume, the paper's
            'best-performing run'. Pictures of single runs show it.
        best: carry selected from that replica's polished front, or else from its front. None if the
            front is empty, and in a second, drivable experiment.
    """

    name: str
    title: str
    look: LineStyle
    runs: tuple[ReportRun, ...]
    representative: int
    best: DrawnCarry | None

    @property
    def shown(self) -> ReportRun:
        """The replica with the largest hypervolume, which pictures of single runs show."""
        return self.runs[self.representative]


@dataclass(frozen=True)
class Experiment:
    """One experiment of a study.

    Attributes:
        workcell: the cell.
        files: the workcell file and all files that it names.
        objectives: names of the search's objectives.
        summary: the content of summary.json.
        algorithms: the algorithms in the order of the campaign.
        union: union of all fronts of a drivable experiment, polished as one front; None otherwise
            or without a polish.
    """

    workcell: Workcell
    files: CellFiles
    objectives: tuple[str, ...]
    summary: CampaignSummary
    algorithms: tuple[AlgorithmRuns, ...]
    union: Front | None

    @property
    def force_kind(self) -> ForceKind:
        """Kind of the normal forces in the experiment's objectives and force limits: planned or
        robust."""
        return force_kind(self.objectives)

    @property
    def solved(self) -> tuple[AlgorithmRuns, ...]:
        """The algorithms whose representative replica found a feasible candidate."""
        return tuple(a for a in self.algorithms if len(a.shown.front))

    @property
    def has_hybrid(self) -> bool:
        """True if any front was polished."""
        return any(run.hybrid is not None for a in self.algorithms for run in a.runs)

    def fronts(self) -> Iterator[tuple[LineStyle, Front, bool]]:
        """Yield the fronts of each algorithm's representative replica, then the polished union if
        there is one.

        Yields:
            Line style, front, and True if the experiment has a polished front that replaces this
            one.
        """
        for algorithm in self.solved:
            found = algorithm.shown.fronts
            after = found[-1] if self.union is None else self.union
            yield from ((algorithm.look, front, front is not after) for front in found)
        if self.union is not None:
            yield series(len(self.algorithms)), self.union, False

    def driven(self, objectives: Array) -> Array:
        """Convert objectives of a drivable experiment to physical units.

        Args:
            objectives: (k, 2) duration and force as the search scales them.

        Returns:
            (k, 2) force [N] and duration [s].
        """
        reference = float(self.workcell.task.reference_force.max())
        return objectives[:, ::-1] * [reference, duration_unit(self.workcell)]


@dataclass(frozen=True)
class ReportData(Experiment):
    """Everything that a report shows: the first experiment of a study, with its cell, carries,
    timings and jobs.

    Attributes:
        root: the results folder.
        geometry: the cell's collision bodies and pairs.
        objective_titles: names of the objectives for axes.
        at_rest: (2,) first two objectives of the level payload at rest; None if the objectives are
            not both robots' forces.
        initial: the hand-made trajectory.
        timings: label and timings of each trajectory in `carries`.
        reach: regions that the arms reach; None in a report without the paper's pictures.
        drivable: the second, drivable experiment; None without one.
        recommended: (n_var,) decision vector of the recommended carry; None without one.
        jerk: table of how much longer carries last because of limits on jerk; None without such
            limits.
        branches: how the start branches were chosen; None if the workcell file states them.
        simulations: results of the carries in the simulated cell.
        jobs: the whole jobs around the recommended and the hand-made trajectory.
    """

    root: Path
    geometry: CellGeometry
    objective_titles: tuple[str, ...]
    at_rest: Array | None
    initial: DrawnCarry
    timings: tuple[tuple[str, TimingDocument], ...]
    reach: ReachMap | None
    drivable: Experiment | None = None
    recommended: Array | None = None
    jerk: Table | None = None
    branches: BranchCompetition | None = None
    simulations: tuple[StoredSimulation, ...] = ()
    jobs: tuple[DrawnJob, ...] = ()

    @property
    def alone(self) -> bool:
        """True if the study has one experiment, which is drivable."""
        return is_drivable(self.workcell, self.objectives)

    @property
    def carries(self) -> tuple[DrawnCarry, ...]:
        """The hand-made trajectory and the selected trajectory of each algorithm that has one."""
        return (self.initial, *(a.best for a in self.algorithms if a.best is not None))

    @property
    def drawn(self) -> tuple[DrawnCarry, ...]:
        """The trajectories of `carries`, and the recommended carry with the timing of its job."""
        recommended = self.recommended_carry
        return self.carries if recommended is None else (*self.carries, recommended)

    def job(self, label: str) -> DrawnJob | None:
        """Return the job around the carry with this label, None if the report has none."""
        return next((job for job in self.jobs if job.label == label), None)

    @property
    def recommended_carry(self) -> DrawnCarry | None:
        """The recommended carry with the timing of its job; None if there is no recommendation, or
        no such timing.
        """
        job = self.job(RECOMMENDED_LABEL)
        carry = None if job is None or job.timing is None else job.timing.carry
        return None if carry is None else DrawnCarry(RECOMMENDED_LABEL, carry, RECOMMENDED_STYLE)

    @property
    def recommended_objectives(self) -> Array | None:
        """(2,) first two objectives of the recommended carry with the timing of its job. None
        without a recommendation, or if the objectives are neither both robots' forces nor duration
        and force.
        """
        found, reference = self.summary.recommendation, self.workcell.task.reference_force
        if found is not None and self.objectives[:2] == PAPER_OBJECTIVES:
            return np.asarray(found.peak_force / reference)
        if found is not None and self.alone:
            force = float((found.limited_force / reference).max())
            return np.array([found.duration / duration_unit(self.workcell), force])
        return None


def gather(
    results: CampaignResults, workers: Workers | None = None, paper: bool = True
) -> ReportData:
    """Read the results of a study, evaluate the carries that the report draws, and plan the jobs
    around the recommended and the hand-made carry.

    Args:
        results: folder of the finished study.
        workers: processes for slow computations; None for this process.
        paper: True if the paper's pictures will be drawn too.

    Raises:
        ResultsError: the folder is not complete or damaged.
        DualArmError: the workcell's functions cannot be built.
    """
    first, initial = _experiment(results), _hand_made(results.cell.evaluator)
    carries = (initial, *(a.best for a in first.algorithms if a.best is not None))
    place = drivable_root(results.root, results.workcell, results.objectives)
    drivable, jerk, recommended = None, None, None
    if (place / CONFIGURATION).exists():
        drivable = _experiment(read_campaign(place), select=False)
        jerk = limits_on_jerk(place, first.summary.recommendation)
    if drivable is not None and first.summary.recommendation is not None:
        recommended = read_trajectory(results.root / RECOMMENDED_FILE).x
    if not (results.root / TIMING).exists():
        raise ResultsError(
            f"{results.root}: a study with --recommend-only has no report; its carry is in "
            f"{RECOMMENDED_FILE}. Run the study without it, into another folder, for one",
            code="no-report",
        )
    files = first.summary.shown_files.values()
    timings = [read_timing(results.root / TIMING / file) for file in files]
    if len(timings) != len(carries):
        raise ResultsError(f"{results.root / SUMMARY}: damaged: does not fit the fronts beside it")
    geometry = build_geometry(results.workcell)
    calls: list[Callable[[Sequence[ReadyCell]], Any]] = []
    if recommended is not None:
        calls.append(partial(recommended_job, recommended))
    slow = TimingLimits(reference_speed=True)
    calls.append(partial(drawn_job, initial.label, initial.x, slow))
    calls += [partial(_reach, geometry)] if paper else []
    forces = first.summary.static_hold.normal_force / first.summary.reference_force
    known = dict(zip(PAPER_OBJECTIVES, forces, strict=True))
    still = [known.get(name) for name in first.objectives[:2]]
    alone = results.workcell.task.law.is_drivable
    # Jobs belong to the drivable cell.
    cells = cells_of(first.files, results.objectives, alone)
    made = (workers or LocalWorkers()).map(partial(_call, cells), calls)
    reach, jobs = (made[-1], made[:-1]) if paper else (None, made)
    return ReportData(
        **vars(first),
        root=results.root,
        geometry=geometry,
        objective_titles=_titles(results),
        at_rest=None if None in still or len(still) < 2 else np.array(still),
        initial=initial,
        timings=tuple(zip((carry.label for carry in carries), timings, strict=True)),
        reach=reach,
        drivable=drivable,
        recommended=recommended,
        jerk=jerk,
        branches=read_branches(results.root),
        simulations=read_simulations(results.root),
        jobs=tuple(jobs),
    )


def gather_carries(root: Path) -> tuple[CellGeometry, tuple[DrawnCarry, ...]]:
    """Return the geometry of a study's cell and the carries to draw.

    The carries are the hand-made one, then the selected one of each algorithm that has one.

    Args:
        root: results folder of the study.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    results = read_campaign(root)
    best = [algorithm.best for algorithm in _experiment(results).algorithms]
    carries = (_hand_made(results.cell.evaluator), *(c for c in best if c is not None))
    return build_geometry(results.workcell), carries


def _experiment(results: CampaignResults, select: bool = True) -> Experiment:
    """Read an experiment from its results folder.

    Args:
        results: the results folder.
        select: True to select a trajectory from the representative replica of each algorithm.
    """
    summary, fronts = read_summary(results.root), results.fronts
    union = next((front for front in fronts if front.algorithm == UNION), None)
    evaluator = results.cell.evaluator if select else None
    algorithms = []
    for index, name in enumerate(results.algorithms):
        entry, runs = summary.algorithms[name], []
        for replica, figures in zip(results.of(name), entry.replicas, strict=True):
            front, *polished = (
                f for f in fronts if (f.algorithm, f.replica) == (name, replica.replica)
            )
            runs.append(ReportRun(front, next(iter(polished), None), figures))
        shown, best, look = entry.representative or 0, None, series(index)
        front = runs[shown].fronts[-1]
        if evaluator is not None and len(front):
            x = front.x[selected_row(evaluator, front.x)]
            source = f"{front.source}: least force"
            best = DrawnCarry(front.title, evaluator.carry(x), look, source)
        algorithms.append(AlgorithmRuns(name, title(name), look, tuple(runs), shown, best))
    files = collect_cell(results.workcell)
    return Experiment(
        results.workcell, files, results.objectives, summary, tuple(algorithms), union
    )


def _hand_made(evaluator: CandidateEvaluator) -> DrawnCarry:
    task = evaluator.workcell.task
    carry = evaluator.carry(initial_decision(task))
    return DrawnCarry(INITIAL_LABEL, carry, source=INITIAL_LABEL)


def _titles(results: CampaignResults) -> tuple[str, ...]:
    """Return the names of the objectives for axes, with the robots' own names in place of 'robot 1'
    and 'robot 2'."""
    titles = [OBJECTIVES[name].title for name in results.objectives]
    for i, robot in enumerate(results.workcell.robots):
        titles = [title.replace(f"robot {i + 1}", robot.name) for title in titles]
    return tuple(titles)


def _call(cells: Cells, call: Callable[[Sequence[ReadyCell]], Any]) -> Any:
    return call(ready_cells(cells))


def _reach(geometry: CellGeometry, _: Sequence[ReadyCell]) -> ReachMap:
    return reach_map(geometry, np.random.default_rng(REACH_SEED))
