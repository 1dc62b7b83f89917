"""Closed meshes cut into few convex pieces that fill them well."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from symbolic.array import Array
from symbolic.geometry.pieces import Hull

CUTS = np.linspace(0.125, 0.875, 7)
"""Where planes are tried, as fractions of a part's extent."""


MOST_PIECES = 8
"""Most convex pieces per connected component."""


WORTHWHILE = 0.05
"""A cut is made if it removes at least this part of the component's hull volume."""


def hull_of(points: Array) -> Hull:
    """The convex hull of points, its faces turned outwards."""
    hull = ConvexHull(points.reshape(-1, 3))
    vertices = hull.points[hull.vertices]
    index = np.full(len(hull.points), -1)
    index[hull.vertices] = np.arange(len(hull.vertices))
    faces = index[hull.simplices]
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    vertices.setflags(write=False)
    faces.setflags(write=False)
    return Hull(vertices, faces)


def decompose(triangles: Array, solid: float) -> list[Hull]:
    """Cut greedily, always the part whose best cut removes the most empty volume.

    Args:
        triangles: (n, 3, 3) of a watertight surface.
        solid: the volume that it encloses [m^3].
    """
    whole = hull_volume(triangles)
    if whole - solid < WORTHWHILE * whole:
        return [hull_of(triangles)]
    parts = [(triangles, *_best_cut(triangles))]
    while len(parts) < MOST_PIECES:
        k = int(np.argmax([gain for _, gain, _ in parts]))
        _, gain, halves = parts[k]
        if gain < WORTHWHILE * whole:
            break
        parts[k : k + 1] = [(half, *_best_cut(half)) for half in halves]
    return [hull_of(part) for part, _, _ in parts]


def hull_volume(triangles: Array) -> float:
    """Volume of the convex hull; zero where it is flat."""
    try:
        return float(ConvexHull(triangles.reshape(-1, 3)).volume)
    except (QhullError, ValueError):
        return 0.0


def _best_cut(triangles: Array) -> tuple[float, tuple[Array, ...]]:
    """The gain [m^3] of the best plane across a coordinate axis, and the two halves."""
    volume = hull_volume(triangles)
    lower, upper = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    best: tuple[float, tuple[Array, ...]] = (0.0, ())
    for axis in range(3):
        for level in lower[axis] + CUTS * (upper[axis] - lower[axis]):
            halves = (_clip(triangles, axis, level, 1.0), _clip(triangles, axis, level, -1.0))
            gain = volume - sum(hull_volume(half) for half in halves)
            if gain > best[0]:
                best = (gain, halves)
    return best


def _clip(triangles: Array, axis: int, level: float, side: float) -> Array:
    """The parts of triangles (n, 3, 3) where side * (coordinate - level) >= 0, as triangles."""
    height = side * (triangles[:, :, axis] - level)
    inside = height >= 0.0
    count = inside.sum(axis=1)
    kept = [triangles[count == 3]]
    for lone_is_inside, chosen in ((True, count == 1), (False, count == 2)):
        lone = np.argmax(inside[chosen] == lone_is_inside, axis=1)
        order = (lone[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles[chosen], order[:, :, None], 1), 1, 0)
        ha, hb, hc = np.take_along_axis(height[chosen], order, 1).T[:, :, None]
        ab, ac = a + ha / (ha - hb) * (b - a), a + ha / (ha - hc) * (c - a)
        if lone_is_inside:
            kept.append(np.stack([a, ab, ac], axis=1))
        else:
            kept += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
    return np.concatenate(kept)
