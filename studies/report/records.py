"""Content of a report, gathered once and frozen. Figures and tables are functions of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from hybrid_opt import carry
from hybrid_opt.branches import BranchCompetition
from hybrid_opt.campaign.simulated import StoredSimulation
from hybrid_opt.campaign.summary import CampaignSummary, PolishedFigures, ReplicaFigures
from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.evaluate.objectives import ForceKind, force_kind
from hybrid_opt.timing import ForceCurve, TimingReport
from hybrid_opt.timing.robustness import Margin, PayloadSensitivity
from studies.report.jobs import DrawnJob
from studies.study.drivable import JerkCosts, ReplicaFront
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry
from symbolic.read.cell_files import CellFiles
from symbolic.records import Workcell


@dataclass(frozen=True)
class DrawnCarry:
    """One trajectory with everything that is drawn of it.

    Attributes:
        label: for legends, e.g. the algorithm's title.
        x: (n_var,) decision vector.
        objectives: (n_obj,) of the campaign, without penalty.
        timed: every quantity along it, under the search's timing.
        sensitivity: its forces against the payload's mass.
        feasible: the evaluator's verdict.
    """

    label: str
    x: Array
    objectives: Array
    timed: carry.Carry
    sensitivity: PayloadSensitivity
    feasible: bool


@dataclass(frozen=True)
class Front:
    """Non-dominated feasible trajectories: x (k, n_var), objectives (k, n_obj)."""

    x: Array
    objectives: Array

    def __len__(self) -> int:
        return len(self.objectives)


@dataclass(frozen=True)
class Run:
    """One replica of one algorithm.

    Attributes:
        replica: its number, from 0.
        evaluations: every candidate that the search evaluated.
        front: what the search found.
        hybrid: what the polish made of it, None without a polish.
        figures, hybrid_figures: indicators of both, as in summary.json.
    """

    replica: int
    evaluations: Evaluations
    front: Front
    hybrid: Front | None
    figures: ReplicaFigures
    hybrid_figures: PolishedFigures | None


@dataclass(frozen=True)
class AlgorithmRuns:
    """All replicas of one algorithm.

    Attributes:
        name, title: on the command line, and for people.
        index: its place in the campaign, which decides its look.
        runs: the replicas.
        representative: position in `runs` of the one with the largest hypervolume, which the
            figures of single runs show (the paper's 'best-performing run').
        selected: of that run's front, the trajectory of least mean force of the two robots;
            None if the algorithm found no feasible candidate.
        hybrid_selected: the same of its polished front, None without a polish.
    """

    name: str
    title: str
    index: int
    runs: tuple[Run, ...]
    representative: int
    selected: DrawnCarry | None
    hybrid_selected: DrawnCarry | None

    @property
    def shown(self) -> Run:
        """The representative run."""
        return self.runs[self.representative]

    @property
    def best(self) -> DrawnCarry | None:
        """The polished selected trajectory where there is one, else the search's."""
        return self.hybrid_selected or self.selected


@dataclass(frozen=True)
class TimedSelection:
    """One selected trajectory under a timing that robots can drive.

    Attributes:
        label: whose it is.
        report: the search's timing and the drivable ones.
        curve: duration against force limit.
        margins: how wrong the assumptions may be.
    """

    label: str
    report: TimingReport
    curve: ForceCurve
    margins: tuple[Margin, ...]


@dataclass(frozen=True)
class DrivableFront:
    """One algorithm's front of the drivable experiment.

    Attributes:
        index: of the algorithm, which decides its look.
        front: of the replica with the largest hypervolume, as searched or as polished.
        force, duration: (k,) largest limited forces [N] and durations [s] of its members.
        cloud: (n, 2) force [N] and duration [s] of feasible candidates, empty for a polished one.
    """

    index: int
    front: ReplicaFront
    force: Array
    duration: Array
    cloud: Array


@dataclass(frozen=True)
class DrivableReport:
    """The drivable experiment in a report.

    Attributes:
        workcell: the cell under the time law 'optimal'.
        files: its files.
        summary: of that experiment.
        fronts: searched and polished.
        recommended: decision vector of the carry to run, None without one.
        jerk: what limits on jerk cost the selected carries; empty without limits.
    """

    workcell: Workcell
    files: CellFiles
    summary: CampaignSummary
    fronts: tuple[DrivableFront, ...]
    recommended: Array | None
    jerk: tuple[JerkCosts, ...]


@dataclass(frozen=True)
class ReportData:
    """Everything that a report shows.

    Attributes:
        root: the results folder.
        workcell: the cell.
        files: its files.
        geometry: its collision bodies and pairs.
        summary: the content of summary.json.
        objectives: names of what the search minimised.
        objective_titles: for axes.
        static: (n_obj,) the objectives of the level payload at rest, NaN where an objective has
            no such value.
        algorithms: in the campaign's order.
        initial: the hand-made trajectory.
        timings: of the hand-made and the selected trajectories, in the order of `carries`.
        reach: where the arms reach.
        level_force: largest of the forces of `force_kind` that hold the level payload at rest [N].
        drivable: the drivable experiment, None without one.
        branches: how the start branches were decided, None where the workcell decides them.
        simulations: of the carries that were driven in the simulated cell, empty without.
        jobs: the whole jobs around the recommended, the hand-made and the selected trajectories.
    """

    root: Path
    workcell: Workcell
    files: CellFiles
    geometry: CellGeometry
    summary: CampaignSummary
    objectives: tuple[str, ...]
    objective_titles: tuple[str, ...]
    static: Array
    algorithms: tuple[AlgorithmRuns, ...]
    initial: DrawnCarry
    timings: tuple[TimedSelection, ...]
    reach: ReachMap
    level_force: float
    drivable: DrivableReport | None = None
    branches: BranchCompetition | None = None
    simulations: tuple[StoredSimulation, ...] = ()
    jobs: tuple[DrawnJob, ...] = ()

    @property
    def force_kind(self) -> ForceKind:
        """Kind of forces that limits and drivable fronts are about."""
        return force_kind(self.objectives)

    @property
    def solved(self) -> tuple[AlgorithmRuns, ...]:
        """The algorithms that found a feasible candidate."""
        return tuple(a for a in self.algorithms if a.selected is not None)

    @property
    def carries(self) -> tuple[DrawnCarry, ...]:
        """The initial trajectory and each algorithm's best selected one."""
        best = [algorithm.best for algorithm in self.algorithms]
        return (self.initial, *(carry for carry in best if carry is not None))

    @property
    def has_hybrid(self) -> bool:
        """Whether the fronts were polished."""
        return any(run.hybrid is not None for a in self.algorithms for run in a.runs)


@dataclass(frozen=True)
class ReachMap:
    """Where the arms' pads and the box can be, on a grid of cubes, positions only.

    A cube is reached if a sampled posture within the joint limits puts the pad there.

    Attributes:
        lower: (3,) corner of the grid in the world [m].
        step: edge of the cubes [m].
        pads: per arm a boolean (nx, ny, nz).
        common: boolean (nx, ny, nz), box centres from which a level box has both its pads in
            cubes that their arms reach.
    """

    lower: Array
    step: float
    pads: tuple[NDArray[Any], NDArray[Any]]
    common: NDArray[Any]
