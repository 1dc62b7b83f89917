"""The stage that times every selected trajectory as a robot can drive it, and what limits on jerk
cost those carries."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np

from hybrid_opt.campaign import CampaignFolder, Stage, executor_for
from hybrid_opt.campaign.cell_source import ReadyCell, cells_of, ready_cells
from hybrid_opt.campaign.settings import POLISHED_SUFFIX, SELECTED
from hybrid_opt.display.table import Table, number
from hybrid_opt.metaheuristics.registry import title
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing.analysis import timed_trajectory
from hybrid_opt.timing.document import TimingDocument, read_timing, timing_document
from hybrid_opt.timing.records import TimingStatus
from hybrid_opt.work.service import Emit, Service, answer_all
from studies.study.recommendation import StoredRecommendation
from studies.study.summary import read_summary
from symbolic.array import Array

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
        shown = set(read_summary(folder.root).shown_files.values()) if curves else set[Path]()
        requests = [
            (read_trajectory(selected / f).x, force_limit, CURVE_POINTS if f in shown else None)
            for f in files
        ]
        driven = folder.workcell.task.time_law == "optimal"
        source = partial(ready_cells, cells_of(folder.files, folder.settings.objectives, driven))
        with progress.stage(TIMING, len(requests), "trajectories") as advance:
            workers = executor_for(folder.execution)
            found = answer_all(workers, Service(source, _document), requests, lambda *_: advance(1))
        for file, document in zip(files, found, strict=True):
            write_json(folder.root / TIMING / file, to_json(document))

    return Stage(TIMING, run, {"force_limit": force_limit})


def _document(cells: tuple[ReadyCell, ...], request: Request, emit: Emit) -> TimingDocument:
    own, driven = cells[0].jobs.timing, cells[-1].jobs.timing
    return timing_document(timed_trajectory(driven, *request, own=own))


def limits_on_jerk(root: Path, recommended: StoredRecommendation | None) -> Table | None:
    """Costs of the cell's limits on jerk for the selected carries, the hand-made one's first, and
    for the recommended one; None where no jerk is limited.

    Args:
        root: results folder of the drivable experiment.
        recommended: the carry to run, None without one.

    Raises:
        ResultsError: a timing is damaged.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    for path in sorted((root / TIMING).rglob("*.json")):
        jerk = read_timing(path).jerk
        if jerk is not None and jerk.status == TimingStatus.OK:
            label = file_label(path.relative_to(root / TIMING))
            found.setdefault(label, []).append((jerk.without, jerk.duration))
    if recommended is not None and math.isfinite(recommended.without_jerk):
        found["recommended"] = [(recommended.without_jerk, recommended.duration)]
    if not found:
        return None
    rows = []
    for label, timings in found.items():
        without, within = np.array(timings).T
        cost = 100.0 * (within / without - 1.0)
        durations = (number(float(np.median(each)), 3) for each in (without, within))
        costs = (number(each, 1) for each in (float(np.median(cost)), float(cost.max())))
        rows.append((label, str(len(timings)), *durations, *costs))
    return Table(
        "jerk",
        "What limits on jerk cost the selected drivable carries and the recommended one.",
        ("limits on jerk", "carries", "without [s]", "within [s]", "cost [%]", "at most [%]"),
        tuple(rows),
        "Joints and payload within their largest jerk, at rest without acceleration at both ends. "
        "Medians over the carries. The recommended one within as in its job, in whole cycles of "
        "the controllers.",
    )


def file_label(path: Path) -> str:
    """Label of a trajectory, by the place of its file in the folder of selected ones."""
    if len(path.parts) == 1:
        return path.stem
    folder = path.parts[0]
    name = title(folder.removesuffix(POLISHED_SUFFIX))
    return f"{name}, polished" if folder.endswith(POLISHED_SUFFIX) else name
