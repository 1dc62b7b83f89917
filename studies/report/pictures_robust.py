"""The price of robustness: forces against the size of the set of cases that they hold."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from hybrid_opt.campaign.recommended import StoredPrice
from studies.report.records import ReportData
from studies.report.style import FULL_WIDTH, new_figure, series, shortened


def robust_price(data: ReportData, price: StoredPrice) -> Figure:
    """Peak normal forces of the recommended carry against the factor of the set."""
    figure = new_figure(0.62 * FULL_WIDTH, 0.42 * FULL_WIDTH)
    axes = figure.subplots()
    factors, peaks = np.array(price.factors), np.array(price.peak)
    for i, robot in enumerate(data.workcell.robots):
        look = series(i)
        axes.plot(
            factors,
            peaks[:, i],
            color=look.colour,
            linestyle=look.line,
            marker=look.marker,
            label=shortened(robot.name),
        )
    axes.axvline(1.0, color="black", linewidth=0.8, linestyle=(0, (2, 2)), label="the set")
    reached = float(price.limit.min()) <= 1.25 * float(peaks.max())
    if reached:
        axes.axhline(
            float(price.limit.min()),
            color="black",
            linestyle="--",
            linewidth=0.9,
            label="reference force",
        )
    if reached and 0.0 < price.largest_factor < np.inf:
        axes.axvline(
            price.largest_factor,
            color="#b00020",
            linewidth=0.8,
            label=f"largest set: {price.largest_factor:.2f}",
        )
    axes.set_xlabel("multiple of the set [-]")
    axes.set_ylabel("peak normal force [N]")
    axes.legend(loc="upper left")
    return figure
