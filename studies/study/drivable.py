"""The stage that times every selected trajectory as a robot can drive it; fronts of a drivable
experiment, read back, and what limits on jerk cost its carries."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hybrid_opt.campaign import CampaignFolder, Stage, executor_for
from hybrid_opt.campaign.cell_source import ReadyCell, cells_of, ready_cells
from hybrid_opt.campaign.results import CampaignResults, ReplicaFront, read_campaign, read_summary
from hybrid_opt.campaign.settings import (
    DRIVABLE,
    HAND_MADE,
    POLISHED_SUFFIX,
    SELECTED,
    polished_selected_file,
    selected_file,
)
from hybrid_opt.campaign.summary import CampaignSummary
from hybrid_opt.display.table import Table, number
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_PAIRS
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.selection import select
from hybrid_opt.metaheuristics.registry import title
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import timed_trajectory
from hybrid_opt.timing.document import StoredJerk, TimingDocument, read_timing, timing_document
from hybrid_opt.timing.records import TimingStatus
from hybrid_opt.work.service import Emit, Service, answer_all
from symbolic.array import Array
from symbolic.records import Workcell

TIMING = "timing"
"""Folder of the timings in a results folder, laid out as that of the selected trajectories."""

CURVE_POINTS = 12
"""Points of the curve of duration against force limit, of trajectories that a report shows."""

Request = tuple[Array, float | None, int | None]
"""Decision vector, force limit [N], points of the curve."""


def timing_stage(
    force_limit: float | None = None, last: bool = False, curves: bool = True
) -> Stage:
    """The stage that writes `timing/`: one document per selected trajectory.

    Args:
        force_limit: normal force [N] of an additional, force-limited timing.
        last: whether of replicas that were polished only the polished one is timed.
        curves: whether those that a report shows are also timed at many force limits.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        selected = folder.root / SELECTED
        files = sorted(path.relative_to(selected) for path in selected.rglob("*.json"))
        if last:
            known = {str(path) for path in files}
            files = [f for f in files if f"{f.parent}{POLISHED_SUFFIX}/{f.name}" not in known]
        shown = set(shown_files(read_summary(folder.root)).values()) if curves else set[Path]()
        requests = [
            (read_trajectory(selected / f).x, force_limit, CURVE_POINTS if f in shown else None)
            for f in files
        ]
        driven = folder.workcell.task.time_law == "optimal"
        source = partial(ready_cells, cells_of(folder.files, folder.settings.objectives, driven))
        with progress.stage(TIMING, len(requests), "trajectories") as advance:
            workers = executor_for(folder.execution)
            found = answer_all(workers, Service(source, _document), requests, lambda: advance(1))
        for file, document in zip(files, found, strict=True):
            write_json(folder.root / TIMING / file, to_json(document))

    return Stage(TIMING, run, {"force_limit": force_limit})


def shown_files(summary: CampaignSummary) -> dict[str, Path]:
    """Files of the trajectories that a report shows, in the folders of selected ones and of their
    timings: the hand-made one's by '', the best of every algorithm that has one by its name."""
    return {"": Path(HAND_MADE)} | dict(_best(summary))


def _best(summary: CampaignSummary) -> Iterator[tuple[str, Path]]:
    for name, entry in summary.algorithms.items():
        if entry.representative is None:
            continue
        replica = entry.replicas[entry.representative]
        polished = replica.polished is not None and replica.polished.selected is not None
        file_of = polished_selected_file if polished else selected_file
        yield name, file_of(Path(), name, entry.representative).relative_to(SELECTED)


def _document(cells: tuple[ReadyCell, ...], request: Request, emit: Emit) -> TimingDocument:
    own, driven = cells[0].jobs.timing, cells[-1].jobs.timing
    return timing_document(timed_trajectory(driven, *request, own=own))


LEAST_FORCE = "least-force"
"""The path that the other experiment ends with, beside which the recommended carry stands."""


