"""Content of the page as plotly's JSON values: trajectories in groups, and interactive plots."""

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
from hybrid_opt.evaluate.objectives import front_of
from hybrid_opt.recommending.recommendation import ABOVE_STILL, level_force
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.workers import LocalWorkers, Workers
from studies.report.data import Experiment, ReportData
from studies.report.drawing import MARKED, LineStyle
from studies.report.page_carries import (
    RECOMMENDED_LABEL,
    RECOMMENDED_TITLE,
    PageTrajectory,
    page_trajectory,
)
from symbolic.array import Array, evenly
from symbolic.path.spline import resample_decisions
from symbolic.read.cell_files import cell_to_json
from symbolic.records import Workcell

Plot = dict[str, Any]

CLOUD_PER_ALGORITHM = 1500
"""Most feasible candidates per algorithm that are drawn behind the fronts."""

LOOK_MARGIN = 0.06
"""Margin around the points that a plot first shows, as a share of their range."""

SHOWN_SLOWDOWN = 2.2
"""The plot of time against force first shows durations up to this multiple of the shortest one."""

HIGHEST = 1.15
"""The plot of time against force first shows forces up to this multiple of the allowed one."""

SYMBOLS = {
    "o": "circle",
    "^": "triangle-up",
    "D": "diamond",
    "v": "triangle-down",
    "P": "cross",
    "s": "square",
}
"""Plotly's names of the markers by Matplotlib's names."""

CHOICE = {"color": MARKED, "symbol": "star", "size": 17}
"""Marker of the recommended carry."""


def plain(text: str) -> str:
    """Escape a text so that plotly finds no markup in it."""
    return html.escape(text, quote=False)


def marker(look: LineStyle, opened: bool = False, size: float = 9) -> Plot:
    """Return plotly's marker in a line style.

    Args:
        look: the line style.
        opened: True for a marker without filling, as for searched fronts beside polished ones.
        size: size of the marker [pixels].
    """
    symbol = SYMBOLS[look.marker]
    return {"color": look.colour, "symbol": f"{symbol}-open" if opened else symbol, "size": size}


def points(label: str, at: Array, members: Sequence[int], texts: Sequence[str], look: Plot) -> Plot:
    """Return a plotly trace of points, each of which shows its trajectory when it is clicked.

    Args:
        label: name in the legend.
        at: (k, 2) coordinates.
        members: index of each point's trajectory on the page.
        texts: text of each point that is shown while the pointer is over it.
        look: plotly's marker.
    """
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
    """Return a plotly trace of feasible candidates for the background of a plot.

    Args:
        label: name of the algorithm.
        at: (n, 2) coordinates, of which at most `CLOUD_PER_ALGORITHM` are kept.
        look: line style of the algorithm.
    """
    at = at[evenly(len(at), CLOUD_PER_ALGORITHM)]
    flat = [{"dtype": "f4", "bdata": packed(column, np.float32)} for column in at.T]
    style = {"color": look.colour, "symbol": SYMBOLS[look.marker], "size": 3, "opacity": 0.4}
    made = _scatter(f"{label}: feasible", at, mode="markers", hoverinfo="skip", marker=style)
    return made | {"x": flat[0], "y": flat[1]}


def line(label: str, at: Array, colour: str, dash: str) -> Plot:
    """Return a plotly trace of a line.

    Args:
        label: name in the legend.
        at: (k, 2) points of the line.
        colour: CSS colour.
        dash: plotly's name of the line's pattern.
    """
    style = {"color": colour, "dash": dash, "width": 1.6}
    return _scatter(label, at, mode="lines", hoverinfo="skip", line=style)


def mark(label: str, at: Array) -> Plot:
    """Return a plotly trace of one marked point.

    Args:
        label: name in the legend.
        at: (2,) point.
    """
    look = {"color": "#1d2327", "size": 11, "symbol": "x-thin", "line": {"width": 2.5}}
    return _scatter(label, at[None], mode="markers", hoverinfo="name", marker=look)


def _scatter(label: str, at: Array, **style: Any) -> Plot:
    x, y = at.T.tolist()
    return {"type": "scatter", "name": plain(label), "x": x, "y": y, **style}


