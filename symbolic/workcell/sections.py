"""Parts of a workcell file that need no robot model: poses, bodies, inertias, collision rules."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.physics.pose import pose_matrix
from symbolic.workcell import quantities as quantity
from symbolic.workcell.problems import shown
from symbolic.workcell.reader import Table, checked_vector, read_only
from symbolic.workcell.records import (
    Body,
    Box,
    CollisionSettings,
    Cylinder,
    IgnoredPair,
    Mesh,
    Shape,
    Sphere,
)

MOST_PIECES = 20_000
SHAPE_KINDS = ("box", "cylinder", "sphere", "mesh")


def read_pose(table: Table, key: str) -> Array:
    """A transform from a sub-table {xyz, rpy}, both zero by default. Returns (4, 4), read-only."""
    inner = table.table(key)
    pose = _xyz_rpy(inner)
    inner.close()
    return pose


def _xyz_rpy(table: Table) -> Array:
    xyz = table.vector("xyz", (quantity.POSITION,) * 3, default=(0.0, 0.0, 0.0))
    rpy = table.vector("rpy", (quantity.ANGLE,) * 3, default=(0.0, 0.0, 0.0))
    return read_only(pose_matrix(xyz, rpy))


def read_body(table: Table, folder: Path) -> Body:
    """A named collision shape with its pose; mesh paths are relative to `folder`."""
    name = table.text("name")
    kind = table.choice("kind", SHAPE_KINDS)
    pose = _xyz_rpy(table)
    shape: Shape = Sphere(1.0)
    if kind == "box":
        shape = Box(table.vector("size", (quantity.SHAPE_SIZE,) * 3))
    elif kind == "cylinder":
        shape = Cylinder(
            table.number("radius", quantity.SHAPE_SIZE), table.number("length", quantity.SHAPE_SIZE)
        )
    elif kind == "sphere":
        shape = Sphere(table.number("radius", quantity.SHAPE_SIZE))
    elif kind == "mesh":
        path = read_file(table, "path", folder, outside.MESH_BYTES)
        scale = table.vector("scale", (quantity.SCALE,) * 3, (1.0, 1.0, 1.0), scalar_fills=True)
        shape = Mesh(path, scale)
    if kind:  # without a kind nobody can say which keys are unknown
        table.close()
    return Body(name, shape, pose)


def read_file(table: Table, key: str, folder: Path, most: int) -> Path:
    """The absolute path of a file named relative to `folder`; it has to be readable.

    Args:
        table, key: where it is named.
        folder: what its path is relative to.
        most: its largest size [bytes].
    """
    value = table.raw(key)
    if value is None:
        return folder
    if not isinstance(value, str) or not value or "\0" in value:
        table.problems.add(table.at(key), f"found {shown(value)}; allowed is the path of a file")
        return folder
    try:
        path = outside.resolved(folder / value)
        outside.require(path, most)
    except OutsideError as error:
        table.problems.add(
            table.at(key),
            f"found {shown(value)}, which {error}; paths are relative to the workcell file",
        )
        return folder
    return path


def read_inertia(table: Table, bound: float, allowed: str = "a 3 x 3 matrix") -> Array:
    """The (3, 3) matrix of the key `inertia` [kg m^2], a rigid body's.

    Args:
        table: where it stands.
        bound: no principal moment can exceed this [kg m^2].
        allowed: what a message says is allowed.
    """
    value = table.raw("inertia")
    path, problems = table.at("inertia"), table.problems
    if not isinstance(value, list) or len(value) != 3:
        problems.add(path, f"found {shown(value)}; allowed is {allowed}")
        return read_only(np.eye(3))
    rows = [
        checked_vector(row, (quantity.INERTIA,) * 3, f"{path}[{index}]", problems)
        for index, row in enumerate(value)
    ]
    inertia = read_only(np.stack(rows))
    if problems.clean(path):
        problem = inertia_problem(inertia, bound)
        if problem:
            problems.add(path, problem)
    return inertia


def inertia_problem(inertia: Array, bound: float) -> str:
    """Why a matrix is no inertia of a rigid body, or an empty string.

    Args:
        inertia: (3, 3) [kg m^2].
        bound: no principal moment can exceed this [kg m^2].
    """
    scale = float(np.abs(inertia).max())
    if np.abs(inertia - inertia.T).max() > 1e-9 * scale:
        return "found a matrix that is not symmetric; an inertia is symmetric"
    moments = np.linalg.eigvalsh(inertia)
    listed = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= 1e-9 * scale:
        return (
            f"found principal moments {listed} kg m^2, which is singular or not positive "
            "definite; allowed are only positive ones"
        )
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        return (
            f"found principal moments {listed} kg m^2; no body has them: each is at most the "
            "sum of the other two"
        )
    if moments[2] > bound:
        return (
            f"found a principal moment of {moments[2]:.6g} kg m^2; mass inside the box gives at "
            f"most {bound:.6g} kg m^2 (are the units kg m^2, about the centre of mass?)"
        )
    return ""


def read_collision(table: Table) -> CollisionSettings:
    """How collisions are judged."""
    tolerance = table.number("tolerance", quantity.TOLERANCE, 0.0)
    most_pieces = table.integer("most_pieces", 1, MOST_PIECES, CollisionSettings().most_pieces)
    ignored = []
    for entry in table.tables("ignored"):
        pair = IgnoredPair(entry.text("first"), entry.text("second"), entry.text("reason"))
        entry.close()
        # A pattern may stand against itself: all bodies that it matches against one another.
        if pair.first and pair.first == pair.second and not set(pair.first) & {"*", "?"}:
            entry.problems.add(entry.path, f"pairs {pair.first!r} with itself")
        ignored.append(pair)
    table.close()
    return CollisionSettings(tolerance, tuple(ignored), most_pieces)
