"""Convex pieces of a cell's shapes; meshes are read and cut once."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.pieces import Capsule, Hull, Piece
from symbolic.workcell.records import Mesh, Shape


class MeshReader:
    """The meshes of one cell: each is read and cut once, within `MOST_CELL_FACES` together."""

    def __init__(self) -> None:
        self._known: dict[tuple[Path, tuple[float, ...]], tuple[Hull, ...]] = {}
        self._triangles = 0

    def hulls(self, mesh: Mesh) -> tuple[Hull, ...]:
        """The convex pieces of a mesh.

        Raises:
            CollisionModelError: see `symbolic.geometry.meshes.read_mesh`; and all meshes so far
                have too many triangles.
        """
        # Not imported at the top: trimesh takes long to start, and most cells have no meshes.
        from symbolic.geometry.meshes import MOST_CELL_FACES

        key = (mesh.path, tuple(mesh.scale))
        if key not in self._known:
            hulls, faces = _cut_file(*key, _state(mesh.path))
            self._triangles += faces
            if self._triangles > MOST_CELL_FACES:
                raise CollisionModelError(
                    f"{mesh.path}: with its {faces} triangles the cell's meshes have "
                    f"{self._triangles}; allowed are {MOST_CELL_FACES} together: simplify the "
                    "largest"
                )
            self._known[key] = hulls
        return self._known[key]


def _state(path: Path) -> tuple[int, int]:
    """Changes where a file does; zero where it cannot be asked, which reading it then tells."""
    try:
        found = path.stat()
    except OSError:
        return (0, 0)
    return (found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=64)
def _cut_file(
    path: Path, scale: tuple[float, ...], state: tuple[int, int]
) -> tuple[tuple[Hull, ...], int]:
    """The convex pieces of a mesh file and its number of triangles.

    Kept beyond one cell: what tries a cell out reads its robots several times.
    """
    from symbolic.geometry.meshes import cut, read_mesh

    mesh = read_mesh(path, np.array(scale))
    return cut(mesh, path), len(mesh.faces)


def shape_pieces(
    shape: Shape | Capsule, pose: Array, owner: str, meshes: MeshReader
) -> tuple[Piece, ...]:
    """The convex pieces of a shape at a pose (4, 4)."""
    if not isinstance(shape, Mesh):
        return (Piece(shape, pose),)
    try:
        return tuple(Piece(hull, pose) for hull in meshes.hulls(shape))
    except CollisionModelError as error:
        raise CollisionModelError(f"{owner}: {error}") from error
