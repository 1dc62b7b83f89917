"""Orthographic pictures of a cell on Matplotlib axes, faces sorted from back to front."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb

from hybrid_opt.display.solids import Solid, frame_placements
from studies.report.style import ARMS, GROUND, MARKED, OBSTACLE, PAYLOAD
from symbolic.array import Array
from symbolic.geometry.bodies import Frame
from symbolic.geometry.pairs import CellGeometry

MAX_EDGE = 0.12
"""Faces are cut to this size, so that sorting them by their middle is right [m]."""

LIGHT = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])


@dataclass(frozen=True)
class View:
    """A camera at infinity.

    Attributes:
        right, up: (3,) unit vectors of the picture in the world.
        x_label, y_label: of the axes, '' where the picture's axes are not the world's.
        mirrored: whether the horizontal axis runs to the left in the world's coordinate.
    """

    right: Array
    up: Array
    x_label: str = ""
    y_label: str = ""
    mirrored: bool = False

    @property
    def towards(self) -> Array:
        """(3,) unit vector from the scene to the eye."""
        return np.cross(self.right, self.up)

    def flat(self, points: Array) -> Array:
        """(..., 2) picture coordinates of world points (..., 3)."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


_X, _Y, _Z = np.eye(3)

FRONT = View(-_Y, _Z, "y [m]", "z [m]", mirrored=True)
"""From the side of -x, as one stands before the rack."""

SIDE = View(_X, _Z, "x [m]", "z [m]")
"""From the side of -y."""


def oblique(azimuth: float, elevation: float) -> View:
    """A view from a direction: azimuth about z from +x, elevation above the ground [rad]."""
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    towards = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    return View(right, np.cross(towards, right))


ISOMETRIC = oblique(np.deg2rad(-152.0), np.deg2rad(26.0))
"""From the side of -x, a little to the right and above."""


@dataclass(frozen=True)
class Faces:
    """Triangles in the frame of a solid, cut to size, with what colours them."""

    frame: Frame
    triangles: Array
    normals: Array
    colour: tuple[float, float, float]
    is_ground: bool


@dataclass(frozen=True)
class CutCell:
    """A cell, and the faces of it that are drawn."""

    geometry: CellGeometry
    faces: tuple[Faces, ...]

    @classmethod
    def of(
        cls, geometry: CellGeometry, solids: Sequence[Solid], marked: Collection[str] = ()
    ) -> CutCell:
        """The cell with some of its solids, those of the marked names in red."""
        return cls(geometry, cut_faces(solids, marked))


def cut_faces(solids: Sequence[Solid], marked: Collection[str] = ()) -> tuple[Faces, ...]:
    """The solids' triangles cut to `MAX_EDGE`, coloured by the party they belong to."""
    faces = []
    for solid in solids:
        vertices, triangles = solid.vertices, solid.faces
        if not solid.is_ground:
            vertices, triangles = trimesh.remesh.subdivide_to_size(  # type: ignore[no-untyped-call]
                vertices, triangles, MAX_EDGE, max_iter=12
            )
        corners = vertices[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1)
        keep = length > 0.0
        normals = normals[keep] / length[keep, None]
        colour = to_rgb(MARKED if solid.name in marked else _colour(solid))
        faces.append(Faces(solid.frame, corners[keep], normals, colour, solid.is_ground))
    return tuple(faces)


def _colour(solid: Solid) -> str:
    if solid.is_ground:
        return GROUND
    colours = {"robot 1": ARMS[0], "robot 2": ARMS[1], "payload": PAYLOAD}
    return colours.get(solid.group, OBSTACLE)


def draw_cell(
    axes: Axes,
    cell: CutCell,
    view: View,
    pose: Array,
    q: Array,
    hidden: tuple[str, ...] = (),
) -> None:
    """Draw the cell at one sample: pose (6,), q (12,). hidden: kinds of frames left out."""
    placed = frame_placements(cell.geometry, pose[None], q[None])
    corners, colours = [], []
    ground_corners = []
    for part in cell.faces:
        if part.frame.kind in hidden:
            continue
        T = placed[part.frame][0]
        normals = part.normals @ T[:3, :3].T
        front = normals @ view.towards > 1e-9
        points = part.triangles[front] @ T[:3, :3].T + T[:3, 3]
        if part.is_ground:
            ground_corners.append(view.flat(points))
            continue
        shade = 0.62 + 0.38 * np.clip(normals[front] @ LIGHT, 0.0, 1.0)
        corners.append(points)
        colours.append(np.asarray(part.colour) * shade[:, None])
    if ground_corners:
        flat = np.concatenate(ground_corners)
        axes.add_collection(
            _polygons(flat, facecolors=GROUND, edgecolors=GROUND, zorder=1.0),
            autolim=False,
        )
    points, colour = np.concatenate(corners), np.concatenate(colours)
    order = np.argsort(points.mean(axis=1) @ view.towards)
    flat = view.flat(points[order])
    axes.add_collection(
        _polygons(
            flat,
            facecolors=colour[order],
            edgecolors=colour[order],
            linewidths=0.5,
            zorder=2.0,
            rasterized=True,
        ),
        autolim=False,
    )


def _polygons(flat: Array, **style: Any) -> PolyCollection:
    """Polygons (n, k, 2): one array is taken over faster than the sequence that the stubs name."""
    return PolyCollection(flat, **style)  # type: ignore[arg-type]


def draw_path(axes: Axes, view: View, points: Array, **style: object) -> None:
    """A line through world points (n, 3), above the bodies."""
    flat = view.flat(points)
    axes.plot(flat[:, 0], flat[:, 1], zorder=4.0, **style)  # type: ignore[arg-type]


def draw_box_edges(axes: Axes, view: View, lower: Array, upper: Array, **style: object) -> None:
    """The twelve edges of a box along the world axes."""
    flat = view.flat(box_corners(lower, upper))
    edges = [
        flat[[i, j]]
        for i in range(8)
        for j in range(i + 1, 8)
        if np.abs(np.subtract(_BITS[i], _BITS[j])).sum() == 1
    ]
    axes.add_collection(LineCollection(edges, zorder=5.0, **style), autolim=False)


_BITS = tuple((i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1))


def frame_axes(axes: Axes, view: View, points: Array, margin: float = 0.06) -> None:
    """Fit the limits to world points (n, 3) at equal scales; world axes get labels."""
    flat = view.flat(points)
    lower, upper = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    axes.set_xlim(lower[0], upper[0])
    axes.set_ylim(lower[1], upper[1])
    axes.set_aspect("equal")
    axes.grid(visible=False)
    if view.mirrored:
        axes.xaxis.set_major_formatter(_negated)
    if view.x_label:
        axes.set_xlabel(view.x_label)
        axes.set_ylabel(view.y_label)
    else:
        axes.set_axis_off()


def _negated(value: float, _: object) -> str:
    return f"{0.0 - value:g}".replace("-", "\N{MINUS SIGN}")


def aspect(view: View, points: Array) -> float:
    """Width over height of world points (n, 3) in a view."""
    width, height = np.ptp(view.flat(points), axis=0)
    return float(width / height)


def box_corners(lower: Array, upper: Array) -> Array:
    """(8, 3) corners of a box along the world axes."""
    return np.array([[(lower, upper)[k][a] for a, k in enumerate(bits)] for bits in _BITS])
