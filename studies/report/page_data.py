"""What the page's scripts need: trajectories, pictures of fronts and shapes as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import hybrid_opt as ho
from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.display.scene import packed, scene_data
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.work.job import Executor, Job, answer_all
from hybrid_opt.work.serial import SerialExecutor
from studies.drivable import is_drivable
from studies.report.jobs import RECOMMENDED_LABEL, JobModelSource, drawn_job
from studies.report.page_carries import Collected, PageCarries, Shown
from studies.report.page_views import FrontView, drive_look
from studies.report.records import AlgorithmRuns, DrawnCarry, DrivableReport, Front, ReportData
from studies.report.style import HAND_MADE, LineStyle, series
from symbolic.array import Array
from symbolic.workcell.cell_files import CellFiles, cell_to_json

MAX_CLOUD = 1500
"""Feasible candidates per algorithm in the background of the fronts."""

MAX_FRONT = 40
"""Trajectories of one front on the page, spread evenly over it."""

CURVE_MEMBERS = 6
"""Points of a path's time against force that can be clicked."""

MAX_CELL_BYTES = 2_000_000
"""A cell whose files are larger is not put into the page, so that nothing can be saved from it."""

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


class PageData:
    """Collects what the page shows."""

    def __init__(self, data: ReportData, cell: ho.Cell) -> None:
        """Collect what a page shows.

        Args:
            data: of the report.
            cell: of the first experiment, with its objectives.
        """
        self._data, self._cell = data, cell
        self._collected = Collected(data.workcell.task.n_var)
        self._planned = {job.label: job for job in data.jobs}
        self._lists: list[dict[str, Any]] = []
        self._cells: list[CellFiles] = []

    def document(self, executor: Executor | None = None) -> dict[str, Any]:
        """The page's data as JSON values.

        Args:
            executor: who plans the jobs, None for this process.
        """
        data = self._data
        views = []
        first = 0
        if data.drivable is not None:
            views.append(self._drive_view(data.drivable))
            first = views[0]["groups"][0]["members"][0] if views[0]["groups"] else 0
        if not is_drivable(data.workcell, data.objectives):
            view, picked = self._search_view()
            views.append(view)
            first = first if data.drivable is not None else picked
        self._plan_jobs(executor or SerialExecutor())
        contacts = data.workcell.contacts
        rest = data.static[:2]
        known_rest = bool(np.isfinite(rest).all()) and len(rest) == 2
        force = rest * data.workcell.task.reference_force[: len(rest)]
        return {
            "robots": [robot.name for robot in data.workcell.robots],
            "joints": [len(robot.torque_max) for robot in data.workcell.robots],
            "patchRadius": min(contact.patch_radius for contact in contacts),
            "restForce": float(force.max()) if known_rest else None,
            "first": first,
            "trajectories": self._collected.trajectories,
            "views": views,
            "lists": self._lists,
            "cells": [_cell_json(files) for files in self._cells],
            **scene_data(data.geometry, data.carries[-1].timed),
        }

    def _plan_jobs(self, executor: Executor) -> None:
        """Plan the whole job around every trajectory that robots can drive."""
        jobs = self._collected.jobs
        plan = Job(JobModelSource(PackedCell.of(self._data.files)), drawn_job)
        for number, job in zip(jobs, answer_all(executor, plan, list(jobs.values())), strict=True):
            self._collected.add_job(number, job)

    def _carries(self, cell: ho.Cell, files: CellFiles) -> PageCarries:
        self._cells.append(files)
        return PageCarries(cell, len(self._cells) - 1, self._collected)

    def _drive_view(self, drivable: DrivableReport) -> dict[str, Any]:
        """Time against force of hand-made path, the other experiment's optimum and the fronts."""
        cell = ho.Cell(drivable.workcell, DRIVABLE_OBJECTIVES)
        carries = self._carries(cell, drivable.files)
        view = FrontView(
            "Time against force", "largest normal force [N]", "duration [s]", clouds=[]
        )
        always: list[Array] = []
        if drivable.recommended is not None:
            found = self._data.summary.recommendation
            source = "" if found is None else found.source
            title = f"{RECOMMENDED} ({source})"
            job = self._planned.get(RECOMMENDED_LABEL)
            shown = Shown(title, drivable.recommended, source, jerk=True, job=job)
            member = carries.add(shown)
            always.append(np.array([carries.point(member)]))
            view.add(RECOMMENDED, [member], always[0], CHOICE)
            self._lists.append({"label": RECOMMENDED, "members": [member]})
        self._curves(view, carries, drivable)
        for entry in drivable.fronts:
            look = series(entry.index)
            front, open_symbol = entry.front, not entry.front.polished
            members = [
                carries.add(Shown(front.source, front.x[row], front.source))
                for row in _spread(len(front.x), MAX_FRONT)
            ]
            points = np.array([carries.point(member) for member in members])
            polished = any(other.front.polished for other in drivable.fronts)
            view.add(front.label, members, points, _look(look, polished and open_symbol))
            self._lists.append({"label": front.source, "members": members})
            if len(entry.cloud):
                view.clouds.append(_cloud(front.label, entry.cloud, look))
        drawn = [np.column_stack([g["x"], g["y"]]) for g in (*view.groups, *view.lines)]
        chosen = np.concatenate([*always, np.zeros((0, 2))])
        return view.document(drive_look(np.concatenate([*drawn, np.zeros((0, 2))]), chosen))

    def _curves(self, view: FrontView, carries: PageCarries, drivable: DrivableReport) -> None:
        """Hand-made and selected paths at every force, some of the points to be clicked."""
        task = drivable.workcell.task
        looks = [HAND_MADE, *(series(a.index) for a in self._data.algorithms if a.best is not None)]
        drawn = zip(self._data.carries, self._data.timings, looks, strict=True)
        for carry, timed, look in drawn:
            known = np.isfinite(timed.curve.duration)
            force, duration = timed.curve.force[known], timed.curve.duration[known]
            source = self._source(carry)
            label = carry.label if carry is self._data.initial else f"{carry.label}: least force"
            view.lines.append(
                {
                    "label": label,
                    "x": force.tolist(),
                    "y": duration.tolist(),
                    "colour": look.colour,
                    "dash": "dot" if look is HAND_MADE else "dash",
                }
            )
            low, high = task.force_limit
            members = [
                carries.add(Shown(source, np.append(carry.x[: task.n_path], limit), source))
                for limit in force[_spread(len(force), CURVE_MEMBERS)]
                if low <= limit <= high
            ]
            points = np.array([carries.point(member) for member in members])
            style = {"colour": look.colour, "symbol": SYMBOLS[look.marker], "size": 7}
            view.add(f"{label}, timed", members, points, style)
            self._lists.append({"label": f"{label}, timed", "members": members})

    def _source(self, carry: DrawnCarry) -> str:
        """Whose a trajectory is: of which algorithm and replica, where it is no hand-made one."""
        for algorithm in self._data.algorithms:
            if carry is algorithm.best:
                return f"{carry.label}, replica {algorithm.shown.replica}: least force"
        return carry.label

    def _search_view(self) -> tuple[dict[str, Any], int]:
        """The fronts of the first experiment; also the trajectory to begin with."""
        data = self._data
        carries = self._carries(self._cell, data.files)
        titles = [*data.objective_titles, "", ""]
        view = FrontView("The search's objectives", f"{titles[0]} [-]", f"{titles[1]} [-]")
        picked = []
        for carry in data.carries:
            source, job = self._source(carry), self._planned.get(carry.label)
            picked.append(carries.add(Shown(source, carry.x, source, job=job)))
        self._lists.append({"label": "Hand-made and selected", "members": picked})
        selected = np.array([carry.objectives for carry in data.carries])
        searched = [selected[1:] if len(picked) > 1 else selected]
        two = len(data.objectives) >= 2
        for algorithm in data.solved:
            look, run = series(algorithm.index), algorithm.shown
            cloud = run.evaluations.objectives[run.evaluations.feasible]
            if two:
                view.clouds.append(_cloud(algorithm.title, cloud[:, :2], look))
            for label, front, opened in _fronts(algorithm):
                rows = _spread(len(front), MAX_FRONT)
                source = f"{label}, replica {run.replica}"
                members = [carries.add(Shown(source, front.x[row], source)) for row in rows]
                self._lists.append({"label": source, "members": members})
                if two:
                    view.add(label, members, front.objectives[rows][:, :2], _look(look, opened))
            searched.append(run.front.objectives)
        rest = data.static[:2]
        if len(rest) == 2 and np.isfinite(rest).all():
            view.star = (float(rest[0]), float(rest[1]), "level payload at rest")
            searched.append(rest[None])
        first = np.concatenate([points[:, :2] for points in searched])
        document = view.document(first if two else np.zeros((0, 2)))
        return document, picked[-1] if len(picked) == 1 else picked[1]


