"""The carry to run: the stage that recommends it from the drivable fronts, and its record."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hybrid_opt as ho
from codegen.function import available_cores
from hybrid_opt.campaign import CampaignFolder, Stage
from hybrid_opt.campaign.results import CampaignResults, read_campaign, union
from hybrid_opt.campaign.settings import (
    DRIVABLE,
    NO_RECOMMENDATION,
    RECOMMENDATION,
    RECOMMENDED_FILE,
    STAGES,
)
from hybrid_opt.errors import NoCarryError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator, concatenated
from hybrid_opt.evaluate.explanation import explain
from hybrid_opt.evaluate.objectives import DRIVABLE_PAIRS, PLANNED_FORCE, ROBUST_FORCE, ForceKind
from hybrid_opt.front import select
from hybrid_opt.progress import Advance, Progress
from hybrid_opt.recommending.advice import Advice
from hybrid_opt.recommending.choice import DrivenPaths, wished_cell
from hybrid_opt.recommending.recommendation import (
    HAND_MADE,
    STEPS,
    Alternative,
    Recommendation,
    commanded_durations,
    spread_rows,
    table_forces,
)
from hybrid_opt.robust.budget import Remedy, Reserve
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.robust.force import RobustPrice, robust_model, robust_price
from hybrid_opt.robust.squeeze import Contribution
from hybrid_opt.store.files import read_record, to_json, write_json
from hybrid_opt.store.trajectory_file import write_trajectory
from hybrid_opt.timing.jerk import applicable_jerk_limits
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array, Count, Figure, Pair
from symbolic.path.pieces import resample_decisions
from symbolic.records import Task, Workcell


@dataclass(frozen=True)
class StoredDurations:
    """Shortest durations at the forces of a table [s], null where a path cannot move.

    Attributes:
        label: of a path, or of all paths that the carry was chosen from.
        durations: one per force, limits on jerk left out.
    """

    label: str
    durations: tuple[Figure, ...]


@dataclass(frozen=True)
class ForceTable:
    """Durations at the same commanded forces.

    Attributes:
        forces: largest forces to command of the force-controlled arm [N]; the last one is the
            reference force.
        rows: hand-made path, recommended one, optimum of the other experiment, the front.
    """

    forces: tuple[float, ...]
    rows: tuple[StoredDurations, ...]


EXPORT_TARGET = "torque"
"""Target of the export that a study names by default: its bundle runs in a simulator."""


@dataclass(frozen=True)
class StoredRecommendation:
    """The carry to run.

    Attributes:
        wish, why: the target, as values and as text.
        source: whose it is, as 'NSGA-II, polished, replica 3'.
        file: its trajectory file, relative to the folder.
        duration: as robots drive it, limits on jerk kept [s].
        force: largest force to command of the force-controlled arm [N]; the one force.
        parts: contributions whose sum is the force.
        job_duration: of the whole job [s], null where none can be planned.
        force_limit: of the search [N].
        peak_force: largest planned normal force of each robot [N].
        robust_force: likewise in every case of the workcell's uncertainty, where force limits are
            about these; else null.
        without_jerk: duration without the cell's limits on jerk [s], null where there are none.
        squeeze, squeeze_reason: largest normal force to command of each robot [N], and why.
        order: command to the contacts, as in 'press with'.
        target: of the export that the study names.
        payload_limit: payload that the robots bear on the same motion with planned forces, nothing
            uncertain [kg].
        rivals: other paths at the same force and in the same time, the hand-made one first.
        margins: largest errors of the cell's description at the commanded force.
        advice: effects of changes of the cell.
        warnings: objections.
        considered: carries that it was chosen from.
        durations: of paths and the front at the same commanded forces.
        price: of robustness, null where no set leaves friction and patches.
        required: largest force of either arm in any case, commanded or resulting [N].
        allowed: the robots' reference forces [N].
        at_rest: text of the grip budget.
        remedies: if the reference forces do not allow the carry, the smallest changes with which
            they do.
        reserve: heaviest box and least friction within the reference forces, in every case of the
            uncertainty; null if unknown.
    """

    wish: ho.Wish
    why: str
    source: str
    file: str
    duration: float
    force: float
    parts: tuple[Contribution, ...]
    job_duration: Figure
    force_limit: float
    peak_force: Pair
    squeeze: Pair
    squeeze_reason: str
    payload_limit: float
    rivals: tuple[Alternative, ...]
    margins: tuple[Margin, ...]
    advice: tuple[Advice, ...]
    warnings: tuple[str, ...]
    considered: Count
    durations: ForceTable
    price: RobustPrice | None = None
    robust_force: Pair | None = None
    without_jerk: Figure = math.nan
    required: Figure = math.nan
    allowed: Pair | None = None
    at_rest: str = ""
    remedies: tuple[Remedy, ...] = ()
    reserve: Reserve | None = None
    order: str = "press with"
    target: str = EXPORT_TARGET

    @property
    def has_job(self) -> bool:
        """Return True if robots can be given a job around the carry."""
        return math.isfinite(self.job_duration)

    @property
    def fits(self) -> bool:
        """Return True if it holds in every case within the reference forces."""
        return not self.remedies

    @property
    def force_kind(self) -> ForceKind:
        """The forces that limits, of the table and of rivals too, are about."""
        return PLANNED_FORCE if self.robust_force is None else ROBUST_FORCE

    @property
    def limited_force(self) -> Array:
        """(2,) largest of them of each robot [N]."""
        return self.peak_force if self.robust_force is None else self.robust_force


@dataclass(frozen=True)
class NoRecommendation:
    """no-recommendation.json: why a study has no carry to run."""

    reason: str


def recommendation_stage(wish: ho.Wish, target: str) -> Stage:
    """Return the stage that writes `recommended.json`, a trajectory file, and
    `recommendation.json`, or `no-recommendation.json`.

    Args:
        target: of the export that the recommendation names.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        found: StoredRecommendation | NoRecommendation
        try:
            path, threads = folder.root / RECOMMENDED_FILE, folder.execution.jobs
            found = recommend_from(folder.root, wish, path, progress, target, threads)
        except NoCarryError as error:
            found = NoRecommendation(str(error))
        none = isinstance(found, NoRecommendation)
        written, other = (NO_RECOMMENDATION, RECOMMENDATION)[:: 1 if none else -1]
        # Also after an earlier attempt that was interrupted.
        (folder.root / other).unlink(missing_ok=True)
        write_json(folder.root / written, to_json(found))

    return Stage("recommendation", run, {"wish": to_json(wish), "target": target})


