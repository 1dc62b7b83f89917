"""Picture of the positions at which both arms can hold the box at once: views from above, one for
each height."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from hybrid_opt.display.objects import ARM_COLOURS
from hybrid_opt.display.solids import cell_solids, joint_placements
from hybrid_opt.extras.proposing.hold_map import HeldPose, HoldMap
from hybrid_opt.extras.proposing.hold_search import PoseState
from studies.report.drawing import (
    FULL_WIDTH,
    GROUND_COLOUR,
    OBSTACLE,
    View,
    aspect,
    frame_axes,
    panel_label,
    shortened,
)
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry
from symbolic.records import Robot
from symbolic.records.poses import box_placement

FROM_ABOVE = View(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), "x [m]", "y [m]")
"""View from above, x to the right."""

BELOW_COLOUR = "#cfd4d8"
"""Colour of fixed bodies that end below the box."""

COLLIDES_COLOUR, MEETS_COLOUR = "#f0b7a1", "#8c8c8c"
"""Colours of positions where arms collide, and where the box itself collides."""

MOST_COLUMNS = 3
"""Largest number of panels side by side."""

MOST_SHADES = 4
"""Largest number of colours for the directions that hold."""

OPACITY = 0.8
"""Opacity of the positions over the scene."""

BASE_ROOM = 0.25
"""Distance of a base from the border of a panel [m]."""

NAME_OFFSET = np.array([17.0, 11.0])
"""Distance of a robot's name from its base, to the side and upwards [points]."""

EDGES = np.eye(3)[:2]

Classes = tuple[tuple[str, int, int], ...]
"""For each colour, as '#rrggbb', the least and the largest number of directions that it shows."""