def front_plot(name: str, titles: tuple[str, str], traces: list[Plot], first: Array) -> Plot:
    """Return a plotly plot of fronts.

    Args:
        name: text on the button that shows the plot.
        titles: titles of both axes.
        traces: the plot's traces, from back to front.
        first: (k, 2) points that are visible at first.
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
    """Return a plotly legend in one row.

    Args:
        edge: edge of the row that lies at `place`, 'top' or 'bottom'.
        place: height in the plot's element, from 0 at the bottom to 1.
        size: size of the font [px].
    """
    row = {"orientation": "h", "yref": "container", "y": place, "yanchor": edge}
    return {**row, "font": {"size": size}}


def limits(points: Array, share: float = LOOK_MARGIN) -> list[list[float]]:
    """Return plotly's ranges [least, largest] of both axes, such that points are visible.

    Args:
        points: (k, 2) the points.
        share: margin on each side, over the range of the points.
    """
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


def drive_look(points: Array, always: Array, allowed: float) -> Array:
    """Select the points of duration and force that a plot shows at first. Points much slower than
    the fastest one or far above the reference force are left out, because they would squash the
    others.

    Args:
        points: (n, 2) force [N] and duration [s] of fronts and curves.
        always: (m, 2) points that are selected in any case.
        allowed: reference force [N].

    Returns:
        (k, 2) selected points.
    """
    points = _finite(points)
    if len(points) == 0:
        return always
    duration = points[:, 1].min()
    near = (points[:, 0] <= HIGHEST * allowed) & (points[:, 1] <= SHOWN_SLOWDOWN * duration)
    return np.concatenate([points[near], always])


def carry_plots(workcell: Workcell) -> dict[str, Plot]:
    """Return the plotly plots of one trajectory by the ids of their HTML elements, without data.

    The page's script inserts the data. The value `meta` of each trace tells it which: `column`, a
    column of the samples; `level`, a constant; or `use` and `arm`, the use of torque by one arm's
    joints. With `column` there is also `planned`, the name of the trace if the page shows planned
    in place of commanded forces.
    """
    joints, arm = [len(robot.torque_max) for robot in workcell.robots], 1 - LEADER
    force, robot = 7 + sum(joints), plain(workcell.robots[arm].name)
    curve = {"type": "scatter", "mode": "lines"}
    traces = [
        {
            **curve,
            "name": name,
            "line": {"color": colour, "dash": dash, "width": width},
            "meta": {"column": column, "planned": planned},
        }
        for name, planned, column, colour, dash, width in (
            (
                f"commanded, {robot}",
                f"planned, {robot}",
                force + arm,
                ARM_COLOURS[arm],
                "solid",
                2.4,
            ),
            ("needed in every case", "", force + 2, "#b00020", "solid", 1.4),
            ("needed if all is as described", "", force + 3, "#555555", "dash", 1.4),
        )
    ]
    level = float(workcell.task.reference_force[arm])
    look = {"color": "#000", "dash": "dot", "width": 1.5}
    allowed = {"name": f"allowed {level:.1f} N", "hoverinfo": "name", "line": look}
    traces.append({**curve, **allowed, "meta": {"level": level}})
    y = {"title": {"text": "normal force [N]"}, "rangemode": "tozero"}
    x = {"title": {"text": "time [s]", "standoff": 6}}
    plots = {"force-plot": _carry_plot(traces, showlegend=True, xaxis=x, yaxis=y)}
    bars = [
        {
            "type": "bar",
            "name": plain(f"{robot.name}{whose if judged else ', torques unknown'}"),
            "x": [f"joint {j + 1}" for j in range(joints[i])],
            "marker": {"color": ARM_COLOURS[i]},
            "opacity": opacity,  # of the trace, which its swatch in the legend has as well
            "meta": {"use": use, "arm": i},
        }
        for i, robot in enumerate(workcell.robots)
        for judged in [bool(np.isfinite(robot.torque_max).all())]
        for use, whose, opacity in (
            ("torqueUse", "", 1.0),
            ("contactTorqueUse", ", load alone", 0.45),
        )[: 2 if judged else 1]
    ]
    y = {"title": {"text": "largest joint torque [% of maximum]"}, "rangemode": "tozero"}
    plots["torque-plot"] = _carry_plot(bars, barmode="group", yaxis=y)
    return plots


def _carry_plot(traces: list[Plot], **layout: Any) -> Plot:
    margin, legend = {"l": 60, "r": 15, "t": 40, "b": 55}, _legend("top", 0.99, 10)
    return {"data": traces, "layout": {"margin": margin, **layout, "legend": legend}}


MAX_FRONT = 40
"""Most trajectories of one front of the search that the page holds, spread evenly over the
front."""

MAX_DRIVEN = 16
"""Most trajectories of one drivable front that the page holds; timing each within limits on jerk
takes a second."""

CURVE_MEMBERS = 4
"""Number of force limits for which the page holds the hand-made path."""

MAX_CELL_BYTES = 2_000_000
"""Largest total size of a cell's files that the page holds [bytes]. Without the files, trajectories
cannot be saved from the page."""


@dataclass(frozen=True)
class MeshGroup:
    """Trajectories that share one list on the page and one trace in a plot.

    Attributes:
        listed: name of the list.
        shown: the trajectories.
        label: name of the trace.
        look: plotly's marker of the trace, None for trajectories that are only listed.
        points: (k, 2) coordinates in the plot; None for commanded force and duration as robots
            drive the trajectories.
        joined: True if a line joins the points.
    """

    listed: str
    shown: tuple[PageTrajectory, ...]
    label: str = ""
    look: Plot | None = None
    points: Array | None = None
    joined: bool = False


Numbered = tuple[MeshGroup, list[int]]
"""A group of trajectories, and the indices of these on the page."""


def page_document(
    data: ReportData, workers: Workers | None = None, paper: bool = True
) -> dict[str, Any]:
    """Return the data of the page's scripts as JSON values: cells, trajectories and plots.

    Args:
        data: what the report shows.
        workers: processes that compute trajectories, None for this process.
        paper: True to include the selected carries and the fronts of the first experiment.
    """
    # Where the cell itself is drivable there is one experiment.
    cells = [] if data.alone else [(data.files, data.objectives)]
    drive = list[MeshGroup]()
    search = [] if data.alone else list(_search_groups(data, paper or data.drivable is None))
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
    if any(group.look for group in search):
        views.append(_search_view(data, numbered[len(drive) :], found))
    driven = data.recommended_carry or data.carries[-1]
    return {
        "joints": [len(robot.torque_max) for robot in data.workcell.robots],
        "robots": [robot.name for robot in data.workcell.robots],
        # The recommended one, else the first selected one.
        "first": int(data.drivable is None and len(numbered[0][1]) > 1),
        "trajectories": found,
        "views": views,
        "plots": carry_plots((data.drivable or data).workcell),
        "lists": [{"label": group.listed, "members": members} for group, members in numbered],
        "cells": [
            cell_to_json(files) if sum(map(len, files.files.values())) <= MAX_CELL_BYTES else None
            for files, _ in cells
        ],
        **scene_data(data.geometry, driven.timed),
    }


def _trajectory(cells: Cells, shown: PageTrajectory) -> dict[str, Any]:
    return page_trajectory(ready_cells(cells), shown)


def _drive_groups(data: ReportData, drivable: Experiment, cell: int) -> Iterator[MeshGroup]:
    """Yield the groups of trajectories of the drivable experiment, which the page times as a job
    does.

    These are the recommended carry, the hand-made path at some force limits, and the fronts that no
    polished front replaces.

    Args:
        data: what the report shows.
        drivable: the drivable experiment.
        cell: index of the trajectories' cell on the page.
    """
    if data.recommended is not None:
        found = data.summary.recommendation
        source = "" if found is None else found.source
        shown = PageTrajectory(
            source, data.recommended, cell, recommended=True, job=data.job(RECOMMENDED_LABEL)
        )
        yield MeshGroup(RECOMMENDED_TITLE, (shown,), RECOMMENDED_TITLE, CHOICE)
    (low, high), task = drivable.workcell.task.force_limit, drivable.workcell.task
    (path,) = resample_decisions(data.initial.x, data.initial.timed.workcell.task, task)
    still = level_force(drivable.workcell, drivable.force_kind)
    limits = np.array(ABOVE_STILL)[evenly(len(ABOVE_STILL), CURVE_MEMBERS)] * still
    some = tuple(
        PageTrajectory(data.initial.source, np.append(path[: task.n_path], limit), cell)
        for limit in limits.tolist()
        if low <= limit <= high
    )
    look = marker(data.initial.look, size=7)
    label = data.initial.label
    yield MeshGroup(f"{label}, driven", some, label, look, joined=True)
    for look_of, front, replaced in drivable.fronts():
        if not replaced:
            rows = evenly(len(front), MAX_DRIVEN)
            some = tuple(PageTrajectory(front.source, front.x[k], cell) for k in rows)
            yield MeshGroup(front.source, some, front.title, marker(look_of))


def _search_groups(data: ReportData, paper: bool) -> Iterator[MeshGroup]:
    """Yield the groups of trajectories of a study's first experiment.

    These are the hand-made trajectory, the selected ones, and the fronts.

    Args:
        data: what the report shows.
        paper: False to yield the hand-made trajectory alone.
    """
    picked = [PageTrajectory(c.source, c.x, job=data.job(c.label)) for c in data.carries]
    if not paper:
        yield MeshGroup("Hand-made", tuple(picked[:1]))
        return
    yield MeshGroup("Hand-made and selected", tuple(picked))
    two = len(data.objectives) >= 2
    for style, front, opened in data.fronts():
        rows = evenly(len(front), MAX_FRONT)
        some = tuple(PageTrajectory(front.source, front.x[k]) for k in rows)
        look = marker(style, opened) if two else None
        yield MeshGroup(front.source, some, front.title, look, front.objectives[rows][:, :2])


def _traces(groups: Sequence[Numbered], found: Sequence[dict[str, Any]]) -> Iterator[Plot]:
    """Yield a plotly trace for each group of trajectories that has a marker: one point per
    trajectory, which shows the trajectory when it is clicked.

    A point lies at the coordinates that the group states. If it states none, the point lies at
    commanded force [N] and duration [s] of the trajectory as robots drive it. Trajectories without
    a commanded force then have no point, and symbols are open where this force exceeds the
    reference force. A line joins the points if `MeshGroup.joined` is True.

    Args:
        groups: pairs of a group and the indices of its trajectories on the page.
        found: JSON values of all trajectories of the page, by number.
    """
    for group, members in groups:
        if group.look is None:
            continue
        at, look = group.points, group.look
        if at is None:
            held = [k for k in members if found[k]["commanded"] is not None]
            members = sorted(held, key=lambda k: found[k]["commanded"])
            at = np.array([(found[k]["commanded"], found[k]["duration"]) for k in members])
            beyond = [found[k]["beyond"] for k in members]
            symbol = look["symbol"]
            if any(beyond):
                symbols = [f"{symbol}-open" if far else symbol for far in beyond]
                look = {**look, "symbol": symbols}
        trace = points(group.label, at, members, [found[k]["label"] for k in members], look)
        if group.joined:
            line = {"color": look["color"], "dash": "dot", "width": 1.4}
            trace |= {"mode": "lines+markers", "line": line}
        yield trace


def _drive_view(
    data: ReportData,
    drivable: Experiment,
    groups: Sequence[Numbered],
    found: Sequence[dict[str, Any]],
) -> Plot:
    """Return the plotly plot of duration against commanded force, with the timings of jobs.

    The plot shows the hand-made path, the fronts, the recommended carry and the allowed force.

    Args:
        data: what the report shows.
        drivable: the drivable experiment.
        groups: pairs of a group and the numbers of its trajectories on the page.
        found: JSON values of all trajectories of the page, by number.
    """
    allowed = float(drivable.workcell.task.reference_force[1 - LEADER])
    # The recommended carry is drawn last, above all others.
    shown = sorted(_traces(groups, found), key=lambda trace: trace["name"] == RECOMMENDED_TITLE)
    at = {t["name"]: np.column_stack([t["x"], t["y"]]) for t in shown}
    hand_made = data.initial.label
    chosen = at.get(RECOMMENDED_TITLE, np.zeros((0, 2)))
    own = [points for name, points in at.items() if name != hand_made]
    best = front_of(np.concatenate([*own, np.zeros((0, 2))]))
    joined = line("front", best[np.argsort(best[:, 0])], "#555555", "solid")
    every = np.concatenate([*at.values(), np.zeros((0, 2))])
    least = np.array([[allowed, every[:, 1].min(initial=np.inf)]])
    seen = drive_look(every, np.concatenate([chosen, least]), allowed)
    titles = ("largest commanded force [N]", "duration of the carry [s]")
    view = front_plot("Time against commanded force", titles, [joined, *shown], seen)
    view["layout"] |= _allowed(allowed)
    return view


def _allowed(force: float) -> Plot:
    """Return entries of a plotly layout for a vertical line with text at the reference force
    [N]."""
    look = {"color": "#8a6d00", "dash": "dash", "width": 1.6}
    line = {"type": "line", "x0": force, "x1": force, "yref": "paper", "y0": 0, "y1": 1}
    text = {"x": force, "yref": "paper", "y": 1, "text": f"allowed {force:.1f} N"}
    place = {"showarrow": False, "xanchor": "right", "yanchor": "top"}
    return {"shapes": [{**line, "line": look}], "annotations": [text | place]}


def _search_view(
    data: ReportData, groups: Sequence[Numbered], found: Sequence[dict[str, Any]]
) -> Plot:
    """Return the plotly plot of the fronts of a study's first experiment.

    Args:
        data: what the report shows.
        groups: pairs of a group and the numbers of its trajectories on the page.
        found: JSON values of all trajectories of the page, by number.
    """
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
    return front_plot("The paper's search, planned forces", axes, [*traces, *shown], first)
