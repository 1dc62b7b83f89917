"""The stage that times every selected trajectory as a robot can drive it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hybrid_opt.campaign import CampaignFolder, Progress, Stage
from hybrid_opt.campaign.layout import SELECTED
from hybrid_opt.store.files import storing, write_json
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import (
    ForceCurve,
    TimingModel,
    TimingReport,
    duration_against_force_limit,
    report_timing,
)
from hybrid_opt.timing.robustness import (
    Margin,
    PayloadSensitivity,
    payload_sensitivity,
    robustness_margins,
)
from hybrid_opt.work.children import in_children
from studies.timing_text import timing_json, timing_text, timings
from symbolic.array import Array
from symbolic.workcell.records import Workcell

TIMING = "timing"
"""Folder of the timings in a results folder, laid out as that of the selected trajectories."""

INITIAL = "initial.json"
"""The hand-made trajectory's timings in that folder."""


@dataclass(frozen=True)
class TimedTrajectory:
    """All that timing says of one trajectory.

    Attributes:
        report: the search's timing and the drivable ones.
        payload: per timing the forces against the payload.
        margins: how wrong the cell's description may be; empty without a drivable timing.
        curve: duration against force limit, None where it was not asked for.
        workcell: the cell.
    """

    report: TimingReport
    payload: dict[str, PayloadSensitivity]
    margins: tuple[Margin, ...]
    curve: ForceCurve | None
    workcell: Workcell

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return timing_json(self.report, self.payload, self.margins, self.curve, self.workcell)

    def text(self) -> str:
        """As a table for a terminal."""
        return timing_text(self.report, self.payload, self.margins, self.curve, self.workcell)


def timed_trajectory(
    model: TimingModel,
    x: Array,
    force_limit: float | None = None,
    curve_points: int | None = None,
) -> TimedTrajectory:
    """Time one decision vector (n_var,) in every way.

    Args:
        force_limit: normal force [N] of a force-limited timing, None for no such timing.
        curve_points: points of the curve of duration against force limit, None for no curve.
    """
    report = report_timing(model, x, force_limit)
    payload = {
        name: payload_sensitivity(model, timing.carry)
        for name, timing in timings(report).items()
        if timing.carry is not None
    }
    closest = report.closest.carry
    return TimedTrajectory(
        report,
        payload,
        () if closest is None else robustness_margins(model, closest),
        None if curve_points is None else duration_against_force_limit(model, x, curve_points),
        model.workcell,
    )


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
    write_json(path, timed.document())
