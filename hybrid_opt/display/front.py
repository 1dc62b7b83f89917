"""A front as text, and in a notebook as a plot of its points before the search's candidates."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

import numpy as np

from hybrid_opt.display.svg import CLOUD, FRONT, REST, Series, plot
from hybrid_opt.display.table import lines, table
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from symbolic.array import Array

if TYPE_CHECKING:
    from hybrid_opt.front import Front

MAX_CLOUD = 1500
"""Feasible candidates behind a front."""


def front_text(front: Front) -> str:
    """Text of a front."""
    return "\n".join([heading(front), *lines(figures(front))])


def front_html(front: Front) -> str:
    """HTML of a front for a notebook."""
    picture = _picture(front) if len(front) and front.objectives.shape[1] >= 2 else ""
    return f"<div><p>{html.escape(heading(front))}</p>{table(figures(front))}{picture}</div>"


def heading(front: Front) -> str:
    """A front in one line."""
    points = "1 carry" if len(front) == 1 else f"{len(front)} carries"
    return f"Front of {front.cell.workcell.name!r} by {front.title}: {points}"


def figures(front: Front) -> dict[str, str]:
    """Figures by name."""
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


def _picture(front: Front) -> str:
    """The first two objectives."""
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
    """A front of one point gets some of the candidates around it to stand before."""
    if len(points) > 1 or len(cloud) == 0:
        return np.empty((0, 2))
    distance = np.abs(cloud - points[0]).max(axis=1)
    return np.asarray(cloud[np.argsort(distance)[:20]])
