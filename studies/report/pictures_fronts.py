"""Pictures of fronts: of single runs, over the replicas, before and after the polish, and of time
against force."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hybrid_opt.display.table import counted
from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS
from hybrid_opt.evaluate.objectives import front_of
from hybrid_opt.indicators.metrics import best_so_far
from hybrid_opt.indicators.statistics import attainment_surfaces
from studies.report.data import AlgorithmRuns, ReportData
from studies.report.drawing import (
    MARKED,
    RECOMMENDED_STYLE,
    legend_below,
    limit_line,
    new_figure,
    panel_label,
    series,
    shortened,
)
from studies.report.page_carries import RECOMMENDED_LABEL
from studies.report.page_data import limits
from studies.study.recommendation import StoredRecommendation
from studies.study.tables import constraint_title
from symbolic.array import Array

QUARTILES = (25.0, 75.0)
"""Percentiles of the attainment surfaces that are drawn beside the median [% of the replicas]."""


def fronts(data: ReportData) -> Figure:
    """Draw the feasible and the non-dominated candidates of each algorithm, from its run with the
    largest hypervolume (paper Figure 7). A cross marks the level payload at rest, a star the
    recommended carry with the timing of its job.
    """
    figure = new_figure(0.5)
    panels = figure.subplots(1, 2)
    found = [a.shown.front.objectives for a in data.solved]
    for algorithm, front in zip(data.solved, found, strict=True):
        look, cloud = algorithm.look, algorithm.shown.feasible
        behind = look.marks(2.2) | {"alpha": 0.25, "markeredgewidth": 0, "rasterized": True}
        for axes in panels:
            axes.plot(*cloud[:, :2].T, **behind, label=f"{algorithm.title}: feasible")
            label = f"{algorithm.title}: non-dominated"
            axes.plot(*front[:, :2].T, **look.marks(4.5), label=label)
    union = front_of(np.concatenate(found))[:, :2]
    joined = {"color": "black", "linewidth": 0.9, "zorder": 1.5, "where": "post"}
    for axes in panels:
        axes.step(*union.T, **joined, label="non-dominated of all")
        _objectives(axes, data)
    if not data.alone:
        _recommended(panels[0], data)
    panel_label(panels[0], "a", "all feasible candidates")
    panel_label(panels[1], "b", "the fronts")
    _zoom(panels[1], data, found)
    legend_below(figure, panels[0], 3)
    return figure


def attainment(data: ReportData) -> Figure:
    """Draw empirical attainment surfaces: the objectives that a quarter, half and three quarters of
    the replicas reached or improved on.
    """
    figure = new_figure(0.48)
    groups = {"search": [[run.front.objectives for run in a.runs] for a in data.algorithms]}
    if data.has_hybrid:
        groups["after the polish"] = [
            [run.hybrid.objectives for run in a.runs if run.hybrid is not None]
            for a in data.algorithms
        ]
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, letter, (text, group) in zip(panels, "ab", groups.items(), strict=False):
        for algorithm, found in zip(data.algorithms, group, strict=True):
            look = algorithm.look
            surfaces = attainment_surfaces(found, (*QUARTILES, 50.0)) if found else {}
            for percentile, points in surfaces.items():
                median = percentile not in QUARTILES
                axes.step(
                    *points.T,
                    where="post",
                    color=look.colour,
                    linestyle=look.line if median else (0, (1, 1)),
                    linewidth=1.6 if median else 0.8,
                    label=_attained(algorithm.title, percentile),
                )
        _objectives(axes, data)
        panel_label(axes, letter, f"{text}, {counted(max(len(f) for f in group), 'replica')}")
        _zoom(axes, data, [points for found in group for points in found])
    legend_below(figure, panels[0], 3)
    return figure


def _attained(title: str, percentile: float) -> str:
    """Return the legend entry of an attainment surface. The surfaces of both quartiles share one
    entry; the second one gets '_', which Matplotlib leaves out.

    Args:
        title: name of the algorithm.
        percentile: percentile of the replicas that the surface belongs to.
    """
    if percentile not in QUARTILES:
        return f"{title}: median"
    shares = " and ".join(f"{share:.0f} %" for share in QUARTILES)
    return f"{title}: {shares} of the replicas" if percentile == QUARTILES[0] else "_"


def polish(data: ReportData) -> Figure:
    """Draw fronts before and after the polish, and the hypervolume of every replica."""
    figure = new_figure(0.5)
    left, right = figure.subplots(1, 2)
    drawn = []
    for look, front, opened in data.fronts():
        drawn.append(front.objectives)
        style = look.marks(4.0, opened=opened)
        left.plot(*front.objectives[:, :2].T, **style, label=front.title)
    _objectives(left, data)
    _zoom(left, data, drawn)
    left.legend(loc="upper right")
    panel_label(left, "a", "fronts of the representative runs")
    _paired(right, data.algorithms)
    right.set_ylabel("hypervolume, reference (1.1, 1.1) [-]")
    panel_label(right, "b", "every replica")
    return figure


def _paired(axes: Axes, algorithms: Sequence[AlgorithmRuns]) -> None:
    """Draw into `axes` the hypervolume of every replica of the algorithms before and after the
    polish."""
    names = []
    for k, algorithm in enumerate(algorithms):
        look = algorithm.look
        style: dict[str, Any] = {
            "marker": look.marker,
            "color": look.colour,
            "linewidth": 0.7,
            "markersize": 3.5,
        }
        for run in algorithm.runs:
            if run.figures.polished is not None:
                values = [run.figures.hypervolume, run.figures.polished.hypervolume]
                axes.plot([3 * k, 3 * k + 1], values, "-", **style)
        names += [f"{algorithm.title}\nsearch", f"{algorithm.title}\npolished"]
    axes.set_xticks([3 * (k // 2) + k % 2 for k in range(len(names))], names)
    axes.margins(x=0.12)


def _objectives(axes: Axes, data: ReportData) -> None:
    """Prepare axes for the first two objectives, with marks for two carries.

    A cross marks the level payload at rest, a star the recommended carry.
    """
    if data.at_rest is not None:
        look: dict[str, Any] = {
            "color": "black",
            "markersize": 7,
            "markeredgewidth": 1.6,
            "zorder": 5,
        }
        axes.plot(*data.at_rest, "+", **look, label="level payload at rest")
    if data.alone:
        _recommended(axes, data)
    axes.set_xlabel(f"{data.objective_titles[0]} [-]")
    axes.set_ylabel(f"{data.objective_titles[1]} [-]")
    # Fronts span little, so that labels are long; steps of 2.5 would make them longer.
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))


def _recommended(axes: Axes, data: ReportData) -> None:
    """Draw the star of the recommended carry, if the axes show its two objectives."""
    if (at := data.recommended_objectives) is not None:
        axes.plot(*at, **RECOMMENDED_STYLE.marks(9.0, MARKED), label="recommended, driven")


def _zoom(axes: Axes, data: ReportData, sets: Sequence[Array]) -> None:
    """Set the limits of axes such that fronts and marked carries are visible.

    Args:
        axes: axes of the first two objectives.
        data: what the report shows, with the level payload at rest and the recommended carry.
        sets: objectives (k, n_obj) of each front.
    """
    points = [np.atleast_2d(points)[:, :2] for points in sets if len(points)]
    if data.at_rest is not None:
        points.append(data.at_rest[None])
    if data.alone and (at := data.recommended_objectives) is not None:
        points.append(at[None])
    x_limits, y_limits = limits(np.concatenate(points), 0.07)
    axes.set_xlim(*x_limits)
    axes.set_ylim(*y_limits)


def duration_against_force(data: ReportData, choice: StoredRecommendation) -> Figure:
    """Draw the shortest duration of a drivable carry against its largest commanded force, which
    holds the box in every case of the uncertainty: one curve for each single path, and one for all
    paths from which the recommended carry was chosen. Only the star is within limits on jerk.
    """
    figure = new_figure(0.5)
    axes = figure.subplots()
    force, looks = np.array(choice.durations.forces), {RECOMMENDED_LABEL: RECOMMENDED_STYLE}
    looks |= {data.initial.label: data.initial.look}
    for k, row in enumerate(choice.durations.rows):
        look = looks.get(row.label, series(k))
        axes.plot(force, row.durations, **look.drawn, marker=look.marker, label=row.label)
    star = RECOMMENDED_STYLE.marks(11.0, MARKED)
    axes.plot(choice.force, choice.duration, **star, label="recommended, within limits on jerk")
    if choice.allowed is not None:
        limit_line(axes, float(choice.allowed.min()), "reference force", across=False)
    axes.set_xlabel("largest commanded force [N]")
    axes.set_ylabel("duration [s]")
    legend_below(figure, axes, 3)
    return figure


LATE = 0.5
"""The inset of the histories starts at this share of the evaluations."""


def histories(data: ReportData) -> Figure:
    """Draw how the search improves the objectives (paper Figure 8).

    The curves show the best feasible value so far of the first two objectives over the number of
    evaluated candidates, for the representative replica of each algorithm. An inset enlarges the
    second half.
    """
    figure = new_figure(0.5)
    axes = figure.subplots()
    inset = axes.inset_axes((0.42, 0.47, 0.56, 0.46))
    lines = []
    for k, algorithm in enumerate(data.solved):
        look, found = algorithm.look, algorithm.shown.front.evaluations
        history = best_so_far(found.objectives, found.feasible)
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
                    label=f"{algorithm.title}: {title.split(' / ')[0]}",
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
    legend_below(figure, axes, 2)
    return figure


def infeasibility(data: ReportData) -> Figure:
    """Draw what made candidates infeasible: the constraint violated first, over all replicas, and
    where on the path."""
    figure = new_figure(0.46)
    left, right = figure.subplots(1, 2)
    pooled = []
    for algorithm in data.algorithms:
        every = [run.front.evaluations for run in algorithm.runs]
        pooled.append(
            [np.concatenate([getattr(e, n) for e in every]) for n in ("reason", "position")]
        )
    present = [k for k in range(len(REASONS)) if any((reason == k).any() for reason, _ in pooled)]
    height = 0.8 / max(len(pooled), 1)
    for n, (algorithm, (reason, position)) in enumerate(zip(data.algorithms, pooled, strict=True)):
        look = algorithm.look
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
    robots = data.summary.robots
    names = ["feasible", *(shortened(constraint_title(REASONS[k], robots)) for k in present)]
    left.set_yticks(np.arange(len(names)), names)
    left.invert_yaxis()
    left.grid(visible=False, axis="y")
    left.set_xlabel("share of evaluated candidates [%]")
    panel_label(left, "a", "first violated constraint")
    right.set_xlabel("path parameter of the first violation [-]")
    right.set_ylabel("share of evaluated candidates [%]")
    right.set_xlim(0.0, 1.0)
    panel_label(right, "b", "where on the path")
    legend_below(figure, left)
    return figure


def indicators(data: ReportData) -> Figure:
    """Draw indicators of every replica, with medians and quartiles."""
    figure = new_figure(0.36)
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
            look = algorithm.look
            values = np.array([getattr(run.figures, name) for run in algorithm.runs], dtype=float)
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
