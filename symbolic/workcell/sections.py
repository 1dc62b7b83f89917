"""The sections of a workcell file that need no robot model: payload, contacts, bodies, rules."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.physics.pose import pose_matrix, transform
from symbolic.workcell import quantities as quantity
from symbolic.workcell.problems import Problems, shown
from symbolic.workcell.reader import Table, checked_vector, read_only
from symbolic.workcell.records import (
    Body,
    Box,
    CollisionSettings,
    Contact,
    Cylinder,
    IgnoredPair,
    Mesh,
    Payload,
    Shape,
    Sphere,
)

FACE_TOLERANCE = 1e-6  # [m], how far a contact may be written off its face; it is moved onto it
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


def read_payload(table: Table) -> Payload:
    """The carried box."""
    problems = table.problems
    size = table.vector("size", (quantity.PAYLOAD_SIZE,) * 3)
    mass = table.number("mass", quantity.MASS)
    centre = table.vector("centre_of_mass", (quantity.POSITION,) * 3, default=(0.0, 0.0, 0.0))
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
        inertia=_read_inertia(table, size, mass),
        velocity_max=table.number("velocity_max", quantity.SPEED, 1.0),
        acceleration_max=table.number("acceleration_max", quantity.ACCELERATION, 5.0),
        angular_velocity_max=table.number("angular_velocity_max", quantity.ANGULAR_SPEED, 2.0),
        angular_acceleration_max=table.number(
            "angular_acceleration_max", quantity.ANGULAR_ACCELERATION, 10.0
        ),
        jerk_max=_read_jerk(table),
    )
    table.close()
    return payload


def _read_jerk(table: Table) -> float | None:
    given = table.raw("jerk_max", None) is not None
    return table.number("jerk_max", quantity.JERK) if given else None


def solid_box_inertia(size: Array, mass: float) -> Array:
    """Inertia (3, 3) [kg m^2] of a homogeneous cuboid about its centre, along its edges."""
    squares = np.asarray(size) ** 2
    return read_only(np.diag(mass / 12 * (squares.sum() - squares)))


def _read_inertia(table: Table, size: Array, mass: float) -> Array:
    if table.raw("inertia", "solid box") == "solid box":
        return solid_box_inertia(size, mass)
    bound_known = table.problems.clean(table.at("size"), table.at("mass"))
    # No mass inside the box is farther from any axis through it than the box's diagonal.
    bound = mass * float(np.sum(size**2)) if bound_known else np.inf
    return read_inertia(table, bound, "'solid box' or a 3 x 3 matrix")


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


def read_contact(table: Table, size: Array) -> Contact:
    """A contact on a face of a box of the given edge lengths (3,) [m]."""
    point = table.vector("xyz", (quantity.POSITION,) * 3)
    spin = table.number("spin", quantity.ANGLE, 0.0)
    radius = table.number("patch_radius", quantity.PATCH_RADIUS)
    friction = table.number("friction", quantity.FRICTION)
    table.close()
    pose = np.eye(4)
    problems = table.problems
    if problems.clean("payload.size", table.at("xyz"), table.at("spin"), table.at("patch_radius")):
        face = _face_of(point, size, table.at("xyz"), problems)
        if face is not None:
            axis, side = face
            for problem in _overhang(point, size, axis, radius):
                problems.add(table.at("xyz"), problem)
            origin = np.array(point)
            origin[axis] = side * size[axis] / 2
            pose = transform(pad_rotation(axis, side, spin), origin)
    return Contact(read_only(pose), friction, radius)


def pad_rotation(axis: int, side: int, spin: float) -> Array:
    """R_box_pad (3, 3) of a pad on a face of the box.

    z is the inward normal of the face. At zero spin x points along the box's +z axis, on the
    two faces across z along its +x axis; y completes the right-handed frame. `spin` [rad] turns
    the pad about its own z.

    Args:
        axis: 0, 1, 2, the box axis the face is perpendicular to.
        side: +1 or -1, the end of that axis.
        spin: [rad].
    """
    normal = np.zeros(3)
    normal[axis] = -side
    reference = np.eye(3)[0 if axis == 2 else 2]
    base = np.column_stack([reference, np.cross(normal, reference), normal])
    cosine, sine = np.cos(spin), np.sin(spin)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(base @ turn, dtype=np.float64)


def _face_of(point: Array, size: Array, path: str, problems: Problems) -> tuple[int, int] | None:
    """The (axis, side) of the face that a point lies on, or a recorded problem and None."""
    excess = np.abs(point) - size / 2
    listed = ", ".join(f"{half:g}" for half in size / 2)
    where = f"found ({', '.join(f'{entry:g}' for entry in point)}) m"
    on_face = np.flatnonzero(np.abs(excess) <= FACE_TOLERANCE)
    if np.any(excess > FACE_TOLERANCE) or on_face.size == 0:
        outside = np.linalg.norm(np.maximum(excess, 0.0))
        distance = outside if outside > 0 else -excess.max()
        side = "outside" if outside > 0 else "inside"
        problems.add(
            path,
            f"{where}, {distance:.6g} m {side} the box; allowed is a point on a face, the "
            f"faces are at plus and minus ({listed}) m",
        )
        return None
    if on_face.size > 1:
        problems.add(path, f"{where}, on an edge of the box; allowed is a point within one face")
        return None
    axis = int(on_face[0])
    return axis, 1 if point[axis] > 0 else -1


def _overhang(point: Array, size: Array, axis: int, radius: float) -> list[str]:
    """For each edge of the face that a patch reaches over, what is wrong."""
    rooms = {other: size[other] / 2 - abs(point[other]) for other in range(3) if other != axis}
    return [
        f"found a patch of radius {radius:g} m only {room:g} m from the edge of the face along "
        f"box axis {'xyz'[other]}; allowed is a patch that lies on the face"
        for other, room in rooms.items()
        if radius > room + FACE_TOLERANCE
    ]


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
