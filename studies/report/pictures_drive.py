"""Durations against force limits: of paths at every force, and of drivable fronts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_opt.campaign.recommended import StoredRecommendation
from studies.report.page_views import drive_look, limits
from studies.report.pictures_carry import STATIC_COLOUR, styled
from studies.report.records import DrivableReport, ReportData
from studies.report.style import (
    FULL_WIDTH,
    LineStyle,
    new_figure,
    series,
)
from studies.study.drivable import POLISHED
from studies.study.terminal import counted
from symbolic.array import Array


def duration_against_force(data: ReportData) -> Figure:
    """Durations for each limit on the forces: of single paths, and of the drivable fronts
    where there are any: members at their peak forces, and the fastest of a replica's paths at
    every force (median and range of the replicas)."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    axes = figure.subplots()
    looks: Sequence[LineStyle] = [look for _, look in styled(data)]
    curves = []
    for selection, look in zip(data.timings, looks, strict=True):
        known = np.isfinite(selection.curve.duration)
        curves.append(np.stack([selection.curve.force, selection.curve.duration], axis=1)[known])
        axes.plot(
            *curves[-1].T,
            color=look.colour,
            linestyle=look.line,
            marker="" if data.drivable else look.marker,
            markersize=3.5,
            label=_curve_label(data, selection.label),
        )
    if data.drivable is not None:
        curves += _draw_fronts(axes, data.drivable)
        curves += _draw_replicas(axes, data.drivable, data.summary.recommendation)
    chosen = _draw_still(axes, data)
    _look_at(axes, np.concatenate(curves), chosen)
    axes.set_xlabel(f"{data.force_kind.title} [N]")
    axes.set_ylabel("duration [s]")
    axes.legend(loc="upper right")
    return figure


def _curve_label(data: ReportData, label: str) -> str:
    """A curve's label beside fronts: a selected path is that of least force."""
    if data.drivable is None or label == data.initial.label:
        return label
    return f"{label}: least-force path"


def _draw_fronts(axes: Axes, drivable: DrivableReport) -> list[Array]:
    """Members of the drivable fronts, and the carry to run; returns their points."""
    polished = any(entry.front.polished for entry in drivable.fronts)
    found = []
    for entry in drivable.fronts:
        look = series(entry.index)
        opened = polished and not entry.front.polished
        axes.plot(
            entry.force,
            entry.duration,
            look.marker,
            markersize=4.0,
            markerfacecolor="none" if opened else look.colour,
            markeredgecolor=look.colour if opened else "black",
            markeredgewidth=0.6,
            label=entry.front.label,
        )
        found.append(np.stack([entry.force, entry.duration], axis=1))
    return found


def _draw_replicas(
    axes: Axes, drivable: DrivableReport, recommendation: StoredRecommendation | None
) -> list[Array]:
    """Durations of the best fronts' paths at the same forces; returns the points of the medians."""
    if recommendation is None:
        return []
    looks = {entry.front.label: series(entry.index) for entry in drivable.fronts}
    polished = any(entry.front.polished for entry in drivable.fronts)
    table = recommendation.durations
    drawn = []
    for row in table.rows:
        if row.label not in looks or (polished and not row.label.endswith(POLISHED)):
            continue
        look = looks[row.label]
        force = np.array(table.forces)
        median, least, largest = (
            np.array(values, dtype=float) for values in (row.median, row.least, row.largest)
        )
        axes.plot(
            force,
            median,
            color=look.colour,
            linestyle="-",
            linewidth=0.9,
            label=f"{row.label}: {counted(row.replicas, 'replica')}",
        )
        axes.fill_between(force, least, largest, color=look.colour, alpha=0.2, linewidth=0.0)
        drawn.append(np.stack([force, median], axis=1)[np.isfinite(median)])
    return drawn


def _draw_still(axes: Axes, data: ReportData) -> Array:
    """The carry to run, whose point (k, 2) is returned, and the force that holds the payload
    still."""
    choice = data.summary.recommendation
    if choice is not None:
        axes.plot(
            choice.force_limit,
            choice.duration,
            "*",
            color=STATIC_COLOUR,
            markersize=11.0,
            label="recommended",
        )
    axes.axvline(
        data.level_force,
        color=STATIC_COLOUR,
        linewidth=0.8,
        linestyle=(0, (2, 2)),
        label="at rest",
    )
    return np.array([] if choice is None else [choice.force_limit, choice.duration]).reshape(-1, 2)


def _look_at(axes: Axes, points: Array, always: Array) -> None:
    """Limits of the axes around what a reader chooses between, and what is always seen (k, 2)."""
    if len(points) == 0:
        return
    (low, high), (least, most) = limits(drive_look(points, always))
    axes.set_xlim(low, high)
    axes.set_ylim(least, most)
