"""Figures of the search: fronts, histories, attainment, polish, what killed candidates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_opt.attainment import attainment_surfaces
from hybrid_opt.evaluation import FEASIBLE, REASONS
from hybrid_opt.metrics import best_so_far, front_of
from studies.report.records import AlgorithmRuns, ReportData
from studies.report.style import (
    FULL_WIDTH,
    new_figure,
    panel_label,
    series,
)
from symbolic.workcell import Array

LATE = 0.5
"""The inset of the histories shows evaluations from this share of the budget on."""


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


def histories(data: ReportData) -> Figure:
    """Best-so-far objectives of the representative runs, late part enlarged (paper Figure 8)."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    axes = figure.subplots()
    inset = axes.inset_axes((0.42, 0.47, 0.56, 0.46))
    lines = []
    for algorithm in data.solved:
        k, look, run = algorithm.index, series(algorithm.index), algorithm.shown
        history = best_so_far(run.evaluations.objectives, run.evaluations.feasible)
        number = np.arange(1, len(history) + 1)
        for m, title in enumerate(data.objective_titles[:2]):
            dashes = "-" if m == 0 else (0, (4, 1.5))
            for target in (axes, inset):
                target.plot(
                    number,
                    history[:, m],
                    color=look.colour,
                    linestyle=dashes,
                    linewidth=1.3 if m == 0 else 1.0,
                    marker=look.marker,
                    markevery=(k * 17 + m * 41, max(1, len(number) // 12)),
                    markersize=3,
                    label=f"{algorithm.title}: {_short(title)}",
                )
        lines.append(history)
    count = max(len(history) for history in lines)
    start = int(LATE * count)
    late = np.concatenate([history[start:, :2] for history in lines])
    low, high = np.nanmin(late), np.nanmax(late)
    room = max(0.08 * (high - low), 1e-4)
    inset.set_xlim(start, count)
    inset.set_ylim(low - room, high + room)
    inset.tick_params(labelsize=6)
    inset.set_title(f"evaluations {start} to {count}", fontsize=7)
    # The curves stay below the inset.
    bottom = float(np.nanmin(np.concatenate(lines)[:, :2]))
    top = max(float(np.nanmax(np.concatenate(lines)[:, :2])), bottom + (high - bottom) / 0.36)
    axes.set_ylim(bottom - 0.03 * (top - bottom), top + 0.03 * (top - bottom))
    axes.indicate_inset_zoom(inset, edgecolor="black", alpha=0.4)
    axes.set_xlabel("evaluated candidates [-]")
    axes.set_ylabel("best feasible objective so far [-]")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
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
            for surface in attainment_surfaces(found, (25.0, 50.0, 75.0)):
                median = surface.percentile == 50.0
                axes.step(
                    surface.points[:, 0],
                    surface.points[:, 1],
                    where="post",
                    color=look.colour,
                    linestyle=look.line if median else (0, (1, 1)),
                    linewidth=1.6 if median else 0.8,
                    label=f"{algorithm.title}: "
                    + ("median" if median else f"{surface.percentile:.0f} % of replicas"),
                )
        _static_point(axes, data)
        _label_objectives(axes, data)
        panel_label(axes, letter, f"{text}, {max(len(f) for f in group)} replicas")
        _zoom(axes, [points for found in group for points in found], data.static)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


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
            if figure in run.hybrid_figures:
                values = [run.figures[figure], run.hybrid_figures[figure]]
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


def infeasibility(data: ReportData) -> Figure:
    """What made candidates infeasible: the share of every constraint, and where on the path."""
    figure = new_figure(FULL_WIDTH, 0.46 * FULL_WIDTH)
    left, right = figure.subplots(1, 2)
    pooled = []
    for algorithm in data.algorithms:
        reason = np.concatenate([run.evaluations.reason for run in algorithm.runs])
        position = np.concatenate([run.evaluations.position for run in algorithm.runs])
        pooled.append((reason, position))
    present = [k for k in range(len(REASONS)) if any((reason == k).any() for reason, _ in pooled)]
    height = 0.8 / max(len(pooled), 1)
    for n, (algorithm, (reason, position)) in enumerate(zip(data.algorithms, pooled, strict=True)):
        look = series(n)
        shares = [100.0 * float((reason == k).mean()) for k in (FEASIBLE, *present)]
        offsets = np.arange(len(shares)) + (n - (len(pooled) - 1) / 2.0) * height
        left.barh(
            offsets,
            shares,
            height,
            color=look.colour,
            hatch=look.hatch,
            edgecolor="white",
            label=algorithm.title,
        )
        right.hist(
            position[reason != FEASIBLE],
            bins=25,
            range=(0.0, 1.0),
            histtype="step",
            color=look.colour,
            linestyle=look.line,
            linewidth=1.4,
            label=algorithm.title,
            weights=np.full((reason != FEASIBLE).sum(), 100.0 / len(reason)),
        )
    names = ["feasible", *(REASONS[k].replace("_", " ") for k in present)]
    left.set_yticks(np.arange(len(names)), names)
    left.invert_yaxis()
    left.grid(visible=False, axis="y")
    left.set_xlabel("share of evaluated candidates [%]")
    panel_label(left, "a", "first violated constraint")
    right.set_xlabel("path parameter of the first violation [-]")
    right.set_ylabel("share of evaluated candidates [%]")
    right.set_xlim(0.0, 1.0)
    panel_label(right, "b", "where on the path")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def indicators(data: ReportData) -> Figure:
    """Hypervolume, IGD, spacing and feasible share of every replica."""
    figure = new_figure(FULL_WIDTH, 0.36 * FULL_WIDTH)
    shown = (
        ("hypervolume", "hypervolume [-]"),
        ("igd", "IGD [-]"),
        ("spacing", "spacing [-]"),
        ("feasible_share", "feasible share [-]"),
    )
    for axes, letter, (name, label) in zip(
        figure.subplots(1, len(shown)), "abcd", shown, strict=True
    ):
        for k, algorithm in enumerate(data.algorithms):
            look = series(k)
            values = np.array([run.figures[name] for run in algorithm.runs], dtype=float)
            values = values[np.isfinite(values)]
            if len(values):
                axes.boxplot(
                    values,
                    positions=[k],
                    widths=0.55,
                    showfliers=False,
                    medianprops={"color": "black"},
                )
            axes.plot(
                k + np.linspace(-0.15, 0.15, len(values)),
                values,
                look.marker,
                color=look.colour,
                markersize=3,
                alpha=0.8,
            )
        axes.set_xticks(
            range(len(data.algorithms)), [a.title for a in data.algorithms], rotation=25
        )
        axes.set_xlim(-0.6, len(data.algorithms) - 0.4)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(label)
        panel_label(axes, letter, "")
    return figure


def _short(title: str) -> str:
    return title.split(" / ")[0]


def _label_objectives(axes: Axes, data: ReportData) -> None:
    axes.set_xlabel(f"{data.objective_titles[0]} [-]")
    axes.set_ylabel(f"{data.objective_titles[1]} [-]")


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
