"""The pictures of fronts on the page: axes, what is clicked, and what the first look shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from symbolic.array import Array

ROOM = 0.06
"""Beside the points that a look shows, as a share of their range."""

LONGEST = 2.2
"""Durations in the first look at time and force, over the shortest one."""

HIGHEST = 1.3
"""Forces there, over the least one."""


@dataclass
class FrontView:
    """One picture, as it is put together.

    Attributes:
        name: on its button.
        x_title, y_title: of the axes.
        groups: points that show their trajectory when clicked, as JSON values.
        clouds: points that do not.
        lines: curves.
        star: a marked point (x, y) and its label, None without one.
    """

    name: str
    x_title: str
    y_title: str
    groups: list[dict[str, Any]] = field(default_factory=list)
    clouds: list[dict[str, Any]] = field(default_factory=list)
    lines: list[dict[str, Any]] = field(default_factory=list)
    star: tuple[float, float, str] | None = None

    def add(self, label: str, members: Sequence[int], points: Array, look: dict[str, Any]) -> None:
        """Add points (k, 2) of trajectories that the page holds under these numbers."""
        points = np.asarray(points, dtype=float).reshape(-1, 2)
        x, y = points.T.tolist()
        self.groups.append({"label": label, "members": list(members), "x": x, "y": y, **look})

    def document(self, first: Array) -> dict[str, Any]:
        """The picture as JSON values.

        Args:
            first: (k, 2) points that the first look shows.
        """
        whole = [np.column_stack([entry["x"], entry["y"]]) for entry in (*self.groups, *self.lines)]
        if self.star is not None:
            whole.append(np.array([self.star[:2]]))
        return {
            "name": self.name,
            "xTitle": self.x_title,
            "yTitle": self.y_title,
            "groups": self.groups,
            "clouds": self.clouds,
            "lines": self.lines,
            "star": self.star,
            "first": limits(first),
            "whole": limits(np.concatenate([*whole, np.zeros((0, 2))])),
        }


def limits(points: Array) -> list[list[float]]:
    """Limits of both axes around points (k, 2)."""
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return [[0.0, 1.0], [0.0, 1.0]]
    low, high = points.min(axis=0), points.max(axis=0)
    room = np.maximum(ROOM * (high - low), 1e-4)
    found: list[list[float]] = np.stack([low - room, high + room], axis=1).tolist()
    return found


def drive_look(points: Array, always: Array) -> Array:
    """Points (k, 2) of force and duration that the first look shows.

    Both ends of a drivable front are long and flat: forces next to that of holding still, and
    durations next to the shortest. Neither is to squash what lies between.

    Args:
        points: of the fronts and curves.
        always: (n, 2) what the look has to show besides.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return always
    force, duration = points.min(axis=0)
    near = (points[:, 0] <= HIGHEST * force) & (points[:, 1] <= LONGEST * duration)
    return np.concatenate([points[near], always])
