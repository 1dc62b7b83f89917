"""Pictures of the cell: reachable regions, the environment, the arm, motion sequences; and where
the arms reach."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy import ndimage

from hybrid_opt.display.objects import ARM_COLOURS
from hybrid_opt.display.solids import (
    Solid,
    cell_solids,
    extent_points,
    frame_placements,
    motion_points,
)
from studies.report.drawing import (
    FRONT_VIEW,
    ISOMETRIC,
    MARGIN,
    SIDE,
    CutCell,
    DrawnCarry,
    View,
    aspect,
    box_corners,
    draw_box_edges,
    draw_cell,
    draw_path,
    frame_axes,
    legend_below,
    new_figure,
    oblique,
    panel_label,
    shortened,
)
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry
from symbolic.records.poses import skew

_PLAN = View(np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0]), "y [m]", "x [m]", mirrored=True)
"""View from above, the front below."""

HATCHES = ("////", "\\\\\\\\")
"""Hatches of the two regions that the pads reach."""

SHARES = (0.0, 0.33, 0.66, 1.0)
"""Shares of a carry's duration at which it is drawn, as in the paper's Figures 14 and 15."""


CUBE_EDGE = 0.05
"""Edge of the grid's cubes [m]; finer ones could not be seen in a picture of two metres."""

REACH_POSTURES = 300_000
"""Number of random postures per arm; about ten per cube for an arm with a reach of 1.3 m."""


@dataclass(frozen=True)
class ReachMap:
    """Positions that the pads and the box centre can take, on a grid of cubes. Orientations are
    ignored.

    A pad reaches a cube if it is in the cube in some random posture within the joint limits.

    Attributes:
        lower: (3,) lower corner of the grid in the world frame [m].
        step: edge of the cubes [m].
        pads: for each arm a boolean array (nx, ny, nz), True for cubes that the pad reaches.
        common: boolean array (nx, ny, nz), True for cubes of the box centre in which both pads of a
            level box are in cubes that they reach.
    """

    lower: Array
    step: float
    pads: tuple[NDArray[Any], NDArray[Any]]
    common: NDArray[Any]


def reach_map(geometry: CellGeometry, rng: np.random.Generator) -> ReachMap:
    """Compute the cubes of a grid that each pad reaches in random postures within the joint limits.

    Holes of a few cubes, which random postures miss, are filled.

    Args:
        geometry: geometry of the cell.
        rng: source of the postures.
    """
    clouds = [_pad_points(geometry, i, rng) for i in (0, 1)]
    both = np.concatenate(clouds)
    lower = np.floor(both.min(axis=0) / CUBE_EDGE - 3.0) * CUBE_EDGE
    shape = tuple(np.ceil((both.max(axis=0) - lower) / CUBE_EDGE).astype(int) + 4)
    pads = []
    for cloud in clouds:
        reached = np.zeros(shape, dtype=bool)
        index = ((cloud - lower) / CUBE_EDGE).astype(int)
        reached[index[:, 0], index[:, 1], index[:, 2]] = True
        pads.append(ndimage.binary_closing(reached, iterations=2))
    # The box's centre is where both pads, as far from it as they are, are reached.
    offsets = [contact.T_box_pad[:3, 3] / CUBE_EDGE for contact in geometry.workcell.contacts]
    shifted = [
        ndimage.shift(reached, -np.round(offset), order=0)
        for reached, offset in zip(pads, offsets, strict=True)
    ]
    return ReachMap(lower, CUBE_EDGE, (pads[0], pads[1]), shifted[0] & shifted[1])


