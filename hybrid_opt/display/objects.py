"""Display of this library's objects: text for print, and figures with a picture for a notebook.

The picture of a carry or a timing shows the normal forces along it, that of a job the commanded
normal forces, that of a front its points and the search's candidates.
"""

from __future__ import annotations

import html
import io
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from hybrid_opt.carry import Carry
from hybrid_opt.display.table import figures_html, lines, torque_use
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.front import Front
from hybrid_opt.indicators.metrics import excess_above_static
from hybrid_opt.job.records import Job
from hybrid_opt.recommending.recommendation import Recommendation
from hybrid_opt.sensitivity import Sensitivities, Sensitivity
from hybrid_opt.static_hold import static_hold
from hybrid_opt.timing.records import Timing
from symbolic.array import Array
from symbolic.records import Workcell

MAX_CLOUD = 1500
"""Largest number of feasible candidates that are drawn behind a front."""

ONE_WAY = 1e-6
"""The effects of raising and of lowering a number count as one slope if they differ by at most this
share."""


def text_of(shown: object) -> str:
    """Format a result object (a carry, a timing, a front, ...) as text: a heading, then one line
    per number that describes it."""
    return "\n".join([heading_of(shown), *lines(figures_of(shown))])


def html_of(shown: object) -> str:
    """Format an object of this library as HTML for a notebook: a heading, its numbers, and its
    picture. A job or a recommendation is shown as its text and its picture.
    """
    if isinstance(shown, Job | Recommendation):
        return f"<div><pre>{html.escape(repr(shown))}</pre>{picture_of(shown)}</div>"
    heading = html.escape(heading_of(shown))
    return f"<div><p>{heading}</p>{figures_html(figures_of(shown))}{picture_of(shown)}</div>"


@singledispatch
def heading_of(shown: object) -> str:
    """Describe an object of this library in one line."""
    raise NotImplementedError(f"{type(shown).__name__} has no display")


@singledispatch
def figures_of(shown: object) -> dict[str, str]:
    """Return the numbers that describe an object, formatted with their units, by name."""
    raise NotImplementedError(f"{type(shown).__name__} has no display")


@singledispatch
def picture_of(shown: object) -> str:
    """Draw a picture of an object as HTML; '' if it has none."""
    raise NotImplementedError(f"{type(shown).__name__} has no display")


@heading_of.register
def _(carry: Carry) -> str:
    timing = "a timing within limits" if carry.timing == "limits" else f"time law {carry.timing!r}"
    verdict = f": {carry.judgement}" if carry.judgement is not None else ""
    return f"Carry of {carry.workcell.name!r} under {timing}, {carry.duration:.3f} s{verdict}"


@figures_of.register
def _(carry: Carry) -> dict[str, str]:
    hold = static_hold(carry.workcell)
    peaks = carry.peak_normal_force
    excess = excess_above_static(peaks, hold.normal_force)
    found = {
        "peak normal force": f"{_pair(peaks, 3)} N",
        "over the reference": _pair(carry.force_ratio, 4),
        "above level and still": f"{_pair(excess, 2)} %",
        "peak whole force": f"{_pair(carry.peak_resultant_force, 3)} N",
        "payload limit": f"{carry.payload_limit:.3f} kg (level and still {hold.payload_limit:.3f})",
        "largest pressure shift": f"{_pair(1e3 * carry.peak_pressure_shift, 2)} mm",
        "torque of the contacts": f"{_torques(carry.peak_contact_torque_use)} % of maximum",
    }
    if carry.judgement is not None:
        found |= {
            f"objective {name}": f"{value:.6f}"
            for name, value in carry.judgement.objectives.items()
        }
    return found


@picture_of.register
def _(carry: Carry) -> str:
    still = float(static_hold(carry.workcell).normal_force.max())
    time = carry.time - carry.time[0]
    rest = np.array([[time[0], still], [time[-1], still]])
    level = Series("level and still", rest, REST, size=0.8)
    return _forces(carry.workcell, time, carry.normal_force, "normal force [N]", level)


@picture_of.register
def _(job: Job) -> str:
    """Draw the commanded normal forces of the whole job."""
    time = np.concatenate([phase.begin + phase.motion.time for phase in job.phases])
    force = np.concatenate([phase.force.normal for phase in job.phases])
    return _forces(job.workcell, time, force, "commanded normal force [N]")


def _forces(workcell: Workcell, time: Array, force: Array, title: str, *more: Series) -> str:
    """Plot the forces of both arms over time as an SVG picture.

    Args:
        workcell: the cell, for the names of the robots.
        time: (n,) times [s].
        force: (n, 2) force of each robot [N].
        title: title of the force axis.
        more: further series of the plot.
    """
    series = [
        Series(robot.name, np.column_stack([time, force[:, i]]), ARM_COLOURS[i])
        for i, robot in enumerate(workcell.robots)
    ] + list(more)
    return plot(series, "time [s]", title, np.concatenate([one.points for one in series]))


@picture_of.register
def _(found: Recommendation) -> str:
    return picture_of(found.carry if found.job is None else found.job)


def _torques(uses: Array) -> str:
    """Format ratios (n,) of joint torques to their limits in percent, separated by commas."""
    return ", ".join(map(torque_use, uses.tolist()))


