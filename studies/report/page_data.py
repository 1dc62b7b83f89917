"""What the page shows: which trajectories, in which groups, and the interactive pictures
that they stand in, as plotly's JSON values."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from hybrid_opt.campaign.stages import Cells, cells_of, ready_cells
from hybrid_opt.display.objects import ARM_COLOURS
from hybrid_opt.display.scene import packed, scene_data
from hybrid_opt.workers import LocalWorkers, Workers
from studies.report.data import Experiment, ReportData
from studies.report.drawing import MARKED, DrawnCarry, LineStyle
from studies.report.page_carries import (
    RECOMMENDED_LABEL,
    RECOMMENDED_TITLE,
    PageTrajectory,
    page_trajectory,
)
from symbolic.array import Array, evenly
from symbolic.path.pieces import resample_decisions
from symbolic.read.cell_files import cell_to_json
from symbolic.records import Workcell

Plot = dict[str, Any]

CLOUD_PER_ALGORITHM = 1500
"""Feasible candidates per algorithm in the background of the fronts."""

LOOK_MARGIN = 0.06
"""Margin beside the points that a look shows, as a share of their range."""

SHOWN_SLOWDOWN = 2.2
"""Durations in the first look at time and force, over the shortest one."""

HIGHEST = 1.3
"""Forces there, over the least one."""

SYMBOLS = {
    "o": "circle",
    "^": "triangle-up",
    "D": "diamond",
    "v": "triangle-down",
    "P": "cross",
    "s": "square",
}
"""Plotly's names of Matplotlib's markers."""

CHOICE = {"color": MARKED, "symbol": "star", "size": 17}
"""Marker of the recommended carry."""

DASHES = ("solid", "dash")
"""Dashes of the two robots' lines."""


def plain(text: str) -> str:
    """Escape a text in which plotly finds no markup."""
    return html.escape(text, quote=False)


def marker(look: LineStyle, opened: bool = False, size: float = 9) -> Plot:
    """Return the marker of a series, open if a polished front stands beside a searched one."""
    symbol = SYMBOLS[look.marker]
    return {"color": look.colour, "symbol": f"{symbol}-open" if opened else symbol, "size": size}


def points(label: str, at: Array, members: Sequence[int], texts: Sequence[str], look: Plot) -> Plot:
    """Points (k, 2) that show their trajectories, of these numbers on the page, when clicked."""
    at = np.asarray(at, dtype=float).reshape(-1, 2)
    return _scatter(
        label,
        at,
        mode="markers",
        customdata=list(members),
        text=[plain(text) for text in texts],
        hovertemplate="%{text}<extra></extra>",
        marker={**look, "line": {"color": "#000", "width": 1.2}},
    )


def cloud(label: str, at: Array, look: LineStyle) -> Plot:
    """Feasible candidates (n, 2) in the background, thinned out."""
    at = at[evenly(len(at), CLOUD_PER_ALGORITHM)]
    flat = [{"dtype": "f4", "bdata": packed(column, np.float32)} for column in at.T]
    style = {"color": look.colour, "symbol": SYMBOLS[look.marker], "size": 3, "opacity": 0.4}
    made = _scatter(f"{label}: feasible", at, mode="markers", hoverinfo="skip", marker=style)
    return made | {"x": flat[0], "y": flat[1]}


def line(label: str, at: Array, colour: str, dash: str) -> Plot:
    """Return a curve through points (k, 2)."""
    style = {"color": colour, "dash": dash, "width": 1.6}
    return _scatter(label, at, mode="lines", hoverinfo="skip", line=style)


def mark(label: str, at: Array) -> Plot:
    """One point (2,) with its name."""
    look = {"color": "#1d2327", "size": 11, "symbol": "x-thin", "line": {"width": 2.5}}
    return _scatter(label, at[None], mode="markers", hoverinfo="name", marker=look)


def _scatter(label: str, at: Array, **style: Any) -> Plot:
    x, y = at.T.tolist()
    return {"type": "scatter", "name": plain(label), "x": x, "y": y, **style}