def holdable_positions(found: HoldMap) -> Figure:
    """Draw a map of the box positions at which both arms can hold the box.

    There is one panel for each height, seen from above. The colour states for how many directions
    of the box (angles about the vertical) both arms can hold it. The best pose at each height is
    drawn with the box and both arms.

    Args:
        found: the map.
    """
    count, classes = len(found.z), _classes(len(found.yaws))
    columns = min(count, MOST_COLUMNS)
    rows = -(-count // columns)
    points = _extent(found)
    panel = (FULL_WIDTH - 0.6) / columns / aspect(FROM_ABOVE, points)
    height = rows * (panel + 0.2) + 1.5
    figure = Figure(figsize=(FULL_WIDTH, height), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    geometry = found.geometry
    robots, everywhere = geometry.workcell.robots, found.best()
    for level, (axes, letter) in enumerate(zip(panels, "abcdefghijklmnopqrstuvwxyz", strict=False)):
        if level >= count:
            axes.set_axis_off()
            continue
        _draw_scene(axes, geometry, float(found.z[level]))
        middle = np.mean([robot.T_world_base[:3, 3] for robot in robots], axis=0)
        for robot, colour in zip(robots, ARM_COLOURS, strict=True):
            _draw_base(axes, robot, colour, middle)
        _draw_positions(axes, found, level, classes)
        best = found.best(level)
        if best is not None:
            chosen = everywhere is not None and np.array_equal(best.pose, everywhere.pose)
            _draw_held(axes, geometry, best, chosen)
        share = int((found.directions[level] > 0).sum())
        told = f"{share} places" if share else "nowhere"
        panel_label(axes, letter, f"z = {found.z[level]:.2f} m: {told}", bare=True)
        frame_axes(axes, FROM_ABOVE, points)
        axes.label_outer()
    figure.legend(handles=_handles(found, classes), loc="outside lower center", ncols=3)
    turns = ", ".join(f"{angle:.0f}" for angle in np.degrees(found.yaws))
    figure.suptitle(
        f"{shortened(geometry.workcell.name, 60)}\nWhere the centre of the box may be while both "
        f"arms hold it: from above, at heights z.\nDirections of the box: turned by {turns} deg "
        "about the vertical",
        fontsize=8,
    )
    return figure


def _classes(yaws: int) -> Classes:
    """Divide the possible numbers of directions of the box, 1 to `yaws`, into at most `MOST_SHADES`
    classes with one colour each; dark colours stand for many directions.
    """
    edges = np.unique(np.linspace(0, yaws, min(yaws, MOST_SHADES) + 1).round().astype(int))
    shades = mpl.colormaps["YlGn"](np.linspace(0.3, 0.9, len(edges) - 1) if yaws > 1 else [0.7])
    return tuple(
        (to_hex(shade), int(low) + 1, int(high))
        for shade, low, high in zip(shades, edges[:-1], edges[1:], strict=True)
    )


def _extent(found: HoldMap) -> Array:
    """Return points (n, 3) of the world [m] that a panel must contain: the box positions that both
    arms reach, with or without collisions, and the robots' bases.
    """
    geometry, half = found.geometry, found.step / 2.0
    state = found.state
    reached = (state == PoseState.HOLDS) | (state == PoseState.COLLIDES)
    used = reached.any(axis=(0, 3)) if reached.any() else np.ones(state.shape[1:3], dtype=bool)
    y, x = found.y[used.any(axis=1)], found.x[used.any(axis=0)]
    size = float(np.linalg.norm(geometry.workcell.payload.size[:2])) / 2.0
    corners = [
        [x[0] - half - size, y[0] - half - size, 0.0],
        [x[-1] + half + size, y[-1] + half + size, 0.0],
    ]
    bases = [robot.T_world_base[:3, 3] for robot in geometry.workcell.robots]
    around = [base + offset for base in bases for offset in BASE_ROOM * np.vstack([EDGES, -EDGES])]
    return np.vstack([corners, around])


def _outline(points: Array, **style: Any) -> Polygon:
    """Return the outline, seen from above, of a convex body with corners (n, 3) [m]."""
    flat = FROM_ABOVE.flat(points)
    return Polygon(flat[ConvexHull(flat).vertices], closed=True, **style)


def _draw_scene(axes: Axes, geometry: CellGeometry, height: float) -> None:
    """Draw the bodies that are fixed in the world: light below the box, dark beside and above it.

    Args:
        axes: the panel.
        geometry: bodies of the cell.
        height: height of the centre of the box [m].
    """
    lowest = height - float(geometry.workcell.payload.size[2]) / 2.0
    for solid in cell_solids(geometry):
        if solid.frame.kind == "world":
            top = float(solid.vertices[:, 2].max())
            below = BELOW_COLOUR if top < lowest else OBSTACLE
            colour = GROUND_COLOUR if solid.is_ground and top < lowest else below
            axes.add_patch(_outline(solid.vertices, color=colour, linewidth=0.0, zorder=1.0 + top))


def _draw_base(axes: Axes, robot: Robot, colour: str, middle: Array) -> None:
    """Mark the base of a robot, with its name on the side that looks away from the other robot.

    Args:
        axes: the panel.
        robot: the robot.
        colour: colour of the mark.
        middle: (3,) middle of both bases [m].
    """
    base = FROM_ABOVE.flat(robot.T_world_base[:3, 3])
    away = base - FROM_ABOVE.flat(middle)
    apart = float(np.linalg.norm(away))
    # Both arms of one machine have one base.
    up = 1.0 if colour == ARM_COLOURS[0] else -1.0
    away = away / apart if apart > 1e-6 else np.array([0.0, up])
    axes.plot(*base, "o", color=colour, markersize=6.0, zorder=5.5)
    axes.annotate(
        shortened(robot.name, 16),
        (float(base[0]), float(base[1])),
        xytext=tuple(NAME_OFFSET * away),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=7,
        color=colour,
        fontweight="bold",
        zorder=7.0,
    )


def _draw_positions(axes: Axes, found: HoldMap, level: int, classes: Classes) -> None:
    """Fill the grid squares of the box positions at one height.

    Args:
        axes: the panel.
        found: the map.
        level: index of the height.
        classes: colours by the number of directions in which both arms hold the box.
    """
    directions, state = found.directions[level], found.state[level]
    for colour, low, high in classes:
        _fill(axes, found, (directions >= low) & (directions <= high), colour)
    none = directions == 0
    collides = none & (state == PoseState.COLLIDES).any(axis=-1)
    meets = none & ~collides & (state == PoseState.MEETS_SCENE).all(axis=-1)
    _fill(axes, found, collides, COLLIDES_COLOUR)
    _fill(axes, found, meets, "none", hatch="xxxx", edge=MEETS_COLOUR)


def _fill(
    axes: Axes,
    found: HoldMap,
    filled: NDArray[np.bool_],
    colour: str,
    hatch: str = "",
    edge: str = "none",
) -> None:
    """Fill the grid squares of some box positions.

    Args:
        axes: the panel.
        found: the map.
        filled: (ny, nx) True for the positions to fill.
        colour, hatch, edge: how Matplotlib draws a square.
    """
    step = found.step or 0.1
    squares = [
        Rectangle((float(found.x[k] - step / 2.0), float(found.y[j] - step / 2.0)), step, step)
        for j, k in np.argwhere(filled)
    ]
    drawn = PatchCollection(
        squares, facecolor=colour, edgecolor=edge, hatch=hatch, alpha=OPACITY, zorder=3.0
    )
    drawn.set_linewidth(0.0)
    axes.add_collection(drawn, autolim=False)


def _draw_held(axes: Axes, geometry: CellGeometry, hold: HeldPose, chosen: bool) -> None:
    """Draw the outline of the box at a pose, and both arms from joint to joint.

    Args:
        axes: the panel.
        geometry: bodies of the cell.
        hold: pose of the box and posture of the arms.
        chosen: True for the best pose of all heights.
    """
    T_world_box = box_placement(geometry.workcell.task.orientation, hold.pose)
    corners = np.concatenate(
        [solid.vertices for solid in cell_solids(geometry) if solid.frame.kind == "box"]
    )
    placed = corners @ T_world_box[:3, :3].T + T_world_box[:3, 3]
    axes.add_patch(_outline(placed, fill=False, linewidth=1.2, zorder=6.0))
    contacts = geometry.workcell.contacts
    parts = zip(geometry.arms, contacts, hold.q, ARM_COLOURS, strict=True)
    for arm, contact, q, colour in parts:
        placed = joint_placements(arm, q[None])[0]
        held = placed[-1] @ (arm.T_joint_box @ contact.T_box_pad)
        joints = np.vstack([arm.T_world_root[:3, 3], placed[:, :3, 3], held[:3, 3]])
        line = FROM_ABOVE.flat(joints)
        axes.plot(line[:, 0], line[:, 1], "-", color=colour, linewidth=1.6, zorder=5.0)
        axes.plot(*line[-1], "o", color=colour, markersize=3.5, zorder=6.5)
    star: dict[str, Any] = {"markersize": 9.0 if chosen else 4.0, "zorder": 7.0, "color": "black"}
    axes.plot(*FROM_ABOVE.flat(hold.pose[:3]), "*" if chosen else ".", **star)


def _handles(found: HoldMap, classes: Classes) -> list[Patch | Line2D]:
    """Return the entries of the legend."""
    count = len(found.yaws)

    def told(low: int, high: int) -> str:
        number = f"{low}" if low == high else f"{low} to {high}"
        return f"both hold it in {number} of {count} directions" if count > 1 else "both hold it"

    handles: list[Patch | Line2D] = [
        Patch(facecolor=colour, alpha=OPACITY, label=told(low, high))
        for colour, low, high in classes[::-1]
    ]
    handles += [
        Patch(facecolor=COLLIDES_COLOUR, alpha=OPACITY, label="both reach it, arms collide"),
        Patch(
            facecolor="none", edgecolor=MEETS_COLOUR, hatch="xxxx", label="the box itself collides"
        ),
        Patch(facecolor=BELOW_COLOUR, label="fixed body below the box"),
        Patch(facecolor=OBSTACLE, label="fixed body beside or above the box"),
        Patch(facecolor="none", edgecolor="none", label="no colour: an arm does not reach it"),
    ]
    dot: dict[str, Any] = {"color": "black", "linestyle": "none"}
    handles += [
        Line2D([], [], marker="*", markersize=8.0, label="best place of all", **dot),
        Line2D([], [], marker=".", label="best place at this height", **dot),
        Line2D([], [], color="black", linewidth=1.2, label="box and arms at the best place"),
    ]
    return handles
