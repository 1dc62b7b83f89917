"""Small plots as inline SVG: axes, lines and points, for objects in a notebook."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass

import numpy as np

from symbolic.array import Array

WIDTH, HEIGHT = 520, 320
"""Size of a plot [px]."""

LEFT, RIGHT, TOP, BOTTOM = 70, 14, 30, 46
"""Margins around the axes [px]."""

TICKS = 5
"""About as many ticks as this per axis."""

ROOM = 0.06
"""Share of the data's range left free around it."""

ARMS = ("#3b6ea8", "#a8733b")
"""Colours of the two robots, as in the report."""

FRONT, CLOUD, REST = "#b00020", "#9aa3ab", "#1f2933"
"""Colours of a front, of the candidates behind it, and of the payload at rest."""


@dataclass(frozen=True)
class Series:
    """A drawn series: points (n, 2) as a line or as marks.

    Attributes:
        label: in the legend, '' for none.
        points: (n, 2).
        colour: CSS colour.
        kind: 'line', 'dots' or 'cross'.
        size: width of the line or radius of the marks [px].
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
    axes = _Axes(low - room, high + room)
    inside = f'x="{LEFT}" y="{TOP}" width="{axes.width}" height="{axes.height}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" '
        f'viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="11" '
        'style="background:#fff;color:#1f2933">',
        f'<defs><clipPath id="axes"><rect {inside}/></clipPath></defs>',
        f'<rect {inside} fill="none" stroke="#9aa3ab"/>',
        *axes.ticks(),
        f'<text x="{LEFT + axes.width / 2:.0f}" y="{HEIGHT - 10}" text-anchor="middle">'
        f"{html.escape(x_title)}</text>",
        f'<text transform="translate(14 {TOP + axes.height / 2:.0f}) rotate(-90)" '
        f'text-anchor="middle">{html.escape(y_title)}</text>',
        '<g clip-path="url(#axes)">',
        *(axes.draw(one) for one in series),
        "</g>",
        *_legend([one for one in series if one.label]),
        "</svg>",
    ]
    return "".join(parts)


class _Axes:
    def __init__(self, low: Array, high: Array) -> None:
        self.low, self.high = low, high
        self.width, self.height = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def place(self, points: Array) -> Array:
        """(n, 2) pixels of points (n, 2)."""
        share = (np.asarray(points, dtype=float) - self.low) / (self.high - self.low)
        return np.column_stack(
            [LEFT + share[:, 0] * self.width, TOP + (1.0 - share[:, 1]) * self.height]
        )

    def draw(self, series: Series) -> str:
        pixels = self.place(series.points)
        if series.kind == "line":
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
            return (
                f'<polyline points="{path}" fill="none" stroke="{series.colour}" '
                f'stroke-width="{series.size}"/>'
            )
        return "".join(_mark(series, x, y) for x, y in pixels)

    def ticks(self) -> list[str]:
        parts = []
        for value in _round_values(float(self.low[0]), float(self.high[0])):
            x = self.place(np.array([[value, self.low[1]]]))[0, 0]
            y = TOP + self.height
            parts.append(
                f'<path d="M{x:.1f} {y}v4" stroke="#9aa3ab"/><text x="{x:.1f}" y="{y + 16}" '
                f'text-anchor="middle">{_number(value)}</text>'
            )
        for value in _round_values(float(self.low[1]), float(self.high[1])):
            y = self.place(np.array([[self.low[0], value]]))[0, 1]
            parts.append(
                f'<path d="M{LEFT} {y:.1f}h-4" stroke="#9aa3ab"/><text x="{LEFT - 7}" '
                f'y="{y + 4:.1f}" text-anchor="end">{_number(value)}</text>'
            )
        return parts


def _mark(series: Series, x: float, y: float) -> str:
    r = series.size
    if series.kind == "dots":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r}" fill="{series.colour}"/>'
    return (
        f'<path d="M{x - r:.1f} {y:.1f}h{2 * r}M{x:.1f} {y - r:.1f}v{2 * r}" '
        f'stroke="{series.colour}" stroke-width="2"/>'
    )


def _legend(series: list[Series]) -> list[str]:
    parts, x = [], float(LEFT)
    for one in series:
        parts.append(
            f'<circle cx="{x + 5:.0f}" cy="16" r="4" fill="{one.colour}"/>'
            f'<text x="{x + 13:.0f}" y="20">{html.escape(one.label)}</text>'
        )
        x += 30.0 + 6.2 * len(one.label)
    return parts


def _round_values(low: float, high: float) -> list[float]:
    """Round values within a range, about `TICKS` of them."""
    raw = (high - low) / TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw)
    first = math.ceil(low / step)
    return [k * step for k in range(first, math.floor(high / step) + 1)]


def _number(value: float) -> str:
    return f"{value:.6g}"
