"""Decomposition of triangle meshes into convex hulls whose union contains the mesh.

A watertight component is cut by planes if that makes the hulls of its parts markedly smaller. The
hull of a part contains the part's surface and the outline of the cut, hence also the cap that
closes the part. So the union of the hulls contains the solid. A component with holes has no inside,
so the hull of the whole component is used; a warning follows if closing the holes might give
smaller hulls. Finally `simplify` joins hulls and removes corners, always outwards. CoACD and V-HACD
are not used: they remesh or voxelise first, and promise no containment.
"""

from __future__ import annotations

import warnings
from itertools import product
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from symbolic.array import Array
from symbolic.errors import CollisionModelError, DualArmWarning
from symbolic.geometry.pieces import CutMesh, Hull
from symbolic.read.meshes import read_mesh
from symbolic.records.quantities import SMALLEST_SIZE


class CollisionModelWarning(DualArmWarning):
    """A collision shape is used in a coarser form than the file describes."""


_TOLD: dict[str | tuple[str, type[Warning], int], int] = {}
"""What Python's warnings remember, so that each is shown once."""


def convex_pieces(path: Path, scale: Array) -> tuple[Hull, ...]:
    """Decompose a mesh file into convex hulls, in the mesh's frame, whose union contains the mesh.

    Args:
        path: a file in one of `FORMATS`.
        scale: (3,) scale factors along x, y and z.

    Raises:
        CollisionModelError: the mesh cannot be read, is empty, flat or too large, has non-finite
            vertices, or a part of it has no convex hull.
    """
    return cut(read_mesh(path, scale), path).hulls


def cut(mesh: trimesh.Trimesh, path: Path) -> CutMesh:
    """Decompose a mesh into few convex hulls whose union contains the mesh.

    Args:
        mesh: mesh from `read_mesh` [m].
        path: file of the mesh, for messages.

    Raises:
        CollisionModelError: a part of the mesh has no convex hull.
    """
    pieces: list[Hull] = []
    open_components = coarse_components = 0
    large, small = _parts(mesh)
    try:
        for component in large:
            triangles = np.asarray(component.triangles, dtype=float)
            filled = hull_volume(triangles)
            if component.is_watertight and component.is_winding_consistent and filled > 0.0:
                pieces.extend(decompose(triangles, abs(float(component.volume))))
            else:
                open_components += 1
                coarse_components += _may_be_cut(triangles, filled)
                pieces.append(hull_of(triangles if filled > 0.0 else _thickened(triangles)))
        if len(small):
            joined = np.vstack([mesh.triangles[faces] for faces in small])
            pieces.append(hull_of(_thickened(joined)))
        hulls = simplify(pieces)
    except QhullError as error:
        raise CollisionModelError(
            f"{path}: a part of the mesh has no convex hull; remove triangles that are points or "
            "lines"
        ) from error
    if coarse_components:
        _warn(
            path,
            f"{coarse_components} part(s) of the mesh {path.name} are not watertight; the convex "
            "hull of each is used as its collision shape. Close the holes to get a tighter shape",
        )
    if len(small):
        _warn(
            path,
            f"the mesh {path.name} has {len(large) + len(small)} separate parts; one convex hull "
            f"around the {len(small)} smallest is used as their collision shape. Remove screws and "
            "the like to get a tighter shape",
        )
    parts = len(large) + len(small)
    return CutMesh(hulls, len(mesh.faces), len(mesh.vertices), parts, open_components)


def _may_be_cut(triangles: Array, filled: float) -> bool:
    """Return True if a component of a mesh is used as one hull only because its surface has holes:
    `decompose` might cut it once they are closed.

    If the result is False, `decompose` certainly would not cut it, because triangles that close a
    hole only enlarge the hulls of both halves of a cut.

    Args:
        triangles: (n, 3, 3) corners of the component's triangles [m].
        filled: volume of the component's hull [m^3].
    """
    if np.all(np.ptp(triangles, axis=(0, 1)) <= SMALL_PART):
        return False
    return bool(filled > 0.0 and _best_cut(triangles)[0] >= WORTHWHILE * filled)


def _warn(path: Path, text: str) -> None:
    """Warn once about the mesh at `path`, with a text that says how to correct it."""
    warnings.warn_explicit(
        text, CollisionModelWarning, filename=path.name, lineno=0, registry=_TOLD
    )


MOST_PARTS = 400
"""Most connected components of a mesh that become convex pieces of their own; of a mesh with more
only `LARGE_PARTS` do."""

LARGE_PARTS = 24
"""Largest components of a mesh of many that keep convex pieces of their own."""