def _pair(values: Array, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


@heading_of.register
def _(front: Front) -> str:
    points = "1 carry" if len(front) == 1 else f"{len(front)} carries"
    return f"Front of {front.cell.workcell.name!r} by {front.title}: {points}"


@figures_of.register
def _(front: Front) -> dict[str, str]:
    found = {"searched": repr(front.evaluations)}
    if len(front):
        found |= {
            name: f"{column.min():.5f} to {column.max():.5f}"
            for name, column in zip(front.objective_names, front.objectives.T, strict=True)
        }
    found["hypervolume"] = f"{front.hypervolume():.5f}"
    if front.polished is not None:
        attempts = ", ".join(
            f"{count} {status}"
            for status, count in front.polished.counts.items()
            if ":" not in status
        )
        found["polish"] = f"{attempts} of {len(front.polished.outcomes)} attempts"
    return found


@picture_of.register
def _(front: Front) -> str:
    """Plot the points of a front and the search's candidates by their first two objectives."""
    if len(front) == 0 or front.objectives.shape[1] < 2:
        return ""
    series = []
    cloud = front.evaluations.objectives[front.evaluations.feasible][:, :2]
    if len(cloud) > MAX_CLOUD:
        cloud = cloud[np.linspace(0, len(cloud) - 1, MAX_CLOUD).astype(int)]
    series.append(Series("feasible candidates", cloud, CLOUD, "dots", 1.5))
    points = front.objectives[:, :2]
    series.append(Series(front.title, points, FRONT, "dots", 3.0))
    focus = [points, _nearest(cloud, points)]
    if front.objective_names[:2] == PAPER_OBJECTIVES:
        hold = front.cell.static_hold.normal_force / front.cell.workcell.task.reference_force
        series.append(Series("level and still", hold[None], REST, "cross", 5.0))
        focus.append(hold[None])
    titles = [objective.title for objective in front.cell.evaluator.objectives[:2]]
    return plot(series, titles[0], titles[1], np.concatenate(focus))


def _nearest(cloud: Array, points: Array) -> Array:
    """Return the 20 candidates closest to the only point of a front, for a plot to include; none if
    the front has several points.

    Args:
        cloud: (n, 2) objectives of the candidates.
        points: (k, 2) objectives of the front's points.
    """
    if len(points) > 1 or len(cloud) == 0:
        return np.empty((0, 2))
    distance = np.abs(cloud - points[0]).max(axis=1)
    return np.asarray(cloud[np.argsort(distance)[:20]])


@heading_of.register
def _(timing: Timing) -> str:
    return f"Timing, {timing.status}: {timing.reason}"


@figures_of.register
def _(timing: Timing) -> dict[str, str]:
    """Format, for each limit, the largest ratio of value to limit and where it occurs; the largest
    ratio first."""
    ranked = sorted(timing.use.items(), key=lambda item: -item[1].ratio)
    return {
        name: f"{100.0 * excess.ratio:5.1f} %  {_where(excess.place.robot, excess.place.joint)}"
        f"u = {excess.place.parameter:.3f}"
        for name, excess in ranked
    }


@picture_of.register
def _(timing: Timing) -> str:
    return "" if timing.carry is None else html_of(timing.carry)


@heading_of.register
def _(found: Sensitivities) -> str:
    left = len(found.missing)
    unknown = f"{left} could not be computed" if left else "all could be computed"
    return (
        f"Numbers of {found.workcell.name!r}: press with {found.force:.2f} N, "
        f"{found.duration:.3f} s; the largest changes first, {unknown}"
    )


@figures_of.register
def _(found: Sensitivities) -> dict[str, str]:
    """Format for each number of the workcell file the changes of force and duration that a usual
    change of this number causes. How much is usual depends on its unit."""
    return {f"{row.key} = {row.value:g} {row.unit}".rstrip(): _changes(row) for row in found.rows}


@picture_of.register
def _(found: Sensitivities) -> str:
    return ""


def _changes(row: Sensitivity) -> str:
    parts = [f"{row.change:+.3g} {row.unit}".rstrip() + ":"]
    for slope, lowered, text, unit in (
        (row.force, row.lowered_force, "{:+8.3f}", "N"),
        (row.duration, row.lowered_duration, "{:+8.4f}", "s"),
    ):
        if slope is None or lowered is None:
            continue
        parts.append(f"{text.format(row.change * slope)} {unit}")
        if abs(slope + lowered) > ONE_WAY * max(abs(slope), abs(lowered)):
            parts.append(f"(lowered {text.format(row.change * lowered).strip()} {unit})")
    return " ".join(parts)


def _where(robot: str, joint: str) -> str:
    who = " ".join(part for part in (robot, joint) if part)
    return f"{who}, " if who else ""


PLOT_SIZE = (5.4, 3.4)
"""Size of a plot [inch]."""

PLOT_MARGIN = 0.06
"""Margin of a plot around the data, as a share of the data's range."""

ARM_COLOURS = ("#3b6ea8", "#a8733b")
"""Colours of the two robots, as in the report."""

FRONT, CLOUD, REST = "#b00020", "#9aa3ab", "#1f2933"
"""Colours of a front, of the candidates behind it, and of the payload at rest."""

MARKS = {"line": "-", "dots": "o", "cross": "+"}


@dataclass(frozen=True)
class Series:
    """Points of one kind in a plot, drawn as a line or as marks.

    Attributes:
        label: text in the legend, '' for none.
        points: (n, 2) coordinates in the units of the axes.
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
    """Draw series of points as an SVG picture. Points outside the axes are clipped.

    Args:
        series: series to draw.
        x_title, y_title: titles of the axes.
        focus: (n, 2) points that the ranges of the axes have to include.
    """
    low, high = focus.min(axis=0), focus.max(axis=0)
    room = np.maximum(PLOT_MARGIN * (high - low), 1e-4 * np.maximum(1.0, np.abs(high)))
    look: dict[Any, Any] = {"font.size": 8.0, "text.parse_math": False, "svg.fonttype": "none"}
    with mpl.rc_context(look):
        figure = Figure(figsize=PLOT_SIZE, layout="constrained")
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