def front_plot(name: str, titles: tuple[str, str], traces: list[Plot], first: Array) -> Plot:
    """Build a plot of fronts.

    Args:
        name: on its button.
        titles: of the axes.
        traces: the candidates behind everything first.
        first: (k, 2) points that the first look shows.
    """
    chosen = {"color": "rgba(0,0,0,0)", "size": 20, "line": {"color": MARKED, "width": 2.5}}
    whole = [np.column_stack([t["x"], t["y"]]) for t in traces if isinstance(t["x"], list)]
    ring = {"type": "scatter", "mode": "markers", "name": "chosen", "x": [], "y": []}
    x_title, y_title = map(plain, titles)
    return {
        "name": name,
        "data": [*traces, ring | {"hoverinfo": "skip", "showlegend": False, "marker": chosen}],
        "layout": {
            "hovermode": "closest",
            "margin": {"l": 70, "r": 15, "t": 20},
            "xaxis": {"title": {"text": x_title, "standoff": 8}},
            "yaxis": {"title": {"text": y_title}},
            "legend": _legend("bottom", 0.01, 11) | {"itemsizing": "constant"},
        },
        "first": limits(first),
        "whole": limits(np.concatenate([*whole, np.zeros((0, 2))])),
    }


def _legend(edge: str, place: float, size: int) -> Plot:
    """Return a legend in a row along an edge of the plot's element."""
    row = {"orientation": "h", "yref": "container", "y": place, "yanchor": edge}
    return {**row, "font": {"size": size}}


def limits(points: Array, share: float = LOOK_MARGIN) -> list[list[float]]:
    """Limits of both axes around points (k, 2), with this share of their range beside them."""
    points = _finite(points)
    if len(points) == 0:
        return [[0.0, 1.0], [0.0, 1.0]]
    low, high = points.min(axis=0), points.max(axis=0)
    room = np.maximum(share * (high - low), 1e-4)
    found: list[list[float]] = np.stack([low - room, high + room], axis=1).tolist()
    return found


def _finite(points: Array) -> Array:
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    return points[np.isfinite(points).all(axis=1)]


def drive_look(points: Array, always: Array) -> Array:
    """Points (k, 2) of force and duration that the first look shows.

    Both ends of a drivable front are long and flat: forces next to that of holding still, and
    durations next to the shortest. Neither is to squash what lies between.

    Args:
        points: of the fronts and curves.
        always: (n, 2) what the look has to show besides.
    """
    points = _finite(points)
    if len(points) == 0:
        return always
    force, duration = points.min(axis=0)
    near = (points[:, 0] <= HIGHEST * force) & (points[:, 1] <= SHOWN_SLOWDOWN * duration)
    return np.concatenate([points[near], always])


def carry_plots(workcell: Workcell, rest: float | None) -> dict[str, Plot]:
    """Build the plots of one trajectory by the ids of their elements. `meta` states the content of
    a trace: a column of its samples and a factor, a level, or one arm's share of a list of all
    joints.

    Args:
        rest: largest normal force of the level payload at rest [N], None where it is not known.
    """
    joints = [len(robot.torque_max) for robot in workcell.robots]
    radius = 1e3 * min(contact.patch_radius for contact in workcell.contacts)
    force = 7 + sum(joints)
    curve = {"type": "scatter", "mode": "lines"}
    plots = {}
    for name, title, column, scale, label, level in (
        ("force-plot", "normal force [N]", force, 1.0, "level payload at rest", rest),
        ("pressure-plot", "pressure shift [mm]", force + 2, 1e3, "patch radius", radius),
    ):
        traces = [
            {
                **curve,
                "name": plain(robot.name),
                "line": {"color": ARM_COLOURS[i], "dash": DASHES[i], "width": 2},
                "meta": {"column": column + i, "scale": scale},
            }
            for i, robot in enumerate(workcell.robots)
        ]
        if level is not None:
            look = {"color": "#000", "dash": "dot", "width": 1.5}
            meta = {"level": level}
            traces.append({**curve, "name": label, "hoverinfo": "name", "line": look, "meta": meta})
        y = {"title": {"text": title}, "rangemode": "normal"}
        x = {"title": {"text": "time [s]", "standoff": 6}}
        plots[name] = _carry_plot(traces, showlegend=True, xaxis=x, yaxis=y)
    bars = [
        {
            "type": "bar",
            "name": plain(f"{robot.name}{whose}"),
            "x": [f"joint {j + 1}" for j in range(joints[i])],
            "marker": {"color": ARM_COLOURS[i], "opacity": opacity},
            "meta": {"use": use, "arm": i},
        }
        for i, robot in enumerate(workcell.robots)
        for use, whose, opacity in (
            ("torqueUse", "", 1.0),
            ("contactTorqueUse", ", load alone", 0.45),
        )
    ]
    y = {"title": {"text": "largest joint torque [% of maximum]"}, "rangemode": "tozero"}
    plots["torque-plot"] = _carry_plot(bars, barmode="group", yaxis=y)
    return plots


