"""The stage that times every selected trajectory as a robot can drive it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hybrid_opt.campaign import CampaignFolder, Progress, Stage, executor_for
from hybrid_opt.campaign.cell_source import CellsSource, ReadyCell
from hybrid_opt.campaign.documents import (
    HAND_MADE,
    POLISHED_SUFFIX,
    SELECTED,
    polished_selected_file,
    selected_file,
)
from hybrid_opt.campaign.results import read_summary
from hybrid_opt.campaign.summary import CampaignSummary
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import timed_trajectory
from hybrid_opt.timing.document import TimingDocument, timing_document
from hybrid_opt.work.service import Emit, Service, answer_all
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
        shown = set(shown_files(read_summary(folder.root)).values()) if curves else set[Path]()
        requests = [
            (read_trajectory(selected / f).x, force_limit, CURVE_POINTS if f in shown else None)
            for f in files
        ]
        driven = folder.workcell.task.time_law == "optimal"
        source = CellsSource.of(folder.files, folder.settings.objectives, driven)
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