@dataclass(frozen=True)
class DrivableFronts:
    """All fronts of a drivable experiment, and their non-dominated union.

    Attributes:
        results: of the experiment.
        fronts: of all replicas, searched and polished.
        x: (k, n_var) of the union, by increasing duration.
        sources: whose each of the union is.
    """

    results: CampaignResults
    fronts: tuple[ReplicaFront, ...]
    x: Array
    sources: tuple[str, ...]

    def labelled(self) -> dict[str, list[ReplicaFront]]:
        """The fronts by label."""
        found: dict[str, list[ReplicaFront]] = {}
        for front in self.fronts:
            found.setdefault(front.label, []).append(front)
        return found


def known_paths(root: Path) -> Array:
    """Paths (m, n_path) that another experiment ends with: of all polished fronts together the
    balanced one, of each of them both ends and the middle.

    Args:
        root: its results folder.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    campaign = read_campaign(root)
    n = campaign.workcell.task.n_path
    found = [path[None] for path in least_force(campaign).values()]
    polished = [front for front in campaign.fronts if front.polished and len(front)]
    found += [front.x[[0, len(front) // 2, -1], :n] for front in polished]
    return np.unique(np.concatenate(found), axis=0) if found else np.empty((0, n))


def least_force(campaign: CampaignResults) -> dict[str, Array]:
    """The balanced path (n_path,) of all fronts of an experiment, by its label; empty where no
    carry was found."""
    evaluator = CandidateEvaluator(campaign.workcell, campaign.objectives)
    chosen = select(evaluator, np.concatenate([front.x for front in campaign.fronts]))
    return {} if chosen is None else {LEAST_FORCE: chosen.carry.x[: campaign.workcell.task.n_path]}


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


def drivable_fronts(root: Path) -> DrivableFronts:
    """The fronts of a drivable experiment.

    Args:
        root: its own results folder, see `drivable_root`.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    results = read_campaign(root)
    fronts = results.fronts
    x = np.concatenate([front.x for front in fronts])
    objectives = np.concatenate([front.objectives for front in fronts])
    sources = [front.source for front in fronts for _ in front.x]
    rows = metrics.front_rows(objectives, np.ones(len(objectives), dtype=bool))
    return DrivableFronts(results, fronts, x[rows], tuple(sources[row] for row in rows))


def limits_on_jerk(root: Path) -> Table | None:
    """Costs of the cell's limits on jerk for the selected carries, the hand-made one's first; None
    where no jerk is limited.

    Args:
        root: results folder of the drivable experiment.

    Raises:
        ResultsError: a timing is damaged.
    """
    found: dict[str, list[StoredJerk]] = {}
    for path in sorted((root / TIMING).rglob("*.json")):
        jerk = read_timing(path).jerk
        if jerk is not None and jerk.status == TimingStatus.OK:
            found.setdefault(_label(path.relative_to(root / TIMING)), []).append(jerk)
    if not found:
        return None
    rows = []
    for label, timings in found.items():
        within = np.array([jerk.duration for jerk in timings])
        without = np.array([jerk.without for jerk in timings])
        cost = 100.0 * (within / without - 1.0)
        durations = (number(float(np.median(each)), 3) for each in (without, within))
        costs = (number(each, 1) for each in (float(np.median(cost)), float(cost.max())))
        rows.append((label, str(len(timings)), *durations, *costs))
    return Table(
        "jerk",
        "What limits on jerk cost the selected drivable carries.",
        ("limits on jerk", "carries", "without [s]", "within [s]", "cost [%]", "at most [%]"),
        tuple(rows),
        "Joints and payload within their largest jerk, at rest without acceleration at both ends. "
        "Medians over the carries.",
    )


def _label(path: Path) -> str:
    if len(path.parts) == 1:
        return path.stem
    folder = path.parts[0]
    name = title(folder.removesuffix(POLISHED_SUFFIX))
    return f"{name}, polished" if folder.endswith(POLISHED_SUFFIX) else name
