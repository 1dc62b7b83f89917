"""Pictures of the cell: reachable regions, the environment, the arm, motion sequences."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from hybrid_opt.display.solids import (
    Solid,
    cell_solids,
    extent_points,
    frame_placements,
    motion_points,
)
from studies.report.drawing import (
    ARMS,
    FRONT,
    FULL_WIDTH,
    ISOMETRIC,
    SIDE,
    CutCell,
    LineStyle,
    View,
    aspect,
    box_corners,
    draw_box_edges,
    draw_cell,
    draw_path,
    frame_axes,
    new_figure,
    oblique,
    panel_label,
    shortened,
)
from studies.report.drawn import DrawnCarry, ReachMap
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry

_PLAN = View(np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0]), "y [m]", "x [m]", mirrored=True)
"""View from above, the front below."""

HATCHES = ("////", "\\\\\\\\")
"""Hatches of the regions that the pads reach."""

SHARES = (0.0, 0.33, 0.66, 1.0)
"""Shares of a carry's duration, as in the paper's Figures 14 and 15."""


def reachable_regions(geometry: CellGeometry, reach: ReachMap, carry: DrawnCarry) -> Figure:
    """Reach of both pads (positions, sampled within the joint limits), the common region of the box
    centre, and the bounds of the free waypoints (paper Figure 4)."""
    figure = new_figure(FULL_WIDTH, 0.42 * FULL_WIDTH)
    corners = box_corners(*_reach_bounds(reach))
    left, right = figure.subplots(1, 2, width_ratios=[aspect(v, corners) for v in (FRONT, SIDE)])
    lowest, highest = (np.array(corners) for corners in zip(*_free_bounds(geometry), strict=True))
    middle = (lowest.min(axis=0) + highest.max(axis=0)) / 2.0
    fixed = _fixed(geometry)
    for axes, view, across, letter, text in (
        (left, FRONT, 0, "a", f"front view, slice at x = {_metres(middle[0])}"),
        (right, SIDE, 1, "b", f"side view, slice at y = {_metres(middle[1])}"),
    ):
        _draw_reach(axes, reach, view, across, float(middle[across]))
        draw_cell(axes, fixed, view, *_start(carry), hidden=("box",))
        for lower, upper in _free_bounds(geometry):
            draw_box_edges(axes, view, lower, upper, colors="#b00020", linewidths=0.9)
        panel_label(axes, letter, text, bare=True)
        frame_axes(axes, view, corners, margin=0.0)
    names = [shortened(robot.name) for robot in geometry.workcell.robots]
    handles = [
        *(
            Patch(
                facecolor=colour,
                edgecolor=colour,
                linewidth=0.0,
                alpha=0.35,
                hatch=hatch,
                label=f"pad of {name} reaches",
            )
            for name, colour, hatch in zip(names, ARMS, HATCHES, strict=True)
        ),
        Patch(facecolor="#2a8f4d", alpha=0.55, label="common region of the box centre"),
        Line2D([], [], color="#b00020", linewidth=0.9, label="bounds of the free waypoints"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def environment(geometry: CellGeometry, carry: DrawnCarry) -> Figure:
    """The cell at the start of the carry (paper Figure 5)."""
    figure = new_figure(FULL_WIDTH, 0.34 * FULL_WIDTH)
    solids = cell_solids(geometry)
    cell = CutCell.of(geometry, solids)
    pose, q = _start(carry)
    points = extent_points(geometry, solids, pose[None], q[None])
    views = (FRONT, SIDE, ISOMETRIC)
    panels = figure.subplots(1, 3, width_ratios=[aspect(view, points) for view in views])
    for axes, view, letter, text in zip(
        panels, views, "abc", ("front", "side", "oblique"), strict=True
    ):
        draw_cell(axes, cell, view, pose, q)
        panel_label(axes, letter, text, bare=True)
        frame_axes(axes, view, points)
    return figure


def facing(way: Array) -> View:
    """The oblique view in which what goes along a way (3,) comes nearer: an arm is not hidden by
    the machine that it belongs to."""
    return max(ISOMETRIC, OTHER_SIDE, key=lambda view: float(way @ view.towards))


def arm_and_reach(geometry: CellGeometry, reach: ReachMap, carry: DrawnCarry) -> Figure:
    """The first arm at the start and the region that its pad reaches (paper Figure 6)."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    left, right = figure.subplots(1, 2)
    robot = geometry.workcell.robots[0]
    arm = tuple(s for s in cell_solids(geometry) if s.group == "robot 1")
    pose, q = _start(carry)
    cell = CutCell.of(geometry, arm)
    view = facing(pose[:3] - robot.T_world_base[:3, 3])
    draw_cell(left, cell, view, pose, q)
    frame_axes(left, view, extent_points(geometry, arm, pose[None], q[None]))
    panel_label(left, "a", f"arm {shortened(robot.name)!r} at the start", bare=True)
    base = robot.T_world_base[:3, 3]
    index = int((base[0] - reach.lower[0]) / reach.step)
    _draw_slice(right, FRONT, reach, 0, index, reach.pads[0], ARMS[0], HATCHES[0])
    draw_cell(right, cell, FRONT, pose, q)
    bounds = _reach_bounds(reach)
    occupied = np.flatnonzero(reach.pads[0].any(axis=(0, 2)))
    bounds[:, 1] = reach.lower[1] + reach.step * np.array([occupied[0] - 1, occupied[-1] + 2])
    frame_axes(right, FRONT, box_corners(*bounds), margin=0.0)
    panel_label(right, "b", f"reach of its pad, slice at x = {_metres(base[0])}", bare=True)
    return figure


