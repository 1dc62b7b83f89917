"""The payload section of a workcell file: a box, a cylinder or a mesh, and its mass."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.workcell import quantities as quantity
from symbolic.workcell.reader import Table, read_only
from symbolic.workcell.records import Cylinder, Mesh, Payload
from symbolic.workcell.sections import read_file, read_inertia

KINDS = ("box", "cylinder", "mesh")


@dataclass(frozen=True)
class _Solid:
    """A homogeneous payload of its shape.

    Attributes:
        size: (3,) edge lengths of the box about the frame that holds it [m].
        shape: None for that box itself.
        centre: (3,) centre of mass [m].
        inertia: (3, 3) about it [kg m^2].
    """

    size: Array
    shape: Cylinder | Mesh | None
    centre: Array
    inertia: Array


def read_payload(table: Table, folder: Path) -> Payload:
    """What is carried; a mesh's path is relative to `folder`."""
    problems = table.problems
    kind = table.choice("kind", KINDS, "box")
    mass = table.number("mass", quantity.MASS)
    if kind == "mesh":
        solid = _mesh(table, folder, mass)
    else:
        solid = _cylinder(table, mass) if kind == "cylinder" else _box(table, mass)
    size = solid.size
    centre = table.vector(
        "centre_of_mass", (quantity.POSITION,) * 3, default=tuple(solid.centre.tolist())
    )
    if problems.clean(table.at("size"), table.at("centre_of_mass")):
        for axis in range(3):
            if abs(centre[axis]) > size[axis] / 2:
                problems.add(
                    f"{table.at('centre_of_mass')}[{axis}]",
                    f"found {centre[axis]:g} m, outside the box; allowed is "
                    f"{-size[axis] / 2:g} to {size[axis] / 2:g} m from its geometric centre",
                )
    payload = Payload(
        size=size,
        mass=mass,
        centre_of_mass=centre,
        inertia=_read_inertia(table, kind, solid, mass),
        velocity_max=table.number("velocity_max", quantity.SPEED, 1.0),
        acceleration_max=table.number("acceleration_max", quantity.ACCELERATION, 5.0),
        angular_velocity_max=table.number("angular_velocity_max", quantity.ANGULAR_SPEED, 2.0),
        angular_acceleration_max=table.number(
            "angular_acceleration_max", quantity.ANGULAR_ACCELERATION, 10.0
        ),
        jerk_max=_read_jerk(table),
        shape=solid.shape,
    )
    if kind:  # without a kind nobody can say which keys are unknown
        table.close()
    return payload


def _read_jerk(table: Table) -> float | None:
    given = table.raw("jerk_max", None) is not None
    return table.number("jerk_max", quantity.JERK) if given else None


def solid_box_inertia(size: Array, mass: float) -> Array:
    """Inertia (3, 3) [kg m^2] of a homogeneous cuboid about its centre, along its edges."""
    squares = np.asarray(size) ** 2
    return read_only(np.diag(mass / 12 * (squares.sum() - squares)))


def solid_cylinder_inertia(radius: float, length: float, mass: float) -> Array:
    """Inertia (3, 3) [kg m^2] of a homogeneous cylinder about its centre, axis along z."""
    across = mass / 12 * (3 * radius**2 + length**2)
    return read_only(np.diag([across, across, mass / 2 * radius**2]))


def _box(table: Table, mass: float) -> _Solid:
    size = table.vector("size", (quantity.PAYLOAD_SIZE,) * 3)
    return _Solid(size, None, np.zeros(3), solid_box_inertia(size, mass))


def _cylinder(table: Table, mass: float) -> _Solid:
    radius = table.number("radius", quantity.PAYLOAD_SIZE)
    length = table.number("length", quantity.PAYLOAD_SIZE)
    size = read_only([2.0 * radius, 2.0 * radius, length])
    inertia = solid_cylinder_inertia(radius, length, mass)
    return _Solid(size, Cylinder(radius, length), np.zeros(3), inertia)


def _mesh(table: Table, folder: Path, mass: float) -> _Solid:
    """A mesh is as heavy everywhere within its surface, or its hull where that has holes."""
    path = read_file(table, "path", folder, outside.MESH_BYTES)
    scale = table.vector("scale", (quantity.SCALE,) * 3, (1.0, 1.0, 1.0), scalar_fills=True)
    nothing = _Solid(read_only(np.ones(3)), None, np.zeros(3), np.eye(3))
    if not table.problems.clean(table.at("path"), table.at("scale")):
        return nothing
    # Not imported at the top: reading meshes takes long to load.
    from symbolic.geometry.meshes import read_mesh

    try:
        mesh = read_mesh(path, scale)
        if not mesh.is_volume:
            mesh = mesh.convex_hull
        size = 2.0 * np.abs(mesh.vertices).max(axis=0)
        solid = _Solid(
            read_only(size),
            Mesh(path, scale),
            read_only(mesh.center_mass),
            read_only(mass / mesh.volume * mesh.moment_inertia),
        )
    except CollisionModelError as error:
        table.problems.add(table.at("path"), str(error))
        return nothing
    low, high = quantity.PAYLOAD_SIZE.low, quantity.PAYLOAD_SIZE.high
    if not (low <= size.min() and size.max() <= high):
        table.problems.add(
            table.at("path"),
            f"reaches {size[0] / 2:g}, {size[1] / 2:g} and {size[2] / 2:g} m from its frame; "
            f"allowed are {low / 2:g} to {high / 2:g} m (is it in millimetres? scale = 0.001)",
        )
    return solid


def _read_inertia(table: Table, kind: str, solid: _Solid, mass: float) -> Array:
    words = ("solid box", "solid") if kind == "box" else ("solid",)
    if table.raw("inertia", "solid") in words:
        return solid.inertia
    bound_known = table.problems.clean(table.at("size"), table.at("mass"))
    # No mass inside the box is farther from any axis through it than the box's diagonal.
    bound = mass * float(np.sum(solid.size**2)) if bound_known else np.inf
    return read_inertia(table, bound, f"{words[0]!r} or a 3 x 3 matrix")
