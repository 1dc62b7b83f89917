"""Triangle meshes from files, with bounds on size and content."""

from __future__ import annotations

import logging
import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
import trimesh

from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import CollisionModelError, OutsideError
from symbolic.records.quantities import SMALLEST_SIZE

FORMATS = ("stl", "dae", "obj", "ply", "off")
"""Mesh formats that are read. None of them needs another file. Lengths are in metres, except in
COLLADA (dae), which states its unit; as in ROS, its up axis is not rotated."""

MOST_FACES = 100_000
MOST_CELL_FACES = 200_000
"""Largest number of triangles of one mesh, and of all meshes of a cell together. Cutting takes
about 0.1 ms per triangle, and collision shapes are simplified shapes."""

MOST_WORDS = {"obj": 2_000_000, "off": 2_000_000, "ply": 800_000}
"""Largest number of words of a text mesh, by format. The parser keeps all words, with 100 bytes
each, 300 for PLY. A mesh of `MOST_FACES` has fewer."""

MOST_MARKS = 500_000
"""Largest number of elements and attributes of a COLLADA mesh."""

LARGEST_EXTENT = 100.0
"""Largest extent and coordinate of a mesh [m]. A larger mesh is usually in millimetres without its
scale."""


# What it has to say is in the errors below; its log would add tracebacks on the terminal.
trimesh.util.log.setLevel(logging.CRITICAL)


def read_mesh(path: Path, scale: Array) -> trimesh.Trimesh:
    """Read a triangle mesh, scale it, and merge equal vertices.

    Args:
        path: the file.
        scale: (3,) scale factors along x, y and z.

    Raises:
        CollisionModelError: the file cannot be read, or is empty, flat, too large or too fine.
    """
    try:
        return _sound(_read(path), np.asarray(scale, dtype=float))
    except OutsideError as error:
        raise CollisionModelError(f"{path}: {error}") from error


def _sound(mesh: trimesh.Trimesh, scale: Array) -> trimesh.Trimesh:
    """Return a mesh multiplied by the factors `scale` (3,), in metres and with equal vertices
    merged.

    Raises:
        OutsideError: the mesh is not finite, exceeds a limit or is flat.
    """
    if not np.all(np.isfinite(mesh.vertices)):
        raise OutsideError("the mesh has vertices that are not finite numbers", code="not-finite")
    _require_few(len(mesh.faces), MOST_FACES, "triangles")
    with np.errstate(over="ignore"):
        mesh.vertices = np.asarray(mesh.vertices, dtype=float) * (scale * _collada_unit(mesh))
        largest = np.abs(mesh.vertices).max()
    if np.prod(np.sign(scale)) < 0.0:
        mesh.faces = mesh.faces[:, ::-1]
    if not largest <= LARGEST_EXTENT:
        raise OutsideError(
            f"enormous mesh, {largest:g} m from its origin; at most {LARGEST_EXTENT:g} m is "
            "allowed: is the file in millimetres? Set its scale",
            code="mesh-too-far",
        )
    extents = np.ptp(mesh.vertices, axis=0)
    if extents.min() < SMALLEST_SIZE:
        raise OutsideError(
            f"the mesh is flat, extents {np.round(extents, 9).tolist()} m; give it a thickness or "
            "use a box",
            code="flat-mesh",
        )
    mesh.merge_vertices()
    return mesh


def _require_few(count: int, most: int, meaning: str) -> None:
    if count > most:
        raise OutsideError(
            f"enormous mesh, {count} {meaning}; at most {most} are allowed: simplify it for "
            "collision checking",
            code="mesh-too-large",
        )


def _read(path: Path) -> trimesh.Trimesh:
    """Read the triangles of a mesh file in the file's unit. It is not checked here whether they are
    finite, flat or too large.

    Raises:
        OutsideError: the file cannot be read as a mesh, has too many words or elements, is empty,
            or its faces are not triangles.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise OutsideError(
            f"cannot be read as a mesh; allowed are the formats {', '.join(FORMATS)}",
            code="mesh-format",
        )
    try:
        content = safe_io.read_bytes(path, safe_io.MESH_BYTES)
        if kind == "dae":
            safe_io.xml_text(content)
    except OutsideError as error:
        raise OutsideError(f"the mesh {error}") from error
    if kind == "dae":
        # A meshful of attributes is one element too; its numbers are text in few elements.
        marks = content.count(b"<") + content.count(b"=")
        _require_few(marks, MOST_MARKS, "elements and attributes")
    elif _is_text(kind, content):
        _require_few(_gaps(content), MOST_WORDS[kind], "words")
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            mesh = trimesh.load_mesh(BytesIO(content), file_type=kind, process=False)
            if isinstance(mesh, trimesh.Scene):
                mesh = mesh.to_mesh()
    except Exception as error:  # trimesh raises whatever its many readers raise
        said = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise OutsideError(
            f"cannot be read as a mesh ({said}); give an STL, DAE, OBJ or PLY file",
            code="mesh-format",
        ) from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise OutsideError("the mesh is empty; export triangles", code="empty-mesh")
    corners = mesh.vertices.shape[1:] == (3,) and mesh.faces.shape[1:] == (3,)
    if not corners or mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise OutsideError("the mesh is not made of triangles with three corners of its own")
    return mesh


def _is_text(kind: str, content: bytes) -> bool:
    """Return True if the reader of a mesh format splits the file into words, whose number has to be
    limited: for OBJ, OFF and PLY in text form.

    An STL text counts as False, since only its numbers are parsed.

    Args:
        kind: format of the file, such as 'obj'.
        content: content of the file.
    """
    second = content[:1000].split(b"\n", 2)[1:2]
    return kind in ("obj", "off") or (kind == "ply" and b"binary" not in b"".join(second).lower())


def _gaps(content: bytes) -> int:
    """Compute an upper bound of the number of words of a text, without splitting it: the number of
    bytes that are spaces, control characters or not ASCII."""
    letters = np.frombuffer(content, np.uint8)
    return int(np.count_nonzero((letters <= 32) | (letters >= 128)))


def _collada_unit(mesh: trimesh.Trimesh) -> float:
    """Return the metres per unit of a COLLADA file. trimesh reports '0.01 * meters' without
    applying it."""
    factor, _, unit = str(mesh.units or "").partition(" * ")
    return float(factor) if unit == "meters" else 1.0