def motion_sequence(geometry: CellGeometry, carry: DrawnCarry, columns: int = 2) -> Figure:
    """The cell at 0, 33, 66 and 100 % of a carry (paper Figures 14 and 15)."""
    rows = -(-len(SHARES) // columns)
    points = motion_points(geometry, carry.timed.pose, carry.timed.q)
    cell = CutCell.of(geometry, cell_solids(geometry))
    figure = new_figure(FULL_WIDTH, 0.37 * FULL_WIDTH * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    time = carry.timed.time
    moments = time[0] + np.array(SHARES) * carry.timed.duration
    samples = [int(np.argmin(np.abs(time - moment))) for moment in moments]
    for axes, share, sample, letter in zip(panels, SHARES, samples, "abcd", strict=True):
        draw_cell(axes, cell, ISOMETRIC, carry.timed.pose[sample], carry.timed.q[sample])
        draw_path(
            axes, ISOMETRIC, carry.timed.pose[: sample + 1, :3], color="#b00020", linewidth=1.0
        )
        moment = carry.timed.time[sample]
        panel_label(axes, letter, f"{100 * share:.0f} % of the time, t = {moment:.2f} s", bare=True)
        frame_axes(axes, ISOMETRIC, points)
    figure.suptitle(carry.label, fontsize=8)
    return figure


def paths(geometry: CellGeometry, carries: tuple[tuple[DrawnCarry, LineStyle], ...]) -> Figure:
    """Paths of the box centre (paper Figure 13)."""
    # A plane that they hardly leave is seen edge-on once.
    cell = _fixed(geometry)
    points = np.concatenate([carry.timed.pose[:, :3] for carry, _ in carries])
    half = geometry.workcell.payload.size / 2.0
    near = box_corners(points.min(axis=0) - half, points.max(axis=0) + half)
    chosen = planes(points)
    views = (*(view for view, _ in chosen), ISOMETRIC)
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    panels = figure.subplots(1, 3, width_ratios=[aspect(view, near) for view in views])
    texts = (*(text for _, text in chosen), "oblique")
    for axes, view, letter, text in zip(panels, views, "abc", texts, strict=True):
        draw_cell(axes, cell, view, *_start(carries[0][0]), hidden=("box", "link"))
        for carry, look in carries:
            draw_path(axes, view, carry.timed.pose[:, :3], **look.drawn, label=carry.label)
        ends = view.flat(carries[0][0].timed.pose[[0, -1], :3])
        axes.plot(*ends[0], "o", color="black", zorder=5, label="start")
        axes.plot(*ends[1], "*", color="black", markersize=7, zorder=5, label="goal")
        panel_label(axes, letter, text, bare=True)
        frame_axes(axes, view, near)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def planes(points: Array) -> tuple[tuple[View, str], tuple[View, str]]:
    """The two planes of the world, with their names, in which points (n, 3) take most room."""
    extent = np.ptp(points, axis=0)
    every = (("y–z plane", FRONT, 0), ("x–z plane", SIDE, 1), ("x–y plane", _PLAN, 2))
    first, second, _ = sorted(every, key=lambda plane: float(extent[plane[2]]))
    return (first[1], first[0]), (second[1], second[0])


def _metres(value: float) -> str:
    return f"{value:.2f} m".replace("-", "\N{MINUS SIGN}")


def _start(carry: DrawnCarry) -> tuple[Array, Array]:
    return carry.timed.pose[0], carry.timed.q[0]


def _fixed(geometry: CellGeometry) -> CutCell:
    fixed = tuple(solid for solid in cell_solids(geometry) if solid.frame.kind == "world")
    return CutCell.of(geometry, fixed)


def _free_bounds(geometry: CellGeometry) -> list[tuple[Array, Array]]:
    task = geometry.workcell.task
    free = [task.waypoints[i] for i in task.free_indices]
    return [(waypoint.lower[:3], waypoint.upper[:3]) for waypoint in free]


def _reach_bounds(reach: ReachMap) -> Array:
    shape = np.array(reach.common.shape)
    bounds = np.array([reach.lower, reach.lower + shape * reach.step])
    bounds[0, 2] = max(bounds[0, 2], -0.15)
    return bounds


def _draw_reach(axes: Axes, reach: ReachMap, view: View, across: int, at: float) -> None:
    """Slices of the reach across a world axis; along the line between the arms only what both
    reach together, because their own regions would hide it."""
    index = int((at - reach.lower[across]) / reach.step)
    if across == 0:
        for pads, colour, hatch in zip(reach.pads, ARMS, HATCHES, strict=True):
            _draw_slice(axes, view, reach, across, index, pads, colour, hatch)
    _draw_slice(axes, view, reach, across, index, reach.common, "#2a8f4d", "", 0.55)


def _draw_slice(
    axes: Axes,
    view: View,
    reach: ReachMap,
    across: int,
    index: int,
    region: NDArray[np.bool_],
    colour: str,
    hatch: str,
    alpha: float = 0.35,
) -> None:
    """A slice of a region (nx, ny, nz) of the grid across a world axis, filled."""
    mask = np.take(region, index, axis=across)
    if not mask.any():
        return
    kept = [a for a in range(3) if a != across]
    centres = [
        reach.lower[a] + (np.arange(mask.shape[k]) + 0.5) * reach.step for k, a in enumerate(kept)
    ]
    sign = float(np.sign(view.right[kept[0]]))
    filled = axes.contourf(
        sign * centres[0],
        centres[1],
        mask.T.astype(float),
        levels=(0.5, 1.5),
        colors=[colour],
        alpha=alpha,
        hatches=[hatch],
        zorder=0.5,
    )
    filled.set_edgecolor(colour)
    filled.set_linewidth(0.0)


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
        panel_label(axes, letter, text, bare=True)
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
