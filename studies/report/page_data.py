"""Data for the page's scripts: trajectories, pictures of fronts and shapes as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Any

import numpy as np

from hybrid_opt.campaign.cell_source import PackedCell
from hybrid_opt.display.scene import packed, scene_data
from hybrid_opt.work.service import Executor, SerialExecutor, Service, answer_all
from studies.report.page_carries import (
    PageCarriesSource,
    driven_point,
    page_trajectory,
)
from studies.report.page_groups import (
    RECOMMENDED,
    SYMBOLS,
    Group,
    curves,
    drive_groups,
    search_groups,
    spread,
)
from studies.report.page_views import FrontView, drive_look
from studies.report.records import DrivableReport, ReportData
from studies.report.style import HAND_MADE, LineStyle, series
from studies.study.drivable import is_drivable
from symbolic.array import Array
from symbolic.read.cell_files import CellFiles, cell_to_json

MAX_CLOUD = 1500
"""Feasible candidates per algorithm in the background of the fronts."""

MAX_CELL_BYTES = 2_000_000
"""A cell whose files are larger is not put into the page, so that nothing can be saved from it."""

Numbered = tuple[Group, list[int]]
"""A group and the numbers of its trajectories on the page."""


class PageData:
    """Collects what the page shows."""

    def __init__(self, data: ReportData) -> None:
        """Collect what a page shows of a report's data."""
        self._data = data
        self._trajectories: list[dict[str, Any]] = []
        # Where the cell itself is drivable there is one experiment.
        alone = is_drivable(data.workcell, data.objectives)
        self._cells = [] if alone else [(data.files, data.objectives)]
        if data.drivable is not None:
            self._cells.append((data.drivable.files, data.drivable.summary.objectives))

    def document(self, executor: Executor | None = None) -> dict[str, Any]:
        """The page's data as JSON values.

        Args:
            executor: who works out the trajectories, None for this process.
        """
        data = self._data
        last, drive = len(self._cells) - 1, list[Group]()
        if data.drivable is not None:
            drive = drive_groups(data, data.drivable, last)
        alone = is_drivable(data.workcell, data.objectives)
        search = [] if alone else search_groups(data, 0)
        numbered = self._work_out([*drive, *search], executor or SerialExecutor())
        views = []
        if data.drivable is not None:
            views.append(self._drive_view(data.drivable, numbered[: len(drive)]))
        if search:
            views.append(self._search_view(numbered[len(drive) :]))
        contacts = data.workcell.contacts
        rest = data.static[:2]
        known_rest = bool(np.isfinite(rest).all()) and len(rest) == 2
        force = rest * data.workcell.task.reference_force[: len(rest)]
        return {
            "robots": [robot.name for robot in data.workcell.robots],
            "joints": [len(robot.torque_max) for robot in data.workcell.robots],
            "patchRadius": min(contact.patch_radius for contact in contacts),
            "restForce": float(force.max()) if known_rest else None,
            "first": self._first(numbered),
            "trajectories": self._trajectories,
            "views": views,
            "lists": [{"label": group.listed, "members": members} for group, members in numbered],
            "cells": [_cell_json(files) for files, _ in self._cells],
            **scene_data(data.geometry, data.carries[-1].timed),
        }

    def _work_out(self, groups: Sequence[Group], executor: Executor) -> list[Numbered]:
        """Work out every trajectory of the groups, each with its number on the page."""
        source = PageCarriesSource(
            tuple((PackedCell.of(files), objectives) for files, objectives in self._cells)
        )
        shown = [one for group in groups for one in group.shown]
        self._trajectories = answer_all(executor, Service(source, page_trajectory), shown)
        numbers = iter(range(len(shown)))
        return [(group, list(islice(numbers, len(group.shown)))) for group in groups]

    def _first(self, groups: Sequence[Numbered]) -> int:
        """The trajectory to begin with: the recommended one, else the first selected one."""
        members = groups[0][1] if groups else []
        if self._data.drivable is None and len(members) > 1:
            return members[1]
        return members[0] if members else 0

    def _add(self, view: FrontView, groups: Sequence[Numbered]) -> None:
        """Put the points of groups into their picture."""
        for group, members in groups:
            if group.look is None:
                continue
            points = group.points
            if points is None:
                points = np.array([driven_point(self._trajectories[k]) for k in members])
            view.add(group.label, members, points, group.look)

    def _drive_view(self, drivable: DrivableReport, groups: Sequence[Numbered]) -> dict[str, Any]:
        """Time against force of hand-made path, the other experiment's optimum and the fronts."""
        kind = self._data.force_kind
        view = FrontView(
            f"Time against {kind.name}", f"{kind.title} [N]", "duration [s]", clouds=[]
        )
        self._add(view, groups)
        for _, label, look, force, duration in curves(self._data):
            view.lines.append(
                {
                    "label": label,
                    "x": force.tolist(),
                    "y": duration.tolist(),
                    "colour": look.colour,
                    "dash": "dot" if look is HAND_MADE else "dash",
                }
            )
        for entry in drivable.fronts:
            if len(entry.cloud):
                view.clouds.append(_cloud(entry.front.label, entry.cloud, series(entry.index)))
        drawn = [np.column_stack([line["x"], line["y"]]) for line in view.lines]
        for group in view.groups:
            # What robots cannot drive has no place between force and time.
            can = [not self._trajectories[member]["problem"] for member in group["members"]]
            drawn.append(np.column_stack([group["x"], group["y"]])[can])
        chosen = [
            np.column_stack([g["x"], g["y"]]) for g in view.groups if g["label"] == RECOMMENDED
        ]
        nothing = np.zeros((0, 2))
        seen = drive_look(np.concatenate([*drawn, nothing]), np.concatenate([*chosen, nothing]))
        return view.document(seen)

    def _search_view(self, groups: Sequence[Numbered]) -> dict[str, Any]:
        """The fronts of the first experiment."""
        data = self._data
        titles = [*data.objective_titles, "", ""]
        view = FrontView("The search's objectives", f"{titles[0]} [-]", f"{titles[1]} [-]")
        selected = np.array([carry.objectives for carry in data.carries])
        searched = [selected[1:] if len(selected) > 1 else selected]
        two = len(data.objectives) >= 2
        self._add(view, groups)
        for algorithm in data.solved:
            run = algorithm.shown
            cloud = run.evaluations.objectives[run.evaluations.feasible]
            if two:
                view.clouds.append(_cloud(algorithm.title, cloud[:, :2], series(algorithm.index)))
            searched.append(run.front.objectives)
        rest = data.static[:2]
        if len(rest) == 2 and np.isfinite(rest).all():
            view.star = (float(rest[0]), float(rest[1]), "level payload at rest")
            searched.append(rest[None])
        first = np.concatenate([points[:, :2] for points in searched])
        return view.document(first if two else np.zeros((0, 2)))


def _cloud(label: str, points: Array, look: LineStyle) -> dict[str, Any]:
    rows = spread(len(points), MAX_CLOUD)
    return {
        "label": f"{label}: feasible",
        "points": packed(points[rows], np.float32),
        "colour": look.colour,
        "symbol": SYMBOLS[look.marker],
    }


def _cell_json(files: CellFiles) -> dict[str, Any] | None:
    if sum(map(len, files.files.values())) > MAX_CELL_BYTES:
        return None
    return cell_to_json(files)