def _parts(mesh: trimesh.Trimesh) -> tuple[list[trimesh.Trimesh], list[NDArray[np.intp]]]:
    """Split a mesh into its connected components. If there are many, only the largest are kept as
    components.

    Returns:
        Components that become hulls of their own, as meshes; and the remaining small components,
        each as an array of face indices.
    """
    nodes = np.arange(len(mesh.faces))
    parts = list(trimesh.graph.connected_components(mesh.face_adjacency, nodes=nodes, min_len=1))
    large = len(parts)
    if large > MOST_PARTS:
        extent = [np.ptp(mesh.triangles[faces].reshape(-1, 3), axis=0).max() for faces in parts]
        parts = [parts[k] for k in np.argsort(extent, kind="stable")[::-1]]
        large = LARGE_PARTS
    found = mesh.submesh(parts[:large], only_watertight=False, repair=False)
    assert isinstance(found, list), "parts that are not appended to one another are a list"
    return found, parts[large:]


def _thickened(triangles: Array) -> Array:
    """Return the corners of a flat surface, each moved by `SMALLEST_SIZE` in both directions along
    every axis, so that they span a volume.

    Args:
        triangles: corners of the surface's triangles, any shape (..., 3) [m].

    Returns:
        (n, 6, 3) six points for each of the n corners [m].
    """
    steps = SMALLEST_SIZE * np.concatenate([np.eye(3), -np.eye(3)])
    return np.asarray(triangles.reshape(-1, 1, 3) + steps, dtype=float)


# --- convex decomposition ---


CUTS = np.linspace(0.125, 0.875, 7)
"""Where planes are tried, as fractions of a part's extent."""


MOST_PIECES = 8
"""Most convex pieces per connected component."""


WORTHWHILE = 0.05
"""A cut is made if it removes at least this part of the component's hull volume."""


