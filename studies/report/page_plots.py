"""The page's interactive plots as plotly's JSON values: the page's script fills in what depends on
the chosen trajectory, and draws them."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from hybrid_opt.display.scene import packed
from studies.report.style import ARMS, MARKED, LineStyle, spread
from symbolic.array import Array
from symbolic.records import Workcell

Plot = dict[str, Any]

MAX_CLOUD = 1500
"""Feasible candidates per algorithm in the background of the fronts."""

ROOM = 0.06
"""Beside the points that a look shows, as a share of their range."""

LONGEST = 2.2
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
"""Of the two robots' lines."""


def plain(text: str) -> str:
    """A text in which plotly finds no markup."""
    return html.escape(text, quote=False)


def marker(look: LineStyle, opened: bool = False, size: float = 9) -> Plot:
    """The marker of a series, open where a polished front stands beside a searched one."""
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
        marker={**look, "line": {"color": "#000", "width": 0.7}},
    )


def cloud(label: str, at: Array, look: LineStyle) -> Plot:
    """Feasible candidates (n, 2) in the background, thinned out."""
    at = at[spread(len(at), MAX_CLOUD)]
    flat = [{"dtype": "f4", "bdata": packed(column, np.float32)} for column in at.T]
    style = {"color": look.colour, "symbol": SYMBOLS[look.marker], "size": 3, "opacity": 0.25}
    made = _scatter(f"{label}: feasible", at, mode="markers", hoverinfo="skip", marker=style)
    return made | {"x": flat[0], "y": flat[1]}


def line(label: str, at: Array, colour: str, dash: str) -> Plot:
    """A curve through points (k, 2)."""
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
    """A picture of fronts.

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
            "legend": _legend("bottom", 0.01, 11),
        },
        "first": limits(first),
        "whole": limits(np.concatenate([*whole, np.zeros((0, 2))])),
    }


def _legend(edge: str, place: float, size: int) -> Plot:
    """A legend in a row along an edge of the plot's element."""
    row = {"orientation": "h", "yref": "container", "y": place, "yanchor": edge}
    return {**row, "font": {"size": size}}


def limits(points: Array) -> list[list[float]]:
    """Limits of both axes around points (k, 2)."""
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return [[0.0, 1.0], [0.0, 1.0]]
    low, high = points.min(axis=0), points.max(axis=0)
    room = np.maximum(ROOM * (high - low), 1e-4)
    found: list[list[float]] = np.stack([low - room, high + room], axis=1).tolist()
    return found


def drive_look(points: Array, always: Array) -> Array:
    """Points (k, 2) of force and duration that the first look shows.

    Both ends of a drivable front are long and flat: forces next to that of holding still, and
    durations next to the shortest. Neither is to squash what lies between.

    Args:
        points: of the fronts and curves.
        always: (n, 2) what the look has to show besides.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return always
    force, duration = points.min(axis=0)
    near = (points[:, 0] <= HIGHEST * force) & (points[:, 1] <= LONGEST * duration)
    return np.concatenate([points[near], always])


def carry_plots(workcell: Workcell, rest: float | None) -> dict[str, Plot]:
    """The plots of one trajectory by the ids of their elements. `meta` says what fills a trace:
    a column of its samples and a factor, a level, or one arm's share of a list of all joints.

    Args:
        rest: largest normal force of the level payload at rest [N], None where it is not known.
    """
    first = 7 + sum(len(robot.torque_max) for robot in workcell.robots)
    radius = 1e3 * min(contact.patch_radius for contact in workcell.contacts)
    levels = [] if rest is None else [("level payload at rest", rest, MARKED)]
    return {
        "force-plot": _over_time(workcell, "normal force [N]", first, 1.0, levels),
        "pressure-plot": _over_time(
            workcell, "pressure shift [mm]", first + 2, 1e3, [("patch radius", radius, "#000")]
        ),
        "torque-plot": _torque(workcell),
    }


def _over_time(
    workcell: Workcell,
    title: str,
    column: int,
    scale: float,
    levels: list[tuple[str, float, str]],
) -> Plot:
    traces = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": plain(robot.name),
            "line": {"color": ARMS[i], "dash": DASHES[i], "width": 2},
            "meta": {"column": column + i, "scale": scale},
        }
        for i, robot in enumerate(workcell.robots)
    ]
    traces += [
        {
            "type": "scatter",
            "mode": "lines",
            "name": label,
            "hoverinfo": "name",
            "line": {"color": colour, "dash": "dot", "width": 1.5},
            "meta": {"level": level},
        }
        for label, level, colour in levels
    ]
    layout = {
        "margin": {"l": 60, "r": 15, "t": 40, "b": 55},
        "showlegend": True,
        "xaxis": {"title": {"text": "time [s]", "standoff": 6}},
        "yaxis": {"title": {"text": title}, "rangemode": "normal"},
        "legend": _legend("top", 0.99, 10),
    }
    return {"data": traces, "layout": layout}


def _torque(workcell: Workcell) -> Plot:
    traces = []
    for i, robot in enumerate(workcell.robots):
        count = len(robot.torque_max)
        for use, label, style in (
            ("torqueUse", robot.name, {"dash": DASHES[i]}),
            ("contactTorqueUse", f"{robot.name}, load alone", {"dash": "dot", "width": 1}),
        ):
            traces.append(
                {
                    "type": "scatterpolar",
                    "mode": "lines+markers" if use == "torqueUse" else "lines",
                    "name": plain(label),
                    "theta": [f"joint {j + 1}" for j in (*range(count), 0)],
                    "line": {"color": ARMS[i], **style},
                    "meta": {"use": use, "arm": i},
                }
            )
    radial = {"rangemode": "tozero", "ticksuffix": " %", "nticks": 5, "tickfont": {"size": 10}}
    layout = {
        "margin": {"l": 50, "r": 50, "t": 40, "b": 30},
        "title": {"text": "largest joint torque [% of maximum]", "font": {"size": 12}},
        "polar": {"radialaxis": radial},
        "legend": {"orientation": "h", "y": -0.08, "font": {"size": 10}},
    }
    return {"data": traces, "layout": layout}