def _look(look: LineStyle, opened: bool) -> dict[str, Any]:
    symbol = SYMBOLS[look.marker]
    return {"colour": look.colour, "symbol": f"{symbol}-open" if opened else symbol, "size": 9}


def _cloud(label: str, points: Array, look: LineStyle) -> dict[str, Any]:
    rows = _spread(len(points), MAX_CLOUD)
    return {
        "label": f"{label}: feasible",
        "points": packed(points[rows], np.float32),
        "colour": look.colour,
        "symbol": SYMBOLS[look.marker],
    }


def _fronts(algorithm: AlgorithmRuns) -> list[tuple[str, Front, bool]]:
    """Label, front, and whether its points are open: those of a search beside a polish."""
    run = algorithm.shown
    if run.hybrid is None or not len(run.hybrid):
        return [(algorithm.title, run.front, False)]
    return [
        (algorithm.title, run.front, True),
        (f"{algorithm.title}, polished", run.hybrid, False),
    ]


def _spread(count: int, most: int) -> Sequence[int]:
    """At most so many of `count` rows, both ends among them."""
    rows = np.linspace(0, count - 1, min(count, most)).round().astype(int)
    return [int(row) for row in np.unique(rows)]


def _cell_json(files: CellFiles) -> dict[str, Any] | None:
    if sum(map(len, files.files.values())) > MAX_CELL_BYTES:
        return None
    return cell_to_json(files)