def read_recommendation(root: Path) -> StoredRecommendation | NoRecommendation | None:
    """Read the recommendation in a results folder, or the reason why there is none; None if none
    was requested.

    Raises:
        ResultsError: it is damaged.
    """
    remedy = f"delete {STAGES}/recommendation.json in its folder and continue with --resume"
    if (root / RECOMMENDATION).exists():
        return read_record(StoredRecommendation, root / RECOMMENDATION, remedy)
    if (root / NO_RECOMMENDATION).exists():
        return read_record(NoRecommendation, root / NO_RECOMMENDATION, remedy)
    return None


def recommend_from(
    root: Path,
    wish: ho.Wish,
    path: Path,
    progress: Progress,
    target: str = EXPORT_TARGET,
    threads: int = 0,
) -> StoredRecommendation:
    """Recommend a carry of a study's drivable fronts, and store it; return its text.

    Args:
        root: the results folder, its drivable experiment done.
        path: the trajectory file to write.
        target: of the export that the recommendation names.
        threads: threads that time carries, 0 for one per core; results do not depend on it.

    Raises:
        NoCarryError: no drivable carry was found; the text says why.
        SettingsError: no carry fulfils the wish.
        ResultsError: the folder is not complete or damaged, or the file cannot be written.
    """
    campaign = read_campaign(root)
    drivable = read_campaign(drivable_root(root, campaign.workcell, campaign.objectives))
    threads = threads or available_cores()
    cell = wished_cell(ho.Cell(drivable.workcell, drivable.objectives, threads), wish)
    own, best = _hand_made(cell), union(drivable.fronts)
    x = np.vstack([*(front.x[row, None] for front, row in best), own])
    sources = [*(front.source for front, _ in best), *[HAND_MADE] * len(own)]
    if len(x) == 0:
        raise NoCarryError(_why_none(cell, drivable))
    alone = is_drivable(campaign.workcell, campaign.objectives)
    others = {} if alone else least_force(campaign, cell.workcell.task)
    # The choice with its rivals, the table's rows and the price.
    steps = STEPS + 5 + 2 * len(others)
    with progress.stage("recommendation", steps, "steps") as advance:
        found = ho.recommend(
            ho.Front.of(cell, x), wish, others, progress=lambda done, total: advance(1)
        )
        durations = _force_table(cell, x, others, found, advance)
        price, driven = None, found.carry.workcell
        if not driven.uncertainty.is_empty:
            rng = np.random.default_rng(campaign.settings.seed)
            price = robust_price(robust_model(driven), found.carry, rng, LEADER, threads=threads)
        advance(1)
        without_jerk = math.nan
        if applicable_jerk_limits(cell.workcell, found.timing.limits) is not None:
            without_jerk = ho.time_path(cell, found.x, found.timing.limits).duration
    source = sources[found.member]
    provenance = {
        "recommended": str(wish),
        "source": source,
        "settings": to_json(campaign.settings),
    }
    figures = cell.carry(found.x).figures
    write_trajectory(path, cell.compiled, found.x, figures, provenance)
    inside = path.resolve().is_relative_to(root.resolve())
    file = path.resolve().relative_to(root.resolve()).as_posix() if inside else str(path)
    return StoredRecommendation(
        wish=found.wish,
        why=found.why,
        source=source,
        file=file,
        duration=found.duration,
        force=found.force,
        parts=found.squeeze.parts,
        job_duration=math.nan if found.job is None else found.job.duration,
        force_limit=found.limit,
        peak_force=found.carry.peak_normal_force,
        squeeze=found.commanded,
        squeeze_reason=str(found.squeeze),
        payload_limit=found.carry.payload_limit,
        rivals=found.rivals,
        margins=found.margins,
        advice=found.advice,
        warnings=found.warnings,
        considered=len(x),
        durations=durations,
        price=price,
        robust_force=found.limited_force if found.force_kind.robust else None,
        without_jerk=without_jerk,
        required=float(found.required.max()),
        allowed=found.budget.allowed,
        at_rest=str(found.budget),
        remedies=found.remedies,
        reserve=found.reserve,
        order=found.squeeze.order,
        target=target,
    )


