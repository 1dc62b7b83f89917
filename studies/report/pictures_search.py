"""Pictures of the search: histories, what made candidates infeasible, indicators."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from hybrid_opt.evaluate.evaluations import FEASIBLE, REASONS
from hybrid_opt.indicators.metrics import best_so_far
from studies.report.records import ReportData
from studies.report.style import FULL_WIDTH, new_figure, panel_label, series

LATE = 0.5
"""The inset of the histories shows evaluations from this share of the budget on."""


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


def infeasibility(data: ReportData) -> Figure:
    """Reasons of infeasible candidates: the share of every constraint, and where on the path."""
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


def _short(title: str) -> str:
    return title.split(" / ")[0]