def hull_of(points: Array) -> Hull:
    """Compute the convex hull of points (..., 3) [m], with faces oriented outwards."""
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
    """Cut a closed surface by planes into parts, and return the convex hull of each part.

    Each step cuts the part whose best cut reduces the total volume of the hulls most.

    Args:
        triangles: (n, 3, 3) corners of the triangles of a watertight surface [m].
        solid: volume inside the surface [m^3].
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


def hull_volume(points: Array) -> float:
    """Compute the volume [m^3] of the convex hull of points (..., 3) [m]; 0 for a flat hull."""
    try:
        return float(ConvexHull(points.reshape(-1, 3)).volume)
    except (QhullError, ValueError):
        return 0.0


def _best_cut(triangles: Array) -> tuple[float, tuple[Array, ...]]:
    """Find the plane, perpendicular to a coordinate axis, at which a cut reduces the total volume
    of the hulls most.

    Args:
        triangles: (n, 3, 3) corners of triangles [m].

    Returns:
        The reduction [m^3], and the triangles of both halves; (0, ()) if no plane reduces the
        volume.
    """
    points = np.unique(triangles.reshape(-1, 3), axis=0)  # most corners belong to six triangles
    volume = hull_volume(points)
    lower, upper = points.min(axis=0), points.max(axis=0)
    best, plane = 0.0, (0, 0.0)
    for axis in range(3):
        for level in lower[axis] + CUTS * (upper[axis] - lower[axis]):
            halves = (_corners(points, triangles, axis, level, side) for side in (1.0, -1.0))
            gain = volume - sum(hull_volume(half) for half in halves)
            if gain > best:
                best, plane = gain, (axis, level)
    return best, tuple(_clip(triangles, *plane, side) for side in (1.0, -1.0) if best > 0.0)


def _corners(points: Array, triangles: Array, axis: int, level: float, side: float) -> Array:
    """Return the points (k, 3) [m] that span the hull of `_clip`, with the arguments of it.

    Args:
        points: (m, 3) corners of the triangles, each once [m].
    """
    inside = side * (triangles[:, :, axis] - level) >= 0.0
    crossed = triangles[inside.any(axis=1) & ~inside.all(axis=1)]
    own = points[side * (points[:, axis] - level) >= 0.0]
    return np.vstack([own, _clip(crossed, axis, level, side).reshape(-1, 3)])


def _clip(triangles: Array, axis: int, level: float, side: float) -> Array:
    """Cut triangles at a plane and return the triangles on one side, (m, 3, 3) [m].

    Args:
        triangles: (n, 3, 3) corners [m].
        axis: index of the coordinate axis to which the plane is perpendicular.
        level: coordinate of the plane [m].
        side: 1 for the side of larger coordinates, -1 for the other side.
    """
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


# --- simplification ---


STAND_OUT = 1e-4
"""How far a simplified hull may stand out from those that it replaces [m]."""


SMALL_PART = 0.01
"""Hulls that fit into a cube of this edge together share one hull [m]."""


THINNED_SHARE = 0.75
"""A hull is thinned if at most this share of its corners is left."""


ROUNDOFF = 1e-12
"""How far beyond a plane a point counts as on it [m]."""


START_DIRECTIONS = np.array([u for u in product((-1.0, 0.0, 1.0), repeat=3) if any(u)])
"""The corners that are farthest along these are kept by any thinning."""


def simplify(hulls: list[Hull]) -> tuple[Hull, ...]:
    """Return fewer hulls with fewer corners, whose union contains all given hulls.

    A hull inside another hull is dropped. Two hulls are merged into their common hull if the
    smaller one stands out from the larger one by at most `STAND_OUT`, or if both fit into a cube
    with the edge `SMALL_PART`. Then corners of each hull are removed (`thin`).
    """
    kept: dict[int, _Growth] = {}
    volumes = [hull_volume(hull.vertices[hull.faces]) for hull in hulls]
    for k in np.argsort(volumes, kind="stable")[::-1].tolist():
        corners = hulls[k].vertices
        if any(other.hull_contains(corners) for other in kept.values()):
            continue
        host = next((key for key, other in kept.items() if other.takes_in(corners)), None)
        if host is None:
            kept[k] = _Growth(hulls[k])
        else:
            both = np.concatenate([kept[host].hull.vertices, corners])
            kept[host] = _Growth(hull_of(both))
    return tuple(thin(kept[k].hull) for k in sorted(kept))


def thin(hull: Hull) -> Hull:
    """Return a hull with fewer corners that contains `hull` and exceeds it by at most `STAND_OUT`.

    Corners of `hull` are selected until the convex hull of the selected ones, stretched by
    `_Growth`, contains all corners of `hull`. This stretched hull is the result. If it needs more
    than `THINNED_SHARE` of the corners, `hull` itself is returned.
    """
    growth, corners = _Growth(hull), hull.vertices
    seeds = np.unique(np.argmax(corners @ growth.axes @ START_DIRECTIONS.T, axis=0))
    kept, most = seeds, THINNED_SHARE * len(corners)
    while len(kept) <= most:
        try:
            planes = ConvexHull(corners[kept]).equations
        except QhullError:  # the kept corners are in a plane
            return hull
        open_faces = [face for face in planes if _beyond(growth.preimage, face[None])]
        if not open_faces:
            found = hull_of(growth.moved(corners[kept]))
            return found if _Growth(found).hull_contains(corners) else hull
        along = corners @ np.array(open_faces)[:, :3].T
        more = np.union1d(kept, np.argmax(along, axis=0))
        if len(more) == len(kept):
            return hull
        kept = more
    return hull


class _Growth:
    """A linear map that stretches a hull about its middle, along its principal axes.

    The map moves every face outwards, and no point of the hull farther than `STAND_OUT`.

    Attributes:
        hull: the hull.
        planes: (n, 4) outward unit normal and offset [m] of each face.
        axes: (3, 3) principal axes of the hull's corners, as columns.
        preimage: (m, 3) points that the map moves to the hull's m corners [m].
    """

    def __init__(self, hull: Hull) -> None:
        corners = hull.vertices
        self.hull = hull
        self.planes = ConvexHull(corners).equations
        _, self.axes = np.linalg.eigh(np.cov(corners.T))
        along = corners @ self.axes
        self._middle = self.axes @ (along.min(axis=0) + along.max(axis=0)) / 2.0
        off = (corners - self._middle) @ self.axes
        shares = off / np.abs(off).max(axis=0)
        longest = np.linalg.norm(shares, axis=1).max()
        self._factors = 1.0 + STAND_OUT / longest / np.abs(off).max(axis=0)
        self.preimage = self._stretched(corners, 1.0 / self._factors)

    def moved(self, points: Array) -> Array:
        """Stretch points (n, 3) by this map, in the frame of the hull [m]."""
        return self._stretched(points, self._factors)

    def hull_contains(self, points: Array) -> bool:
        """Return True if the hull itself, without stretching, contains all points (n, 3) [m]."""
        return not _beyond(points, self.planes)

    def takes_in(self, points: Array) -> bool:
        """Return True if this hull and another hull may be replaced by one hull around both.

        This holds if the stretched hull contains the other hull, or if both together fit into a
        cube with the edge `SMALL_PART`.

        Args:
            points: (n, 3) corners of the other hull [m].
        """
        both = np.stack([points.min(axis=0), self.hull.vertices.min(axis=0)])
        high = np.maximum(points.max(axis=0), self.hull.vertices.max(axis=0))
        if np.all(high - both.min(axis=0) <= SMALL_PART):
            return True
        return self.hull_contains(self._stretched(points, 1.0 / self._factors))

    def _stretched(self, points: Array, factors: Array) -> Array:
        off = (points - self._middle) @ self.axes
        return np.asarray(self._middle + (off * factors) @ self.axes.T)


def _beyond(points: Array, planes: Array) -> bool:
    """Return True if any of several points lies on the outer side of any of several planes.

    Args:
        points: (n, 3) points x [m].
        planes: (m, 4) outward unit normal u (3,) and offset d [m] of each plane; u . x + d > 0
            outside.
    """
    return bool(np.any(points @ planes[:, :3].T + planes[:, 3] > ROUNDOFF))
