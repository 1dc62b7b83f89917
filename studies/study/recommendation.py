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
from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.price import RobustPrice, robust_price
from hybrid_opt.robust.squeeze import Contribution
from hybrid_opt.store.files import read_record, to_json, write_json
from hybrid_opt.store.trajectory_file import write_trajectory
from hybrid_opt.timing.jerk import applicable_jerk_limits
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array, Count, Figure, Pair
from symbolic.path.spline import resample_decisions
from symbolic.records import Task, Workcell


@dataclass(frozen=True)
class StoredDurations:
    """Shortest durations of one path, or of a whole front, at the forces of a `ForceTable`.

    Attributes:
        label: name of the path, or `FRONT` for all paths from which the recommended carry was
            chosen.
        durations: shortest duration for each force [s], limits on jerk ignored; null if no path can
            be driven with that force.
    """

    label: str
    durations: tuple[Figure, ...]


@dataclass(frozen=True)
class ForceTable:
    """Shortest durations of several paths at the same commanded forces.

    Attributes:
        forces: largest commanded normal forces of the force-controlled arm [N]; the last one is the
            reference force.
        rows: one row each for the hand-made path, the recommended path, the path of least force
            from the study's first experiment if there is one, and the whole front.
    """

    forces: tuple[float, ...]
    rows: tuple[StoredDurations, ...]


EXPORT_TARGET = "torque"
"""Target of the export that a study names by default: its bundle runs in a simulator."""


@dataclass(frozen=True)
class StoredRecommendation:
    """Content of recommendation.json: the recommended carry, with all figures that reports show of
    it.

    Attributes:
        wish, why: what the carry should be best at, as values and as text.
        source: search that found the carry, such as 'NSGA-II, polished, replica 3'.
        file: path of the carry's trajectory file, relative to the results folder.
        duration: duration of the carry as robots drive it, within limits on jerk [s].
        force: largest commanded normal force of the force-controlled arm [N].
        parts: contributions that add up to `force`.
        job_duration: duration of the whole job [s]; null if none can be planned.
        force_limit: force limit with which the carry is timed [N].
        peak_force: largest planned normal force of each robot [N].
        robust_force: (2,) largest normal force of each robot in every case of the uncertainty [N],
            if the force limit applies to such forces; else null.
        without_jerk: duration without limits on jerk [s]; null if the cell has none.
        squeeze, squeeze_reason: largest commanded normal force of each robot [N], and how it was
            chosen.
        order: words before the force in texts, such as 'press with'.
        target: name of the export's target in the command that the study prints.
        payload_limit: payload mass at which the total contact force of a robot reaches its
            reference force, on the same motion and without uncertainty [kg].
        rivals: other paths, the hand-made one first: their durations at the same force, and their
            forces in the same time.
        margins: largest errors of single values of the cell's description that `force` tolerates.
        advice: changes of the cell and their effects on the force.
        warnings: objections against the carry.
        considered: number of carries among which the recommended one was chosen.
        durations: shortest durations of some paths at the same commanded forces.
        price: growth of the forces with the uncertainty; null for a cell without uncertainty.
        required: largest normal force of either arm in any case of the uncertainty [N].
        allowed: (2,) reference force of each robot [N]; null if unknown.
        at_rest: the grip budget of the cell at rest, as text.
        remedies: the smallest changes with which the reference forces would allow the carry, if
            they do not.
        reserve: heaviest box and least friction that the reference forces allow in every case of
            the uncertainty; null if unknown.
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
        """True if a whole job around the carry can be planned."""
        return math.isfinite(self.job_duration)

    @property
    def fits(self) -> bool:
        """True if the normal forces required in every case of the uncertainty are within the
        reference forces."""
        return not self.remedies

    @property
    def force_kind(self) -> ForceKind:
        """Kind of the normal forces, planned or robust, to which the force limit applies. The force
        table and `rivals` use the same kind."""
        return PLANNED_FORCE if self.robust_force is None else ROBUST_FORCE

    @property
    def limited_force(self) -> Array:
        """(2,) largest normal force of each robot [N]: planned or robust forces, whichever the
        force limit applies to."""
        return self.peak_force if self.robust_force is None else self.robust_force


@dataclass(frozen=True)
class NoRecommendation:
    """Content of no-recommendation.json: the reason why a study recommends no carry."""

    reason: str


def recommendation_stage(wish: ho.Wish, target: str) -> Stage:
    """Return the stage of a study that recommends a carry.

    It writes `recommended.json`, a trajectory file, and `recommendation.json`. If there is no
    drivable carry it writes `no-recommendation.json` only.

    Args:
        wish: what the carry should be best at.
        target: name of the export's target in the command that the study prints.
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
    """Read the recommendation of a study from its results folder, or the reason why there is none.
    Return None if the folder has neither.

    Raises:
        ResultsError: the file is damaged.
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
    """Choose a carry from the drivable fronts of a study and write its trajectory file.

    Args:
        root: results folder of the study, whose drivable experiment is finished.
        wish: what the carry should be best at.
        path: path of the trajectory file.
        progress: receives messages on the progress.
        target: name of the export's target, stored in the recommendation.
        threads: number of threads that time carries, 0 for one per core; it has no influence on the
            result.

    Returns:
        The recommendation.

    Raises:
        NoCarryError: no drivable carry was found; the message says why.
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
    """Return the hand-made trajectory with the largest possible force limit as decision vectors (1,
    n_var); (0, n_var) if it is not feasible. It takes part in the choice because the front of a
    short search may be worse."""
    x = np.append(cell.initial[:-1], cell.workcell.task.force_limit[1])
    found = cell.evaluator.certified(cell.evaluate(x))
    return np.asarray(found.x[found.feasible])


