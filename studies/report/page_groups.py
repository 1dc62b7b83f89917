"""Which trajectories a page shows, in which groups: of the recommendation, of paths at every force,
of fronts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from studies.report.jobs import RECOMMENDED_LABEL, DrawnJob
from studies.report.page_carries import Shown
from studies.report.records import AlgorithmRuns, DrawnCarry, DrivableReport, Front, ReportData
from studies.report.style import HAND_MADE, LineStyle, series
from symbolic.array import Array

MAX_FRONT = 40
"""Trajectories of one front on the page, spread evenly over it."""

CURVE_MEMBERS = 6
"""Points of a path's time against force that can be clicked."""

SYMBOLS = {
    "o": "circle",
    "^": "triangle-up",
    "D": "diamond",
    "v": "triangle-down",
    "P": "cross",
    "s": "square",
}
"""Plotly's names of Matplotlib's markers."""

RECOMMENDED = "Recommended"
CHOICE = {"colour": "#b00020", "symbol": "star", "size": 17}


@dataclass(frozen=True)
class Group:
    """Trajectories that a page shows together.

    Attributes:
        listed: name of their list.
        shown: the trajectories.
        label, look: of their points in the picture; without a look they are only listed.
        points: (k, 2) of the picture, None for the force and the duration as robots drive them.
    """

    listed: str
    shown: tuple[Shown, ...]
    label: str = ""
    look: dict[str, Any] | None = None
    points: Array | None = None


def drive_groups(data: ReportData, drivable: DrivableReport, cell: int) -> list[Group]:
    """The recommended carry, some of the paths' points at every force, and the fronts."""
    groups = []
    if drivable.recommended is not None:
        found = data.summary.recommendation
        source = "" if found is None else found.source
        title, job = f"{RECOMMENDED} ({source})", _planned(data, RECOMMENDED_LABEL)
        shown = Shown(title, drivable.recommended, source, cell, jerk=True, job=job)
        groups.append(Group(RECOMMENDED, (shown,), RECOMMENDED, CHOICE))
    low, high = drivable.workcell.task.force_limit
    for carry, label, look, force, _ in curves(data):
        source = _source(data, carry)
        shown_here = tuple(
            Shown(source, np.append(carry.x[: drivable.workcell.task.n_path], limit), source, cell)
            for limit in force[spread(len(force), CURVE_MEMBERS)]
            if low <= limit <= high
        )
        style = {"colour": look.colour, "symbol": SYMBOLS[look.marker], "size": 7}
        groups.append(Group(f"{label}, timed", shown_here, f"{label}, timed", style))
    polished = any(entry.front.polished for entry in drivable.fronts)
    for entry in drivable.fronts:
        front, opened = entry.front, polished and not entry.front.polished
        rows = spread(len(front.x), MAX_FRONT)
        shown_here = tuple(Shown(front.source, front.x[k], front.source, cell) for k in rows)
        style = _look(series(entry.index), opened)
        groups.append(Group(front.source, shown_here, front.label, style))
    return groups


def search_groups(data: ReportData, cell: int) -> list[Group]:
    """Hand-made and selected trajectories, and the fronts of the first experiment."""
    picked = []
    for carry in data.carries:
        source, job = _source(data, carry), _planned(data, carry.label)
        picked.append(Shown(source, carry.x, source, cell, job=job))
    groups = [Group("Hand-made and selected", tuple(picked))]
    two = len(data.objectives) >= 2
    for algorithm in data.solved:
        look, replica = series(algorithm.index), algorithm.shown.replica
        for label, front, opened in _fronts(algorithm):
            rows = spread(len(front), MAX_FRONT)
            source = f"{label}, replica {replica}"
            groups.append(
                Group(
                    source,
                    tuple(Shown(source, front.x[row], source, cell, has_job=False) for row in rows),
                    label,
                    _look(look, opened) if two else None,
                    front.objectives[rows][:, :2],
                )
            )
    return groups


def curves(data: ReportData) -> Iterator[tuple[DrawnCarry, str, LineStyle, Array, Array]]:
    """Hand-made and selected paths: carry, label, look, and where they can be driven force
    limits [N] and durations [s]."""
    looks = [HAND_MADE, *(series(a.index) for a in data.algorithms if a.best is not None)]
    for carry, timed, look in zip(data.carries, data.timings, looks, strict=True):
        known = np.isfinite(timed.curve.duration)
        label = carry.label if carry is data.initial else f"{carry.label}: least force"
        yield carry, label, look, timed.curve.force[known], timed.curve.duration[known]


def _source(data: ReportData, carry: DrawnCarry) -> str:
    """Source of a trajectory: algorithm and replica, where it is no hand-made one."""
    for algorithm in data.algorithms:
        if carry is algorithm.best:
            return f"{carry.label}, replica {algorithm.shown.replica}: least force"
    return carry.label


def _planned(data: ReportData, label: str) -> DrawnJob | None:
    """The job that is planned already, where there is one."""
    return next((job for job in data.jobs if job.label == label), None)


def _look(look: LineStyle, opened: bool) -> dict[str, Any]:
    symbol = SYMBOLS[look.marker]
    return {"colour": look.colour, "symbol": f"{symbol}-open" if opened else symbol, "size": 9}


def _fronts(algorithm: AlgorithmRuns) -> list[tuple[str, Front, bool]]:
    """Label, front, and whether its points are open: those of a search beside a polish."""
    run = algorithm.shown
    if run.hybrid is None or not len(run.hybrid):
        return [(algorithm.title, run.front, False)]
    return [
        (algorithm.title, run.front, True),
        (f"{algorithm.title}, polished", run.hybrid, False),
    ]


def spread(count: int, most: int) -> Sequence[int]:
    """At most `most` of `count` rows, both ends among them."""
    rows = np.linspace(0, count - 1, min(count, most)).round().astype(int)
    return [int(row) for row in np.unique(rows)]