def _hand_made(cell: ho.Cell) -> Array:
    """Return (1, n) the hand-made carry within the largest force limit, none where it is not
    feasible: a front may lie behind it where the search was short."""
    x = np.append(cell.initial[:-1], cell.workcell.task.force_limit[1])
    found = cell.evaluator.certified(cell.evaluate(x))
    return np.asarray(found.x[found.feasible])


def _why_none(cell: ho.Cell, results: CampaignResults) -> str:
    """Describe what stopped the candidates of an experiment, and its hand-made trajectory."""
    found = concatenated([replica.evaluations for replica in results.replicas])
    stopped = ", ".join(
        f"{name.replace('_', ' ')} {100.0 * count / len(found):.1f} %"
        for name, count in found.infeasible_by_reason.items()
    )
    told = f"none of {len(found)} drivable candidates is feasible ({stopped})"
    limits = cell.timing_model.drive_limits(float(cell.initial[-1]))
    timing = ho.time_path(cell, cell.initial, limits)
    if not timing.ok:
        return f"{told}; the hand-made trajectory cannot be driven: {timing.reason}"
    why = explain(cell.evaluator, cell.evaluate(cell.initial))
    hand_made = f"; the hand-made trajectory: {why[0]}" if why else ""
    return f"{told}{hand_made}; a longer search or wider bounds may find one"


def _force_table(
    cell: ho.Cell,
    x: Array,
    others: Mapping[str, Array],
    found: Recommendation,
    advance: Advance,
) -> ForceTable:
    """Time paths, and the front of carries x (k, n_var), at the same commanded forces, that of the
    recommended carry among them."""
    n = cell.workcell.task.n_path
    forces = np.unique(np.append(table_forces(cell.workcell), found.force))
    paths = {HAND_MADE: cell.initial[:n], "recommended": found.x[:n]} | dict(others)
    chosen = x[spread_rows(x[:, :n])]
    every = {label: (path[None], np.array([found.limit])) for label, path in paths.items()}
    rows = []
    for label, (known, limits) in (every | {FRONT: (chosen[:, :n], chosen[:, -1])}).items():
        durations = commanded_durations(DrivenPaths(cell, known), limits, forces)
        rows.append(StoredDurations(label, tuple(durations.tolist())))
        advance(1)
    return ForceTable(tuple(forces.tolist()), tuple(rows))


FRONT = "the front"
"""All paths that the recommended carry was chosen from."""

LEAST_FORCE_PATH = "least-force"
"""The path that the other experiment ends with, beside which the recommended carry stands."""


def known_paths(root: Path, task: Task) -> Array:
    """Return paths (m, n_path) that another experiment ends with, in the waypoints of a task: of
    all polished fronts together the balanced one, of each of them both ends and the middle.

    Raises:
        ResultsError: the experiment's folder is not complete or damaged.
    """
    campaign = read_campaign(root)
    own, n = campaign.workcell.task, campaign.workcell.task.n_path
    found = [path[None] for path in least_force(campaign, task).values()]
    polished = [front for front in campaign.fronts if front.polished and len(front)]
    found += [resample_decisions(f.x[[0, len(f) // 2, -1], :n], own, task) for f in polished]
    return np.unique(np.concatenate(found), axis=0) if found else np.empty((0, task.n_path))


def least_force(campaign: CampaignResults, task: Task) -> dict[str, Array]:
    """Return the balanced path (n_path,) of all fronts of an experiment, at the waypoints of a
    task, by its label; empty if no carry was found."""
    evaluator = CandidateEvaluator(campaign.workcell, campaign.objectives)
    chosen = select(evaluator, np.concatenate([front.x for front in campaign.fronts]))
    if chosen is None:
        return {}
    own = campaign.workcell.task
    return {LEAST_FORCE_PATH: resample_decisions(chosen.carry.x[: own.n_path], own, task)[0]}


def is_drivable(workcell: Workcell, objectives: Sequence[str]) -> bool:
    """Return True if an experiment already is the search for carries as robots drive them."""
    return workcell.task.law.is_drivable and tuple(objectives) in DRIVABLE_PAIRS


def drivable_root(root: Path, workcell: Workcell, objectives: Sequence[str]) -> Path:
    """Return the folder of a study's drivable experiment: one inside, unless the study's first
    experiment, of this cell and these objectives, is the only one."""
    return root if is_drivable(workcell, objectives) else root / DRIVABLE