def _carry_plot(traces: list[Plot], **layout: Any) -> Plot:
    margin, legend = {"l": 60, "r": 15, "t": 40, "b": 55}, _legend("top", 0.99, 10)
    return {"data": traces, "layout": {"margin": margin, **layout, "legend": legend}}


MAX_FRONT = 40
"""Trajectories of one front on the page, spread evenly over it."""

CURVE_MEMBERS = 6
"""Points of a path's time against force that can be clicked."""

MAX_CELL_BYTES = 2_000_000
"""A cell whose files are larger is not put into the page, so that nothing can be saved from it."""


@dataclass(frozen=True)
class MeshGroup:
    """Trajectories that a page shows together.

    Attributes:
        listed: name of their list.
        shown: the trajectories.
        label, look: of their points in the picture; without a look they are only listed.
        points: (k, 2) of the picture, None for the force and the duration as robots drive them.
    """

    listed: str
    shown: tuple[PageTrajectory, ...]
    label: str = ""
    look: Plot | None = None
    points: Array | None = None


Numbered = tuple[MeshGroup, list[int]]
"""A group and the numbers of its trajectories on the page."""


def page_document(data: ReportData, workers: Workers | None = None) -> dict[str, Any]:
    """Return the page's data as JSON values; without workers this process computes them."""
    # Where the cell itself is drivable there is one experiment.
    cells = [] if data.alone else [(data.files, data.objectives)]
    drive, search = list[MeshGroup](), [] if data.alone else list(_search_groups(data))
    if data.drivable is not None:
        drive = list(_drive_groups(data, data.drivable, len(cells)))
        cells.append((data.drivable.files, data.drivable.objectives))
        every: Cells = tuple(cells)
    else:
        every = cells_of(data.files, data.objectives, data.alone)
    shown = [one for group in (*drive, *search) for one in group.shown]
    found = (workers or LocalWorkers()).map(partial(_trajectory, every), shown)
    numbers = count()
    numbered = [(group, [next(numbers) for _ in group.shown]) for group in (*drive, *search)]
    views = []
    if data.drivable is not None:
        views.append(_drive_view(data, data.drivable, numbered[: len(drive)], found))
    if search:
        views.append(_search_view(data, numbered[len(drive) :], found))
    still, force = data.at_rest, data.workcell.task.reference_force
    return {
        "joints": [len(robot.torque_max) for robot in data.workcell.robots],
        "robots": [robot.name for robot in data.workcell.robots],
        # The recommended one, else the first selected one.
        "first": int(data.drivable is None and len(numbered[0][1]) > 1),
        "trajectories": found,
        "views": views,
        "plots": carry_plots(
            data.workcell, None if still is None else float((still * force).max())
        ),
        "lists": [{"label": group.listed, "members": members} for group, members in numbered],
        "cells": [
            cell_to_json(files) if sum(map(len, files.files.values())) <= MAX_CELL_BYTES else None
            for files, _ in cells
        ],
        **scene_data(data.geometry, data.carries[-1].timed),
    }


def _trajectory(cells: Cells, shown: PageTrajectory) -> dict[str, Any]:
    return page_trajectory(ready_cells(cells), shown)


def _drive_groups(data: ReportData, drivable: Experiment, cell: int) -> Iterator[MeshGroup]:
    """Yield the recommended carry, some of the paths' points at every force, and the fronts."""
    if data.recommended is not None:
        found = data.summary.recommendation
        source = "" if found is None else found.source
        shown = PageTrajectory(
            source, data.recommended, cell, recommended=True, job=data.job(RECOMMENDED_LABEL)
        )
        yield MeshGroup(RECOMMENDED_TITLE, (shown,), RECOMMENDED_TITLE, CHOICE)
    low, high = drivable.workcell.task.force_limit
    for carry, label, curve in curves(data):
        own, task = carry.timed.workcell.task, drivable.workcell.task
        source, path = carry.source, resample_decisions(carry.x, own, task)[0, : task.n_path]
        force = curve[evenly(len(curve), CURVE_MEMBERS), 0]
        some = tuple(
            PageTrajectory(source, np.append(path, limit), cell)
            for limit in force
            if low <= limit <= high
        )
        yield MeshGroup(f"{label}, timed", some, f"{label}, timed", marker(carry.look, size=7))
    for look, front, opened in drivable.fronts():
        some = tuple(
            PageTrajectory(front.source, front.x[k], cell) for k in evenly(len(front), MAX_FRONT)
        )
        yield MeshGroup(front.source, some, front.title, marker(look, opened))


