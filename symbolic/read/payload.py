"""The payload section of a workcell file, and the contacts section: where pads press on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.read.tables import Table, read_file, read_inertia
from symbolic.records import Contact, Cylinder, Mesh, Payload
from symbolic.records import quantities as quantity
from symbolic.records.poses import read_only, transform
from symbolic.records.problems import Problems

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
        jerk_max=table.number("jerk_max", quantity.JERK) if table.has("jerk_max") else None,
        shape=solid.shape,
    )
    if kind:  # without a kind nobody can say which keys are unknown
        table.close()
    return payload


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
    from symbolic.read.meshes import read_mesh

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


# --- contacts ---


FACE_TOLERANCE = 1e-6  # [m], how far a contact may be written off its face; it is moved onto it
MOST_PADS = 4
SHAPE_KEYS = tuple(
    f"payload.{key}" for key in ("kind", "size", "radius", "length", "path", "scale")
)
LEAST_NORMAL = 1e-3  # length of a written normal below which it says no direction
ALONG_Z = 0.9  # share of a normal along z from which on a pad's x axis is measured from the box's x


def read_contact(table: Table, payload: Payload) -> Contact:
    """One robot's pads on a payload."""
    friction = table.number("friction", quantity.FRICTION)
    radius, half_sides = _read_patch(table)
    patch = (table.at("patch_radius"), table.at("patch_size"))
    pose = _read_place(table, payload, radius, half_sides, patch)
    further = []
    for entry in table.tables("further"):
        place = _read_place(entry, payload, radius, half_sides, patch)
        entry.close()
        further.append(Contact(place, friction, radius, half_sides))
    table.close()
    return Contact(pose, friction, radius, half_sides, tuple(further))


def check_count(contacts: list[Contact], problems: Problems) -> None:
    """There are not more pads than allowed."""
    count = sum(1 + len(contact.further) for contact in contacts)
    if count > MOST_PADS:
        problems.add("contacts", f"found {count} pads; allowed are {MOST_PADS} on both arms")


def _read_patch(table: Table) -> tuple[float, tuple[float, float] | None]:
    """Radius of a round patch, or half the diagonal and half the sides of a rectangular one [m]."""
    if "patch_size" not in table:
        return table.number("patch_radius", quantity.PATCH_RADIUS), None
    sides = table.vector("patch_size", (quantity.PATCH_SIDE,) * 2) / 2.0
    if "patch_radius" in table:
        table.raw("patch_radius")
        table.problems.add(
            table.at("patch_size"), "found beside 'patch_radius'; allowed is one or the other"
        )
    return float(np.hypot(*sides)), (float(sides[0]), float(sides[1]))


def _read_place(
    table: Table,
    payload: Payload,
    radius: float,
    half_sides: tuple[float, float] | None,
    patch: tuple[str, str],
) -> Array:
    """T_box_pad (4, 4) of a pad on the payload's surface, or at a normal of its own."""
    point = table.vector("xyz", (quantity.POSITION,) * 3)
    spin = table.number("spin", quantity.ANGLE, 0.0)
    problems = table.problems
    written = None
    if "normal" in table:
        written = table.vector("normal", (quantity.DIRECTION,) * 3)
        if problems.clean(table.at("normal")) and np.linalg.norm(written) < LEAST_NORMAL:
            problems.add(table.at("normal"), "found no direction; allowed is one into the payload")
    parts = ("xyz", "spin", "normal")
    if not problems.clean(*SHAPE_KEYS, *patch, *(table.at(part) for part in parts)):
        return read_only(np.eye(4))
    if written is not None:
        reach = float(np.linalg.norm(payload.size))
        distance = float(np.linalg.norm(point))
        if distance > reach:
            problems.add(
                table.at("xyz"),
                f"found a point {distance:g} m from the box frame; allowed is one at most a "
                f"diagonal of the payload away, {reach:g} m",
            )
        return read_only(transform(pad_rotation(written, spin), point))
    on_surface = _surface_of(point, payload, table.at("xyz"), problems)
    if on_surface is None:
        return read_only(np.eye(4))
    origin, normal = on_surface
    rotation = pad_rotation(normal, spin)
    reach_of_patch = _reach(rotation, radius, half_sides)
    for problem in _overhang(origin, normal, payload, reach_of_patch):
        problems.add(table.at("xyz"), problem)
    return read_only(transform(rotation, origin))


def pad_rotation(normal: Array, spin: float) -> Array:
    """R_box_pad (3, 3) of a pad.

    z is the contact normal. At zero spin x points along the box's +z axis as far as it can, where
    the normal is nearly along that, along its +x axis; y completes the right-handed frame. `spin`
    turns the pad about its own z.

    Args:
        normal: (3,) into the payload, of any length.
        spin: [rad].
    """
    z = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    reference = np.eye(3)[0 if abs(z[2]) > ALONG_Z else 2]
    x = reference - (reference @ z) * z
    x /= np.linalg.norm(x)
    base = np.column_stack([x, np.cross(z, x), z])
    cosine, sine = np.cos(spin), np.sin(spin)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(base @ turn, dtype=np.float64)


