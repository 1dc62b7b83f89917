"""The stage that times every selected trajectory as a robot can drive it."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from hybrid_opt.campaign import CampaignFolder, Progress, Stage
from hybrid_opt.campaign.layout import SELECTED
from hybrid_opt.store.files import storing, write_json
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import TimingModel, timed_trajectory
from hybrid_opt.work.children import in_children
from studies.timing_text import timing_json
from symbolic.array import Array

TIMING = "timing"
"""Folder of the timings in a results folder, laid out as that of the selected trajectories."""

INITIAL = "initial.json"
"""The hand-made trajectory's timings in that folder."""


def timing_stage(force_limit: float | None = None) -> Stage:
    """The stage that writes `timing/`: one document per selected trajectory.

    Args:
        force_limit: normal force [N] of an additional, force-limited timing.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        _run(folder, progress, force_limit)

    return Stage(TIMING, run, {"force_limit": force_limit})


def _run(folder: CampaignFolder, progress: Progress, force_limit: float | None) -> None:
    model = TimingModel(folder.workcell)
    selected = folder.root / SELECTED
    files = sorted(path.relative_to(selected) for path in selected.rglob("*.json"))
    found = {Path(INITIAL): folder.workcell.task.initial.reshape(-1)}
    found |= {file: read_trajectory(selected / file).x for file in files}
    calls = [partial(_store, folder, file, model, x, force_limit) for file, x in found.items()]
    with progress.stage(TIMING, len(calls), "trajectories") as advance:
        in_children(calls, folder.execution.jobs, lambda: advance(1))


def _store(
    folder: CampaignFolder, file: Path, model: TimingModel, x: Array, force_limit: float | None
) -> None:
    timed = timed_trajectory(model, x, force_limit)
    path = folder.root / TIMING / file
    with storing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, timing_json(timed))
