"""Small plots as inline SVG: lines and points, for objects in a notebook."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from symbolic.array import Array

SIZE = (5.4, 3.4)
"""Of a plot [inch]."""

ROOM = 0.06
"""Share of the data's range left free around it."""

ARMS = ("#3b6ea8", "#a8733b")
"""Colours of the two robots, as in the report."""

FRONT, CLOUD, REST = "#b00020", "#9aa3ab", "#1f2933"
"""Colours of a front, of the candidates behind it, and of the payload at rest."""

MARKS = {"line": "-", "dots": "o", "cross": "+"}


@dataclass(frozen=True)
class Series:
    """A drawn series: points (n, 2) as a line or as marks.

    Attributes:
        label: in the legend, '' for none.
        points: (n, 2).
        colour: CSS colour.
        kind: 'line', 'dots' or 'cross'.
        size: width of the line or radius of the marks [pt].
    """

    label: str
    points: Array
    colour: str
    kind: str = "line"
    size: float = 1.6


def plot(series: list[Series], x_title: str, y_title: str, focus: Array) -> str:
    """An SVG picture of the series; those outside of the axes are clipped.

    Args:
        focus: (n, 2) points that the axes have to hold.
    """
    low, high = focus.min(axis=0), focus.max(axis=0)
    room = np.maximum(ROOM * (high - low), 1e-4 * np.maximum(1.0, np.abs(high)))
    look: dict[Any, Any] = {"font.size": 8.0, "text.parse_math": False, "svg.fonttype": "none"}
    with mpl.rc_context(look):
        figure = Figure(figsize=SIZE, layout="constrained")
        axes = figure.subplots()
        for one in series:
            width = {"linewidth": one.size} if one.kind == "line" else {"markersize": 2 * one.size}
            style: dict[str, Any] = {"color": one.colour, "label": one.label or None, **width}
            axes.plot(*one.points.T, MARKS[one.kind], **style)
        axes.set_xlim(low[0] - room[0], high[0] + room[0])
        axes.set_ylim(low[1] - room[1], high[1] + room[1])
        axes.set_xlabel(x_title)
        axes.set_ylabel(y_title)
        figure.legend(loc="outside upper center", ncols=len(series), frameon=False)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    return text[text.index("<svg") :]
