"""Pictures of fronts: of single runs, over the replicas, before and after the polish."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hybrid_opt.indicators.metrics import front_of
from hybrid_opt.indicators.statistics import attainment_surfaces
from studies.report.records import AlgorithmRuns, ReportData
from studies.report.style import FULL_WIDTH, new_figure, panel_label, series
from studies.study.terminal import counted
from symbolic.array import Array

QUARTILES = (25.0, 75.0)
"""Attainment surfaces beside the median, in percent of the replicas."""


def fronts(data: ReportData) -> Figure:
    """Feasible points and fronts of each algorithm's representative run (paper Figure 7)."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    panels = figure.subplots(1, 2)
    for algorithm in data.solved:
        look, run = series(algorithm.index), algorithm.shown
        cloud = run.evaluations.objectives[run.evaluations.feasible]
        front = run.front.objectives
        for axes in panels:
            axes.plot(
                cloud[:, 0],
                cloud[:, 1],
                look.marker,
                color=look.colour,
                alpha=0.25,
                markersize=2.2,
                markeredgewidth=0,
                rasterized=True,
                label=f"{algorithm.title}: feasible",
            )
            axes.plot(
                front[:, 0],
                front[:, 1],
                look.marker,
                color=look.colour,
                markersize=4.5,
                markeredgecolor="black",
                markeredgewidth=0.5,
                label=f"{algorithm.title}: non-dominated",
            )
    union = front_of(np.concatenate([a.shown.front.objectives for a in data.solved]))
    for axes in panels:
        axes.step(
            union[:, 0],
            union[:, 1],
            where="post",
            color="black",
            linewidth=0.9,
            label="non-dominated of all",
            zorder=1.5,
        )
        _static_point(axes, data)
        _label_objectives(axes, data)
    panel_label(panels[0], "a", "all feasible candidates")
    panel_label(panels[1], "b", "the fronts")
    _zoom(panels[1], [a.shown.front.objectives for a in data.solved], data.static)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def attainment(data: ReportData) -> Figure:
    """Median and quartile attainment surfaces over the replicas."""
    figure = new_figure(FULL_WIDTH, 0.48 * FULL_WIDTH)
    sets = [[run.front.objectives for run in a.runs] for a in data.algorithms]
    hybrid = [
        [run.hybrid.objectives for run in a.runs if run.hybrid is not None] for a in data.algorithms
    ]
    has_hybrid = any(hybrid)
    panels = figure.subplots(1, 2 if has_hybrid else 1, squeeze=False)[0]
    groups = [("search", sets)] + ([("after the polish", hybrid)] if has_hybrid else [])
    for axes, letter, (text, group) in zip(panels, "ab", groups, strict=False):
        for k, (algorithm, found) in enumerate(zip(data.algorithms, group, strict=True)):
            look = series(k)
            if not found:
                continue
            for surface in attainment_surfaces(found, (*QUARTILES, 50.0)):
                median = surface.percentile not in QUARTILES
                axes.step(
                    surface.points[:, 0],
                    surface.points[:, 1],
                    where="post",
                    color=look.colour,
                    linestyle=look.line if median else (0, (1, 1)),
                    linewidth=1.6 if median else 0.8,
                    label=_attained(algorithm.title, surface.percentile),
                )
        _static_point(axes, data)
        _label_objectives(axes, data)
        panel_label(axes, letter, f"{text}, {counted(max(len(f) for f in group), 'replica')}")
        _zoom(axes, [points for found in group for points in found], data.static)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _attained(title: str, percentile: float) -> str:
    """Legend of a surface; both quartiles look alike and share one entry."""
    if percentile not in QUARTILES:
        return f"{title}: median"
    shares = " and ".join(f"{share:.0f} %" for share in QUARTILES)
    return f"{title}: {shares} of the replicas" if percentile == QUARTILES[0] else "_"


def polish(data: ReportData) -> Figure:
    """Fronts of the representative runs before and after the polish, and the hypervolumes."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    left, right = figure.subplots(1, 2)
    drawn = []
    for algorithm in data.solved:
        look, run = series(algorithm.index), algorithm.shown
        assert run.hybrid is not None
        for points, fill, text in (
            (run.front.objectives, "white", "search"),
            (run.hybrid.objectives, look.colour, "polished"),
        ):
            left.plot(
                points[:, 0],
                points[:, 1],
                look.marker,
                color=look.colour,
                markerfacecolor=fill,
                markersize=4,
                label=f"{algorithm.title}: {text}",
            )
            drawn.append(points)
    _static_point(left, data)
    _label_objectives(left, data)
    _zoom(left, drawn, data.static)
    left.legend(loc="upper right")
    panel_label(left, "a", "fronts of the representative runs")
    _paired(right, data.algorithms, "hypervolume")
    right.set_ylabel("hypervolume, reference (1.1, 1.1) [-]")
    panel_label(right, "b", "every replica")
    return figure


def _paired(axes: Axes, algorithms: Sequence[AlgorithmRuns], figure: str) -> None:
    ticks, names = [], []
    for k, algorithm in enumerate(algorithms):
        look = series(k)
        for run in algorithm.runs:
            if run.hybrid_figures is not None:
                values = [getattr(run.figures, figure), getattr(run.hybrid_figures, figure)]
                axes.plot(
                    [3 * k, 3 * k + 1],
                    values,
                    "-",
                    marker=look.marker,
                    color=look.colour,
                    linewidth=0.7,
                    markersize=3.5,
                )
        ticks += [3 * k, 3 * k + 1]
        names += [f"{algorithm.title}\nsearch", f"{algorithm.title}\npolished"]
    axes.set_xticks(ticks, names)
    axes.margins(x=0.12)


def _label_objectives(axes: Axes, data: ReportData) -> None:
    axes.set_xlabel(f"{data.objective_titles[0]} [-]")
    axes.set_ylabel(f"{data.objective_titles[1]} [-]")
    # Fronts span little, so that labels are long; steps of 2.5 would make them longer.
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))


def _static_point(axes: Axes, data: ReportData) -> None:
    if np.isfinite(data.static[:2]).all():
        axes.plot(
            *data.static[:2],
            "*",
            color="#b00020",
            markersize=8,
            zorder=5,
            label="level payload at rest",
        )


def _zoom(axes: Axes, sets: Sequence[Array], static: Array) -> None:
    """Limits around fronts, their corner at rest included."""
    points = [np.atleast_2d(points)[:, :2] for points in sets if len(points)]
    if np.isfinite(static[:2]).all():
        points.append(static[None, :2])
    every = np.concatenate(points)
    low, high = every.min(axis=0), every.max(axis=0)
    room = np.maximum(0.07 * (high - low), 1e-4)
    axes.set_xlim(low[0] - room[0], high[0] + room[0])
    axes.set_ylim(low[1] - room[1], high[1] + room[1])
