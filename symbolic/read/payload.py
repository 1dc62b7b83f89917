"""The payload section and the contacts of a workcell file: the box, and the poses of the pads on
it.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast, get_args

import numpy as np

from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.read.tables import TableReader, read_file, read_inertia
from symbolic.records import Contact, Cylinder, Mesh, Payload
from symbolic.records import quantities as quantity
from symbolic.records.cell import HandKind
from symbolic.records.poses import read_only, transform
from symbolic.records.problems import Problems

PAYLOAD_KINDS = ("box", "cylinder", "mesh")


def read_payload(table: TableReader, folder: Path) -> Payload:
    """Read the payload.

    Args:
        table: the payload's section of the workcell file.
        folder: folder to which the path of a mesh is relative.
    """
    kind = table.choice("kind", PAYLOAD_KINDS, "box")
    mass = table.number("mass", quantity.MASS)
    if kind == "mesh":
        solid = _mesh(table, folder, mass)
    else:
        solid = _cylinder(table, mass) if kind == "cylinder" else _box(table, mass)
    half = solid.size / 2
    centre = table.vector("centre_of_mass", (quantity.POSITION,) * 3, solid.centre_of_mass)
    if table.clean("size", "centre_of_mass"):
        for axis in np.flatnonzero(np.abs(centre) > half):
            table.add(
                f"centre_of_mass[{axis}]",
                f"found {centre[axis]:g} m, outside the box; allowed is {-half[axis]:g} to "
                f"{half[axis]:g} m from its geometric centre",
            )
    inertia = _read_inertia(table, kind, solid)
    if not kind:  # without a kind no key is known
        return solid
    return table.record(
        Payload,
        size=solid.size,
        mass=mass,
        centre_of_mass=centre,
        inertia=inertia,
        shape=solid.shape,
    )


def solid_box_inertia(size: Array, mass: float) -> Array:
    """Compute the inertia (3, 3) of a homogeneous cuboid about its centre, along its edges [kg
    m^2].

    Args:
        size: (3,) edge lengths [m].
        mass: mass [kg].
    """
    squares = np.asarray(size) ** 2
    return read_only(np.diag(mass / 12 * (squares.sum() - squares)))


def _box(table: TableReader, mass: float) -> Payload:
    size = table.vector("size", (quantity.PAYLOAD_SIZE,) * 3)
    return Payload(size, mass, np.zeros(3), solid_box_inertia(size, mass))


def _cylinder(table: TableReader, mass: float) -> Payload:
    radius, length = (table.number(key, quantity.PAYLOAD_SIZE) for key in ("radius", "length"))
    across = mass / 12 * (3 * radius**2 + length**2)
    inertia = read_only(np.diag([across, across, mass / 2 * radius**2]))
    size = read_only([2.0 * radius, 2.0 * radius, length])
    return Payload(size, mass, np.zeros(3), inertia, shape=Cylinder(radius, length))


def _mesh(table: TableReader, folder: Path, mass: float) -> Payload:
    """Read a payload with the shape of a mesh.

    The density is uniform within the surface, or within the convex hull if the surface has holes.

    Args:
        table: the payload's section of the workcell file.
        folder: folder to which the path of the mesh is relative.
        mass: mass of the payload [kg].
    """
    path = read_file(table, "path", folder, safe_io.MESH_BYTES)
    scale = table.vector("scale", (quantity.SCALE,) * 3, (1.0, 1.0, 1.0), filling=True)
    nothing = Payload(read_only(np.ones(3)), mass, np.zeros(3), np.eye(3))
    if not table.clean("path", "scale"):
        return nothing
    # Not imported at the top: reading meshes takes long to load.
    from symbolic.read.meshes import read_mesh

    try:
        mesh = read_mesh(path, scale)
        if not mesh.is_volume:
            mesh = mesh.convex_hull
        size = read_only(2.0 * np.abs(mesh.vertices).max(axis=0))
        inertia = read_only(mass / mesh.volume * mesh.moment_inertia)
        centre = read_only(mesh.center_mass)
        solid = Payload(size, mass, centre, inertia, shape=Mesh(path, scale))
    except CollisionModelError as error:
        table.add("path", str(error))
        return nothing
    low, high = quantity.PAYLOAD_SIZE.low, quantity.PAYLOAD_SIZE.high
    if not (low <= size.min() and size.max() <= high):
        table.add(
            "path",
            f"reaches {size[0] / 2:g}, {size[1] / 2:g} and {size[2] / 2:g} m from its frame; "
            f"allowed are {low / 2:g} to {high / 2:g} m (is it in millimetres? scale = 0.001)",
        )
    return solid


def _read_inertia(table: TableReader, kind: str, solid: Payload) -> Array:
    words = ("solid box", "solid") if kind == "box" else ("solid",)
    if table.raw("inertia", "solid") in words:
        return solid.inertia
    # No mass inside the box is farther from any axis through it than the box's diagonal.
    farthest = float(np.sum(solid.size**2)) if table.clean("size", "mass") else np.inf
    return read_inertia(table, solid.mass * farthest, f"{words[0]!r} or a 3 x 3 matrix")


# --- contacts ---


FACE_TOLERANCE = 1e-6  # [m], how far a contact may be written off its face; it is moved onto it
MOST_PADS, MOST_HANDS = 4, 16  # of both arms
SHAPE_KEYS = tuple(
    f"payload.{key}" for key in ("kind", "size", "radius", "length", "path", "scale")
)
SHORTEST_NORMAL = 1e-3  # length of a written normal below which it says no direction
ALONG_Z = 0.9  # share of a normal along z from which on a pad's x axis is measured from the box's x


def read_contact(table: TableReader, payload: Payload) -> Contact:
    """Read the contact of one robot: its first pad or hand, with further ones of the same kind in
    the field `further`.

    Args:
        table: the robot's entry of `contacts` in the workcell file.
        payload: the payload on whose surface the pads are.
    """
    friction = table.number("friction", quantity.FRICTION)
    half_sides: tuple[float, float] | None = None
    if table.has("patch_size"):
        sides = table.vector("patch_size", (quantity.PATCH_SIDE,) * 2) / 2.0
        table.refuse("patch_size", ("patch_radius",))
        radius, half_sides = float(np.hypot(*sides)), (float(sides[0]), float(sides[1]))
    else:
        radius = table.number("patch_radius", quantity.PATCH_RADIUS)
    kind = cast("HandKind", table.choice("kind", get_args(HandKind), "pad"))
    force = table.number("holding_force", quantity.FORCE) if kind != "pad" else 0.0
    if kind == "pad" and table.has("holding_force"):
        table.add(
            "holding_force", "found for a pad; allowed with kind = 'cup', 'magnet', 'fingers'"
        )
    layer = {key: getattr(Contact, key) for key in ("layer_shear", "layer_stiffness")}
    if kind != "pad":
        layer = {key: table.number(key, quantity.LAYER, usual) for key, usual in layer.items()}
    if kind == "cup" and half_sides is not None:
        table.add("patch_size", "found for a cup; allowed is the patch_radius of its lip")
    known = table.clean("patch_radius", "patch_size") and table.problems.clean(*SHAPE_KEYS)

    def pad(place: TableReader, further: tuple[Contact, ...] = ()) -> Contact:
        pose = _read_place(place, payload if known else None, radius, half_sides)
        place.close()
        return Contact(pose, friction, radius, half_sides, further, kind, force, **layer)

    return pad(table, tuple(pad(entry) for entry in table.tables("further")))


def check_count(contacts: list[Contact], problems: Problems) -> None:
    """Record a problem if the contacts have more than `MOST_PADS` pads, or `MOST_HANDS` hands."""
    count = sum(1 + len(contact.further) for contact in contacts)
    allowed = MOST_HANDS if any(contact.holding_force for contact in contacts) else MOST_PADS
    if count > allowed:
        problems.add("contacts", f"found {count} pads; allowed are {allowed} on both arms")


def _read_place(
    table: TableReader,
    payload: Payload | None,
    radius: float,
    half_sides: tuple[float, float] | None,
) -> Array:
    """Read the pose T_box_pad (4, 4) of a pad; the identity after a problem.

    The file states a point on a face of the payload, or a point and a normal.

    Args:
        table: the pad's table.
        payload: the payload; None after problems with its shape.
        radius: radius of the patch [m].
        half_sides: half sides of a rectangular patch [m]; None for a round patch.
    """
    point = table.vector("xyz", (quantity.POSITION,) * 3)
    spin = table.number("spin", quantity.ANGLE, 0.0)
    written = table.vector("normal", (quantity.DIRECTION,) * 3) if table.has("normal") else None
    if written is not None and np.linalg.norm(written) < SHORTEST_NORMAL:
        table.add("normal", "found no direction; allowed is one into the payload")
    if payload is None or not table.clean("xyz", "spin", "normal"):
        return read_only(np.eye(4))
    if written is None:
        return _on_surface(table, point, spin, payload, radius, half_sides)
    reach, distance = float(np.linalg.norm(payload.size)), float(np.linalg.norm(point))
    if distance > reach:
        table.add(
            "xyz",
            f"found a point {distance:g} m from the box frame; allowed is one at most a diagonal "
            f"of the payload away, {reach:g} m",
        )
    return read_only(transform(pad_rotation(written, spin), point))


def pad_rotation(normal: Array, spin: float) -> Array:
    """Compute the rotation R_box_pad (3, 3) of a pad from its normal and spin.

    z is the contact normal. At zero spin x is the box's +z axis projected onto the face, or its +x
    axis if the normal is nearly along z; y completes the right-handed frame. `spin` rotates the pad
    about its z axis.

    Args:
        normal: (3,) direction into the payload, of any length, box frame.
        spin: rotation about the normal [rad].
    """
    z = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    reference = np.eye(3)[0 if abs(z[2]) > ALONG_Z else 2]
    x = reference - (reference @ z) * z
    x /= np.linalg.norm(x)
    base = np.column_stack([x, np.cross(z, x), z])
    cosine, sine = np.cos(spin), np.sin(spin)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(base @ turn, dtype=np.float64)


def _on_surface(
    table: TableReader,
    point: Array,
    spin: float,
    payload: Payload,
    radius: float,
    half_sides: tuple[float, float] | None,
) -> Array:
    """Compute the pose T_box_pad (4, 4) of a pad that lies on a face of a box or cylinder.

    If the point is on no face, on an edge, or on a mesh, a problem is recorded and the result is
    the identity.

    Args:
        table: the pad's table, which collects problems.
        point: (3,) centre of the pad in the box frame [m].
        spin: rotation of the pad about the normal [rad].
        payload: the payload.
        radius: radius of the patch [m].
        half_sides: half sides of a rectangular patch [m]; None for a round patch.
    """
    if isinstance(payload.shape, Mesh):
        table.add("xyz", "lies on a mesh; give the contact a normal, into the payload")
        return read_only(np.eye(4))
    is_round = isinstance(payload.shape, Cylinder)
    inward = np.diag(np.where(point > 0.0, -1.0, 1.0))
    away, most = np.abs(point), payload.size / 2
    if is_round:
        radial = np.hypot(point[0], point[1])
        across = np.array([point[0], point[1], 0.0]) / (radial or 1.0)
        inward = np.array([-across, inward[2]])
        away, most = np.array([radial, away[2]]), most[1:]
    name = "cylinder" if is_round else "box"
    excess = away - most
    on_face = np.flatnonzero(np.abs(excess) <= FACE_TOLERANCE)
    where = f"found ({', '.join(f'{entry:g}' for entry in point)}) m"
    if np.any(excess > FACE_TOLERANCE) or not len(on_face):
        beyond = float(np.linalg.norm(np.maximum(excess, 0.0)))
        distance = f"{beyond:.6g} m outside" if beyond else f"{-excess.max():.6g} m inside"
        table.add(
            "xyz",
            f"{where}, {distance} the {name}; allowed is a point on a face, "
            f"{' or '.join(f'{half:g}' for half in most)} m from the middle, or a normal of its "
            "own",
        )
        return read_only(np.eye(4))
    if len(on_face) > 1:
        table.add("xyz", f"{where}, on an edge of the {name}; allowed is a point within one face")
        return read_only(np.eye(4))
    face = int(on_face[0])
    origin, directed = np.array(point), np.flatnonzero(inward[face])
    origin[directed] = (-most[face] * inward[face])[directed]
    rotation = pad_rotation(inward[face], spin)
    reaches = np.full(len(most), radius)
    if half_sides is not None:
        reaches = np.abs(rotation[:, :2]) @ half_sides
        reaches = np.array([np.hypot(*reaches[:2]), reaches[2]]) if is_round else reaches
    for other, (reach, room) in enumerate(zip(reaches, most - away, strict=True)):
        if other != face and reach > room + FACE_TOLERANCE:
            table.add(
                "xyz",
                f"found a patch that reaches {reach:g} m only {room:g} m from the edge of its "
                "face; allowed is a patch that lies on the face",
            )
    return read_only(transform(rotation, origin))
