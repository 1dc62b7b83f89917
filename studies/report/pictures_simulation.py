"""Predicted beside simulated normal forces of carries in the simulated cell."""

from __future__ import annotations

from matplotlib.figure import Figure

from studies.report.records import ReportData
from studies.report.style import (
    FULL_WIDTH,
    HAND_MADE,
    LineStyle,
    new_figure,
    panel_label,
    series,
    shortened,
)

PREDICTED = (0, (2, 1.5))
"""Dashes of what was predicted."""


def simulated_forces(data: ReportData) -> Figure:
    """Normal force of each robot: reference dashed, measured in the simulated cell solid."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    panels = figure.subplots(1, 2, sharey=True)
    drawn = [
        (found, look)
        for found, look in zip(data.simulations, _looks(data), strict=True)
        if len(found.time)
    ]
    for i, (axes, robot) in enumerate(zip(panels, data.workcell.robots, strict=True)):
        for found, look in drawn:
            axes.plot(
                found.time,
                found.simulated[:, i],
                color=look.colour,
                linewidth=0.9,
                label=f"{found.label}, simulated",
            )
            axes.plot(
                found.time,
                found.predicted[:, i],
                color="black",
                linestyle=PREDICTED,
                linewidth=0.8,
                label="predicted" if found is drawn[-1][0] else None,
            )
        axes.set_xlabel("time [s]")
        panel_label(axes, "ab"[i], f"robot {shortened(robot.name)!r}")
    panels[0].set_ylabel("normal contact force [N]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _looks(data: ReportData) -> list[LineStyle]:
    """The hand-made trajectory looks as everywhere, the others by their order."""
    looks, number = [], 0
    for found in data.simulations:
        if found.label == data.initial.label:
            looks.append(HAND_MADE)
        else:
            looks.append(series(number))
            number += 1
    return looks