def _search_groups(data: ReportData) -> Iterator[MeshGroup]:
    """Hand-made and selected trajectories, and the fronts of the first experiment."""
    picked = [PageTrajectory(c.source, c.x, job=data.job(c.label)) for c in data.carries]
    yield MeshGroup("Hand-made and selected", tuple(picked))
    two = len(data.objectives) >= 2
    for style, front, opened in data.fronts():
        rows = evenly(len(front), MAX_FRONT)
        some = tuple(PageTrajectory(front.source, front.x[k], has_job=False) for k in rows)
        look = marker(style, opened) if two else None
        yield MeshGroup(front.source, some, front.title, look, front.objectives[rows][:, :2])


def curves(data: ReportData) -> Iterator[tuple[DrawnCarry, str, Array]]:
    """Hand-made and selected paths: carry, label, and where they can be driven force limits [N] and
    durations [s] (k, 2)."""
    for carry, (_, timed) in zip(data.carries, data.timings, strict=True):
        if timed.force_curve is None:
            continue
        length = len(timed.force_curve.force)
        curve = np.column_stack([timed.force_curve.force, timed.force_curve.duration[:length]])
        label = carry.label if carry is data.initial else f"{carry.label}: least force"
        yield carry, label, curve[np.isfinite(curve[:, 1])]


def _traces(groups: Sequence[Numbered], found: Sequence[dict[str, Any]]) -> Iterator[Plot]:
    """Yield the points of groups in a plot."""
    for group, members in groups:
        if group.look is None:
            continue
        at = group.points
        if at is None:
            # The largest limited force [N] and the duration [s] as robots drive it.
            driven = [(found[k]["force"], found[k]["motions"][0]["duration"]) for k in members]
            at = np.array(driven)
        yield points(group.label, at, members, [found[k]["label"] for k in members], group.look)


def _drive_view(
    data: ReportData,
    drivable: Experiment,
    groups: Sequence[Numbered],
    found: Sequence[dict[str, Any]],
) -> Plot:
    """Time against force of hand-made path, the other experiment's optimum and the fronts."""
    clouds, lines, drawn = [], [], []
    for algorithm in drivable.solved:
        at = drivable.driven(algorithm.shown.feasible)
        clouds.append(cloud(algorithm.title, at, algorithm.look))
    for carry, label, curve in curves(data):
        dash = "dot" if carry is data.initial else "dash"
        lines.append(line(label, curve, carry.look.colour, dash))
        drawn.append(curve)
    # The recommended carry is drawn last, above all others.
    shown = sorted(_traces(groups, found), key=lambda trace: trace["name"] == RECOMMENDED_TITLE)
    timed = {f"{one['name']}, timed" for one in lines}
    chosen = np.zeros((0, 2))
    for trace in shown:
        at = np.column_stack([trace["x"], trace["y"]])
        trace["showlegend"] = trace["name"] not in timed
        # Carries that robots cannot drive have no place between force and time.
        drawn.append(at[[not found[member]["problem"] for member in trace["customdata"]]])
        chosen = at if trace["name"] == RECOMMENDED_TITLE else chosen
    seen = drive_look(np.concatenate([*drawn, np.zeros((0, 2))]), chosen)
    kind = data.force_kind
    titles = (f"{kind.title} [N]", "duration [s]")
    return front_plot(f"Time against {kind.name}", titles, [*clouds, *lines, *shown], seen)


def _search_view(
    data: ReportData, groups: Sequence[Numbered], found: Sequence[dict[str, Any]]
) -> Plot:
    """Build the plot of the first experiment's fronts."""
    titles = [*data.objective_titles, "", ""]
    judged = [carry.timed.judgement for carry in data.carries]
    selected = np.array([list(one.objectives.values()) for one in judged if one is not None])
    searched, two = [selected[1:] if len(selected) > 1 else selected], len(data.objectives) >= 2
    traces, shown = list[Plot](), list(_traces(groups, found))
    for algorithm in data.solved:
        run = algorithm.shown
        if two:
            traces.append(cloud(algorithm.title, run.feasible[:, :2], algorithm.look))
        searched.append(run.front.objectives)
    if data.at_rest is not None:
        shown.append(mark("level payload at rest", data.at_rest))
        searched.append(data.at_rest[None])
    first = np.concatenate([points[:, :2] for points in searched]) if two else np.zeros((0, 2))
    axes = (f"{titles[0]} [-]", f"{titles[1]} [-]")
    return front_plot("The search's objectives", axes, [*traces, *shown], first)