def _pad_points(geometry: CellGeometry, i: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Compute positions of an arm's pad in random postures within the joint limits.

    Args:
        geometry: geometry of the cell.
        i: index of the arm.
        rng: source of the postures.

    Returns:
        (REACH_POSTURES, 3) positions in the world [m].
    """
    arm, contact = geometry.arms[i], geometry.workcell.contacts[i]
    pad = (arm.T_joint_box @ contact.T_box_pad)[:3, 3]
    # Single precision is far more than cubes need, and half the work.
    span = (arm.upper - arm.lower).astype(np.float32)
    q = arm.lower[:, None].astype(np.float32) + span[:, None] * rng.random(
        (arm.joints, REACH_POSTURES), dtype=np.float32
    )
    # From the pad back to the root: points are a fifth of the work of placements.
    points = np.tile(pad[:, None].astype(np.float32), REACH_POSTURES)
    for j in reversed(range(arm.joints)):
        if arm.turning[j]:  # Rodrigues' formula about the joint's axis
            across = skew(arm.axes[j]).astype(np.float32)
            points += np.sin(q[j]) * (across @ points) + (1.0 - np.cos(q[j])) * (
                across @ across @ points
            )
        else:
            points += np.outer(arm.axes[j].astype(np.float32), q[j])
        points = _seen(arm.origins[j], points)
    return _seen(arm.T_world_root, points).T


def _seen(T: Array, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Transform points (3, n) by a homogeneous transform T (4, 4); return points (3, n)."""
    placed = T.astype(np.float32)
    return np.asarray(placed[:3, :3] @ points + placed[:3, 3:])


def reachable_regions(geometry: CellGeometry, reach: ReachMap, carry: DrawnCarry) -> Figure:
    """Draw the reach of both pads (positions, sampled within the joint limits), the common region
    of the box centre, and the bounds of the free waypoints (paper Figure 4)."""
    figure = new_figure(0.42)
    corners = box_corners(*_reach_bounds(reach))
    left, right = figure.subplots(
        1, 2, width_ratios=[aspect(v, corners) for v in (FRONT_VIEW, SIDE)]
    )
    lowest, highest = (np.array(corners) for corners in zip(*_free_bounds(geometry), strict=True))
    middle = (lowest.min(axis=0) + highest.max(axis=0)) / 2.0
    fixed = _fixed(geometry)
    for axes, view, across, letter, text in (
        (left, FRONT_VIEW, 0, "a", f"front view, slice at x = {_metres(middle[0])}"),
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
            for name, colour, hatch in zip(names, ARM_COLOURS, HATCHES, strict=True)
        ),
        Patch(facecolor="#2a8f4d", alpha=0.55, label="common region of the box centre"),
        Line2D([], [], color="#b00020", linewidth=0.9, label="bounds of the free waypoints"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def environment(geometry: CellGeometry, carry: DrawnCarry) -> Figure:
    """Draw the cell at the start of the carry (paper Figure 5)."""
    figure = new_figure(0.34)
    solids = cell_solids(geometry)
    cell = CutCell.of(geometry, solids)
    pose, q = _start(carry)
    points = extent_points(geometry, solids, pose[None], q[None])
    views = (FRONT_VIEW, SIDE, ISOMETRIC)
    panels = figure.subplots(1, 3, width_ratios=[aspect(view, points) for view in views])
    shown = [
        (text, view, points) for text, view in zip(("front", "side", "oblique"), views, strict=True)
    ]
    _draw_views(panels, cell, shown, pose, q)
    return figure


def _draw_views(
    panels: Iterable[Axes],
    cell: CutCell,
    shown: Iterable[tuple[str, View, Array]],
    pose: Array,
    q: Array,
    hidden: tuple[str, ...] = (),
    margin: float = MARGIN,
) -> None:
    """Draw the cell at one sample in several panels.

    Args:
        panels: the panels.
        cell: the solids to draw.
        shown: per panel its title, its view, and points (n, 3) of the world that it must contain.
        pose: (6,) pose of the box [m, rad].
        q: (12,) joint positions of both arms [rad].
        hidden: kinds of frames whose solids are left out.
        margin: distance of the points from the border of a picture [m].
    """
    for axes, letter, (text, view, points) in zip(panels, "abc", shown, strict=True):
        draw_cell(axes, cell, view, pose, q, hidden)
        panel_label(axes, letter, text, bare=True)
        frame_axes(axes, view, points, margin)


def facing(way: Array) -> View:
    """Return that one of two oblique views in which a direction points towards the viewer. Seen
    along the direction from a robot's base to the box, the machine does not hide its arm.

    Args:
        way: (3,) the direction in the world.
    """
    return max(ISOMETRIC, OTHER_SIDE, key=lambda view: float(way @ view.towards))


def arm_and_reach(geometry: CellGeometry, reach: ReachMap, carry: DrawnCarry) -> Figure:
    """Draw the first arm at the start and the region that its pad reaches (paper Figure 6)."""
    figure = new_figure(0.5)
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
    _draw_slice(right, FRONT_VIEW, reach, 0, index, reach.pads[0], ARM_COLOURS[0], HATCHES[0])
    draw_cell(right, cell, FRONT_VIEW, pose, q)
    bounds = _reach_bounds(reach)
    occupied = np.flatnonzero(reach.pads[0].any(axis=(0, 2)))
    bounds[:, 1] = reach.lower[1] + reach.step * np.array([occupied[0] - 1, occupied[-1] + 2])
    frame_axes(right, FRONT_VIEW, box_corners(*bounds), margin=0.0)
    panel_label(right, "b", f"reach of its pad, slice at x = {_metres(base[0])}", bare=True)
    return figure


def motion_sequence(geometry: CellGeometry, carry: DrawnCarry) -> Figure:
    """Draw the cell at 0, 33, 66 and 100 % of a carry (paper Figures 14 and 15)."""
    points = motion_points(geometry, carry.timed.pose, carry.timed.q)
    cell = CutCell.of(geometry, cell_solids(geometry))
    figure = new_figure(0.74)
    panels = figure.subplots(2, 2).ravel()
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


def paths(geometry: CellGeometry, carries: tuple[DrawnCarry, ...]) -> Figure:
    """Draw the paths of the box centre (paper Figure 13)."""
    # A plane that they hardly leave is seen edge-on once.
    cell = _fixed(geometry)
    points = np.concatenate([carry.timed.pose[:, :3] for carry in carries])
    half = geometry.workcell.payload.size / 2.0
    near = box_corners(points.min(axis=0) - half, points.max(axis=0) + half)
    chosen = planes(points)
    views = (*(view for view, _ in chosen), ISOMETRIC)
    figure = new_figure(0.5)
    panels = figure.subplots(1, 3, width_ratios=[aspect(view, near) for view in views])
    texts = (*(text for _, text in chosen), "oblique")
    shown = [(text, view, near) for text, view in zip(texts, views, strict=True)]
    _draw_views(panels, cell, shown, *_start(carries[0]), hidden=("box", "link"))
    for axes, view in zip(panels, views, strict=True):
        for carry in carries:
            draw_path(axes, view, carry.timed.pose[:, :3], **carry.look.drawn, label=carry.label)
        ends = view.flat(carries[0].timed.pose[[0, -1], :3])
        axes.plot(*ends[0], "o", color="black", zorder=5, label="start")
        axes.plot(*ends[1], "*", color="black", markersize=7, zorder=5, label="goal")
    legend_below(figure, panels[0])
    return figure


def planes(points: Array) -> tuple[tuple[View, str], tuple[View, str]]:
    """Return the two planes of world axes in which points extend farthest.

    Args:
        points: (n, 3) points in the world [m].

    Returns:
        For each plane a view onto it, and its name.
    """
    extent = np.ptp(points, axis=0)
    every = (("y–z plane", FRONT_VIEW, 0), ("x–z plane", SIDE, 1), ("x–y plane", _PLAN, 2))
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
    """Draw a slice through the regions that the pads and the box centre reach.

    In slices across y only the common region is drawn, because the pads' regions would hide it.

    Args:
        axes: axes to draw into.
        reach: grid with the regions.
        view: direction from which the slice is seen.
        across: index of the world axis that is perpendicular to the slice.
        at: coordinate of the slice on this axis [m].
    """
    index = int((at - reach.lower[across]) / reach.step)
    if across == 0:
        for pads, colour, hatch in zip(reach.pads, ARM_COLOURS, HATCHES, strict=True):
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
    """Fill one slice of a region.

    Args:
        axes: axes to draw into.
        view: direction from which the slice is seen.
        reach: the grid.
        across: index of the world axis that is perpendicular to the slice.
        index: index of the slice's cubes along this axis.
        region: boolean array (nx, ny, nz), True in the region.
        colour, hatch, alpha: colour, pattern and opacity of the slice.
    """
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
"""View like `ISOMETRIC`, from the opposite side."""

CLOSE_UP = 0.25
"""Half the width of a close-up [m]."""


def meeting(
    geometry: CellGeometry, pair: tuple[str, str], pose: Array, q: Array, title: str
) -> Figure:
    """Draw two colliding bodies in red: once in the whole cell, and from two sides with their
    surroundings.

    Args:
        geometry: geometry of the cell.
        pair: names of the bodies.
        pose: (6,) pose of the box at the collision [m, rad].
        q: (joints,) joint positions of both arms at the collision [rad].
        title: title of the figure.
    """
    figure = new_figure(0.36)
    solids = cell_solids(geometry)
    whole = CutCell.of(geometry, solids, pair)
    place = meeting_place(geometry, solids, pair, pose, q)
    near = box_corners(place - CLOSE_UP, place + CLOSE_UP)
    shown: tuple[tuple[str, View, Array], ...] = (
        ("the cell", ISOMETRIC, extent_points(geometry, solids, pose[None], q[None])),
        ("near by", ISOMETRIC, near),
        ("from behind", OTHER_SIDE, near),
    )
    _draw_views(figure.subplots(1, 3), whole, shown, pose, q, margin=0.0)
    figure.suptitle(title, fontsize=8)
    return figure


def meeting_place(
    geometry: CellGeometry,
    solids: tuple[Solid, ...],
    pair: tuple[str, str],
    pose: Array,
    q: Array,
) -> Array:
    """Compute the middle of the region in which the bounding boxes of two bodies intersect.

    Args:
        geometry: geometry of the cell.
        solids: solids of the cell, among them those of the bodies.
        pair: names of the bodies.
        pose: (6,) pose of the box [m, rad].
        q: (joints,) joint positions of both arms [rad].

    Returns:
        (3,) position in the world [m].
    """
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