def face_normal(axis: int, side: int) -> Array:
    """(3,) inward normal of the face at the end `side` (+1 or -1) of a box axis (0, 1, 2)."""
    normal = np.zeros(3)
    normal[axis] = -side
    return normal


def _surface_of(
    point: Array, payload: Payload, path: str, problems: Problems
) -> tuple[Array, Array] | None:
    """The point on the surface, and the inward normal there, (3,) each; or a recorded problem."""
    match payload.shape:
        case None:
            return _face_of(point, payload.size, path, problems)
        case Cylinder():
            return _cylinder_face_of(point, payload.shape, path, problems)
    problems.add(path, "lies on a mesh; give the contact a normal, into the payload")
    return None


def _face_of(
    point: Array, size: Array, path: str, problems: Problems
) -> tuple[Array, Array] | None:
    excess = np.abs(point) - size / 2
    listed = ", ".join(f"{half:g}" for half in size / 2)
    on_face = np.flatnonzero(np.abs(excess) <= FACE_TOLERANCE)
    if np.any(excess > FACE_TOLERANCE) or on_face.size == 0:
        outside = np.linalg.norm(np.maximum(excess, 0.0))
        distance = outside if outside > 0 else -excess.max()
        side = "outside" if outside > 0 else "inside"
        problems.add(
            path,
            f"{_where(point)}, {distance:.6g} m {side} the box; allowed is a point on a face, the "
            f"faces are at plus and minus ({listed}) m, or a normal of its own",
        )
        return None
    if on_face.size > 1:
        problems.add(
            path, f"{_where(point)}, on an edge of the box; allowed is a point within one face"
        )
        return None
    axis = int(on_face[0])
    side_of = 1 if point[axis] > 0 else -1
    origin = np.array(point)
    origin[axis] = side_of * size[axis] / 2
    return origin, face_normal(axis, side_of)


def _cylinder_face_of(
    point: Array, shape: Cylinder, path: str, problems: Problems
) -> tuple[Array, Array] | None:
    radial = float(np.hypot(point[0], point[1]))
    on_end = abs(abs(point[2]) - shape.length / 2) <= FACE_TOLERANCE
    around = abs(radial - shape.radius) <= FACE_TOLERANCE
    within = abs(point[2]) <= shape.length / 2 + FACE_TOLERANCE
    if not (on_end and radial <= shape.radius) and not (around and within):
        problems.add(
            path,
            f"{_where(point)}, {radial:.6g} m from the axis of the cylinder; allowed is a point on "
            f"it, {shape.radius:g} m from its axis or at z = plus or minus {shape.length / 2:g} m, "
            "or a normal of its own",
        )
        return None
    if around and on_end:
        problems.add(
            path, f"{_where(point)}, on an edge of the cylinder; allowed is a point within a face"
        )
        return None
    origin = np.array(point)
    if on_end:
        side = 1 if point[2] > 0 else -1
        origin[2] = side * shape.length / 2
        return origin, face_normal(2, side)
    outward = np.array([point[0], point[1], 0.0]) / radial
    origin[:2] = shape.radius * outward[:2]
    return origin, -outward


def _where(point: Array) -> str:
    return f"found ({', '.join(f'{entry:g}' for entry in point)}) m"


def _reach(rotation: Array, radius: float, half_sides: tuple[float, float] | None) -> Array:
    """(3,) how far a patch reaches along the box axes [m]."""
    if half_sides is None:
        return np.full(3, radius)
    return np.asarray(np.abs(rotation[:, :2]) @ half_sides)


def _overhang(origin: Array, normal: Array, payload: Payload, reach: Array) -> list[str]:
    """For each edge of its face that a patch reaches over, what is wrong."""
    if isinstance(payload.shape, Cylinder):
        if abs(normal[2]) > 0.5:
            room = payload.shape.radius - float(np.hypot(*origin[:2]))
            reached = float(np.hypot(*reach[:2])) if reach[0] != reach[1] else float(reach[0])
            return [_over(reached, room, "the end")] if reached > room + FACE_TOLERANCE else []
        rooms = {2: payload.shape.length / 2 - abs(origin[2])}
    else:
        across = [other for other in range(3) if abs(normal[other]) < 0.5]
        rooms = {other: payload.size[other] / 2 - abs(origin[other]) for other in across}
    return [
        _over(float(reach[other]), room, f"the face along box axis {'xyz'[other]}")
        for other, room in rooms.items()
        if reach[other] > room + FACE_TOLERANCE
    ]


def _over(reach: float, room: float, face: str) -> str:
    return (
        f"found a patch that reaches {reach:g} m only {room:g} m from the edge of {face}; allowed "
        "is a patch that lies on the face"
    )
