"""The bodies of a cell as triangle meshes, and their poses along a carry.

Meshes of simple shapes are computed here, because the library trimesh, which reads mesh files,
takes longer to load than a picture to draw.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.geometry.bodies import ArmGeometry, Frame
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import ConvexShape, Hull, box_corners
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.content import CacheKey
from symbolic.records.poses import box_placement, rotation_from_vector

SECTIONS = 24
"""Facets around a cylinder."""

GROUND_SIZE = 2.5
"""Fixed bodies that are at least this long and wide count as ground and are drawn behind everything
[m]."""


@dataclass(frozen=True)
class Solid:
    """A collision body as a triangle mesh.

    Attributes:
        name, group: name and group of the collision body.
        frame: frame to which the body is fixed, and in which its vertices are given.
        vertices: (n, 3) vertices [m].
        faces: (m, 3) indices of the three vertices of each triangle, with outward normals.
        is_ground: True if the body is a large plate fixed in the world.
    """

    name: str
    group: str
    frame: Frame
    vertices: Array
    faces: NDArray[np.int64]
    is_ground: bool


def cell_solids(geometry: CellGeometry) -> tuple[Solid, ...]:
    """Convert every collision body of a cell to a triangle mesh."""
    return tuple(_triangles(CacheKey(body, known=body.content)) for body in geometry.bodies)


@lru_cache(maxsize=256)
def _triangles(seen: CacheKey) -> Solid:
    (body,) = seen.given
    meshes = [_mesh(piece.shape) for piece in body.pieces]
    vertices = np.concatenate(
        [
            points @ piece.rotation.T + piece.centre
            for piece, (points, _) in zip(body.pieces, meshes, strict=True)
        ]
    )
    first = np.cumsum([0, *(len(points) for points, _ in meshes)])
    faces = np.concatenate([f + k for (_, f), k in zip(meshes, first[:-1], strict=True)])
    extent = np.sort(np.ptp(vertices, axis=0))[::-1]
    ground = body.frame.kind == "world" and bool(extent[1] >= GROUND_SIZE)
    for values in (vertices, faces):
        values.setflags(write=False)
    return Solid(body.name, body.group, body.frame, vertices, faces, ground)


def _mesh(shape: ConvexShape) -> tuple[Array, NDArray[np.int64]]:
    """Compute the triangle mesh of a convex shape.

    Returns:
        Vertices (n, 3) in the frame of the shape [m], and faces (m, 3) as vertex indices, with
        outward normals.
    """
    match shape:
        case Box():
            return box_corners(shape.size), _BOX_FACES
        case Hull():
            return shape.vertices, shape.faces
        case Cylinder():
            across = np.array([0.0, shape.radius, shape.radius, 0.0])
            along = shape.length / 2.0 * np.array([-1.0, -1.0, 1.0, 1.0])
        case Sphere():
            angles = np.linspace(-np.pi / 2.0, np.pi / 2.0, SECTIONS // 2 + 1)
            across, along = shape.radius * np.cos(angles), shape.radius * np.sin(angles)
        case Capsule():
            half = np.linspace(0.0, np.pi / 2.0, SECTIONS // 4 + 1)
            above = shape.radius * np.sin(half) + shape.length / 2.0
            across = shape.radius * np.cos(np.concatenate([half[::-1], half]))
            along = np.concatenate([-above[::-1], above])
    return _revolved(across, along)


_BOX_FACES = np.array(
    [
        *([1, 3, 0], [4, 1, 0], [0, 3, 2], [2, 4, 0], [1, 7, 3], [5, 1, 4]),
        *([5, 7, 1], [3, 7, 2], [6, 4, 2], [2, 7, 6], [6, 5, 4], [7, 5, 6]),
    ]
)
"""Faces of a box as indices of the corners of `box_corners`."""


def _revolved(across: Array, along: Array) -> tuple[Array, NDArray[np.int64]]:
    """Compute the triangle mesh of a curve rotated about z.

    Args:
        across: (n,) distances of the curve's points from the z axis [m]; zero at both ends.
        along: (n,) positions of the points along z [m], from the lower to the upper end.

    Returns:
        Vertices (k, 3) [m], and faces (m, 3) as vertex indices, with outward normals.
    """
    rings, angles = len(across) - 2, np.linspace(0.0, 2.0 * np.pi, SECTIONS + 1)[:-1]
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.ones(SECTIONS)])
    scales = np.column_stack([across, across, along])[1:-1]
    ends = np.zeros((2, 3))
    ends[:, 2] = along[[0, -1]]
    vertices = np.concatenate([ends[:1], (scales[:, None] * circle).reshape(-1, 3), ends[1:]])
    here = np.zeros((rings + 2, SECTIONS), dtype=np.int64)
    here[1:-1] = 1 + np.arange(rings * SECTIONS).reshape(rings, SECTIONS)
    here[-1] = len(vertices) - 1
    there = np.roll(here, -1, axis=1)
    lower = np.stack([here[:-1], there[:-1], here[1:]], axis=-1)
    upper = np.stack([here[1:], there[:-1], there[1:]], axis=-1)
    # At either end one triangle of every pair is a line.
    faces = np.stack([lower, upper], axis=1).reshape(-1, SECTIONS, 3)[1:-1]
    return vertices, np.swapaxes(faces, 0, 1).reshape(-1, 3)


def joint_placements(arm: ArmGeometry, q: Array) -> Array:
    """Compute the poses of an arm's joint frames in the world.

    Args:
        arm: geometry of the arm.
        q: (n, n_joints) joint positions [rad or m].

    Returns:
        Transforms (n, n_joints, 4, 4) from each joint frame to the world frame.
    """
    placed = np.empty((*q.shape, 4, 4))
    T = np.broadcast_to(arm.T_world_root, (len(q), 4, 4))
    for j in range(q.shape[1]):
        moved = np.tile(np.eye(4), (len(q), 1, 1))
        along = np.outer(q[:, j], arm.axes[j])
        if arm.turning[j]:
            moved[:, :3, :3] = rotation_from_vector(along)
        else:
            moved[:, :3, 3] = along
        T = T @ arm.origins[j] @ moved
        placed[:, j] = T
    return placed


def frame_placements(geometry: CellGeometry, pose: Array, q: Array) -> dict[Frame, Array]:
    """Compute the poses of the world, the box and all links of both arms in the world at n samples.

    Args:
        geometry: bodies of the cell.
        pose: (n, 6) box poses [m, rad].
        q: (n, all joints) joint positions of both arms side by side [rad].

    Returns:
        Transforms (n, 4, 4) to the world frame, by frame.
    """
    placed = {
        Frame("world"): np.broadcast_to(np.eye(4), (len(pose), 4, 4)),
        Frame("box"): box_placement(geometry.workcell.task.orientation, pose),
    }
    first = 0
    for i, arm in enumerate(geometry.arms):
        count = len(arm.axes)
        joints = joint_placements(arm, q[:, first : first + count])
        placed |= {Frame("link", i, j): joints[:, j] for j in range(count)}
        first += count
    return placed


def extent_points(
    geometry: CellGeometry, solids: tuple[Solid, ...], pose: Array, q: Array
) -> Array:
    """Compute the corners (k, 3) of the bounding boxes of solids at n samples, world frame [m].
    Ground plates are left out.

    A picture that shows these points shows the whole scene.

    Args:
        geometry: bodies of the cell.
        solids: the solids.
        pose: (n, 6) box poses [m, rad].
        q: (n, all joints) joint positions of both arms side by side [rad].
    """
    placed = frame_placements(geometry, pose, q)
    points = []
    for solid in solids:
        if solid.is_ground:
            continue
        lower, upper = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
        corners = np.array(list(product(*zip(lower, upper, strict=True))))
        T = placed[solid.frame]
        moved = corners @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        points.append(moved.reshape(-1, 3))
    return np.concatenate(points)


_VIEWED = 12
"""Approximate number of samples of a carry from which the viewpoint of a scene is chosen."""


def motion_points(geometry: CellGeometry, pose: Array, q: Array, moving: bool = False) -> Array:
    """Compute points (k, 3) that a picture of a whole motion has to show, world frame [m].

    Args:
        geometry: bodies of the cell.
        pose: (n, 6) box poses [m, rad].
        q: (n, all joints) joint positions of both arms side by side [rad].
        moving: True to consider arms and payload only, False for all bodies but the ground.
    """
    every = slice(None, None, max(1, len(pose) // _VIEWED))
    solids = cell_solids(geometry)
    if moving:
        solids = tuple(solid for solid in solids if solid.frame.kind != "world")
    return extent_points(geometry, solids, pose[every], q[every])