def _why_none(cell: ho.Cell, results: CampaignResults) -> str:
    """Return a text on why a search found no drivable carry in a cell.

    The text states the constraints that candidates violated, and why the hand-made trajectory
    cannot be driven.
    """
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
    """Compute the table of shortest durations [s] with a row per path and a column per commanded
    force.

    The forces are those of `table_forces` and the force of the recommended carry. The rows are the
    hand-made path, the recommended path, further paths, and the best path of the front at each
    force.

    Args:
        cell: the drivable cell.
        x: (k, n_var) carries of the front, from which the recommended one was chosen.
        others: path variables (n_path,) of each further path, by the path's name.
        found: the recommendation.
        advance: function that is called after each row.
    """
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
"""Label of the row for all paths that the recommended carry was chosen from."""

LEAST_FORCE_PATH = "least-force"
"""Label of the balanced path of the experiment that minimises both robots' forces; the recommended
carry is compared with it."""


def known_paths(root: Path, task: Task) -> Array:
    """Return good paths of a finished experiment as starts of another search: the balanced path of
    all fronts, and the first, middle and last path of each polished front.

    Args:
        root: results folder of the experiment.
        task: task of the other search, to whose waypoints the paths are converted.

    Returns:
        (m, n_path) paths.

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
    """Find the path of least forces of an experiment: the balanced path of all its fronts together.

    Args:
        campaign: results of the experiment.
        task: task to whose waypoints the path is converted.

    Returns:
        The path (n_path,) under the key `LEAST_FORCE_PATH`; an empty dictionary if the experiment
        found no carry.
    """
    evaluator = CandidateEvaluator(campaign.workcell, campaign.objectives)
    chosen = select(evaluator, np.concatenate([front.x for front in campaign.fronts]))
    if chosen is None:
        return {}
    own = campaign.workcell.task
    return {LEAST_FORCE_PATH: resample_decisions(chosen.carry.x[: own.n_path], own, task)[0]}


def is_drivable(workcell: Workcell, objectives: Sequence[str]) -> bool:
    """Return True if an experiment searches for drivable carries: the cell has the drivable time
    law, and the objectives are duration and force.

    Args:
        workcell: cell of the experiment.
        objectives: names of its objectives.
    """
    return workcell.task.law.is_drivable and tuple(objectives) in DRIVABLE_PAIRS


def drivable_root(root: Path, workcell: Workcell, objectives: Sequence[str]) -> Path:
    """Return the results folder of a study's drivable experiment: the study's own folder if its
    first experiment is drivable, else a folder inside.

    Args:
        root: results folder of the study.
        workcell: cell of the first experiment.
        objectives: names of the objectives of the first experiment.
    """
    return root if is_drivable(workcell, objectives) else root / DRIVABLE
