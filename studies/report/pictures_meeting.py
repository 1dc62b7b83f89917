"""Two bodies that meet: where in the cell, and near by."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from hybrid_opt.display.solids import Solid, cell_solids, extent_points, frame_placements
from studies.report.drawing import (
    ISOMETRIC,
    CutCell,
    View,
    box_corners,
    draw_cell,
    frame_axes,
    oblique,
)
from studies.report.style import FULL_WIDTH, new_figure, panel_label
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry

OTHER_SIDE = oblique(np.deg2rad(28.0), np.deg2rad(26.0))
"""As `ISOMETRIC`, from behind."""

NEAR = 0.25
"""Half the width of what is shown near by [m]."""


def meeting(
    geometry: CellGeometry, pair: tuple[str, str], pose: Array, q: Array, title: str
) -> Figure:
    """The cell with both bodies in red: all of it, and what is near them from two sides.

    Args:
        geometry: the cell.
        pair: names of the bodies.
        pose, q: (6,) of the box and (all joints,) where they meet [m, rad].
        title: above it.
    """
    figure = new_figure(FULL_WIDTH, 0.36 * FULL_WIDTH)
    solids = cell_solids(geometry)
    whole = CutCell.of(geometry, solids, pair)
    place = meeting_place(geometry, solids, pair, pose, q)
    near = box_corners(place - NEAR, place + NEAR)
    shown: tuple[tuple[str, View, Array], ...] = (
        ("the cell", ISOMETRIC, extent_points(geometry, solids, pose[None], q[None])),
        ("near by", ISOMETRIC, near),
        ("from behind", OTHER_SIDE, near),
    )
    for axes, letter, (text, view, points) in zip(figure.subplots(1, 3), "abc", shown, strict=True):
        draw_cell(axes, whole, view, pose, q)
        panel_label(axes, letter, text)
        frame_axes(axes, view, points, margin=0.0)
    figure.suptitle(title, fontsize=8)
    return figure


def meeting_place(
    geometry: CellGeometry,
    solids: tuple[Solid, ...],
    pair: tuple[str, str],
    pose: Array,
    q: Array,
) -> Array:
    """(3,) middle of what both bodies' bounding boxes share in the world [m]."""
    placed = frame_placements(geometry, pose[None], q[None])
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    for name in pair:
        points = np.concatenate(
            [
                solid.vertices @ placed[solid.frame][0][:3, :3].T + placed[solid.frame][0][:3, 3]
                for solid in solids
                if solid.name == name
            ]
        )
        low, high = np.maximum(low, points.min(axis=0)), np.minimum(high, points.max(axis=0))
    return np.asarray((low + high) / 2.0)
