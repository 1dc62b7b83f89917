"""The cell in three dimensions: its bodies as triangle meshes, where they are along a carry, and
what `scene.js` draws of them in a browser, as a page that plays a carry."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from itertools import product
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.display.objects import heading_of
from hybrid_opt.errors import DisplayError
from symbolic.array import Array
from symbolic.geometry.bodies import ArmGeometry, Frame
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.pieces import Hull, Piece
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.content import CacheKey
from symbolic.records.poses import box_placement

SECTIONS = 24
"""Facets around a cylinder."""

GROUND_SIZE = 2.5
"""Fixed bodies at least this long and wide are ground: drawn behind everything [m]."""


@dataclass(frozen=True)
class Solid:
    """A body as triangles in the frame that it is fixed to.

    Attributes:
        name, group: of the collision body.
        frame: what it is fixed to.
        vertices: (n, 3) [m].
        faces: (m, 3) indices, outward.
        is_ground: whether it is a large fixed plate.
    """

    name: str
    group: str
    frame: Frame
    vertices: Array
    faces: NDArray[np.int64]
    is_ground: bool


def cell_solids(geometry: CellGeometry) -> tuple[Solid, ...]:
    """Every collision body of a cell as triangles."""
    return tuple(_triangles(CacheKey(body, known=body.content)) for body in geometry.bodies)


@lru_cache(maxsize=256)
def _triangles(seen: CacheKey) -> Solid:
    (body,) = seen.given
    meshes = [_mesh(piece) for piece in body.pieces]
    vertices = np.concatenate([np.asarray(mesh.vertices, np.float64) for mesh in meshes])
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate(
        [np.asarray(m.faces, np.int64) + k for m, k in zip(meshes, first[:-1], strict=True)]
    )
    extent = np.sort(np.ptp(vertices, axis=0))[::-1]
    ground = body.frame.kind == "world" and bool(extent[1] >= GROUND_SIZE)
    for values in (vertices, faces):
        values.setflags(write=False)
    return Solid(body.name, body.group, body.frame, vertices, faces, ground)


def _mesh(piece: Piece) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh
    shape = piece.shape
    match shape:
        case Box():
            mesh = trimesh.creation.box(extents=np.asarray(shape.size))
        case Cylinder():
            mesh = trimesh.creation.cylinder(shape.radius, shape.length, sections=SECTIONS)
        case Sphere():
            mesh = trimesh.creation.icosphere(subdivisions=2, radius=shape.radius)
        case Capsule():
            mesh = trimesh.creation.capsule(
                height=shape.length, radius=shape.radius, count=(SECTIONS, SECTIONS // 2)
            )
            centre = (mesh.bounds[0] + mesh.bounds[1]) / 2.0
            mesh.apply_translation(-centre)
        case Hull():
            mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    mesh.apply_transform(piece.pose)
    return mesh


def joint_placements(arm: ArmGeometry, q: Array) -> Array:
    """(n, n_joints, 4, 4) of an arm's joint frames in the world at joints q (n, n_joints)."""
    placed = np.empty((*q.shape, 4, 4))
    T = np.broadcast_to(arm.T_world_root, (len(q), 4, 4))
    for j in range(q.shape[1]):
        moved = np.tile(np.eye(4), (len(q), 1, 1))
        along = np.outer(q[:, j], arm.axes[j])
        if arm.turning[j]:
            moved[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
        else:
            moved[:, :3, 3] = along
        T = T @ arm.origins[j] @ moved
        placed[:, j] = T
    return placed


def frame_placements(geometry: CellGeometry, pose: Array, q: Array) -> dict[Frame, Array]:
    """(n, 4, 4) of every frame in the world along n samples: pose (n, 6), q (n, all joints)."""
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
    """(k, 3) corners of every solid's own bounding box at n samples, the ground left out.

    They frame what a picture has to show: pose (n, 6), q (n, all joints).
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
"""Approximate number of a carry's samples by which the viewpoint of its scene is chosen."""


def scene_data(
    geometry: CellGeometry, carry: Carry, marked: Collection[str] = ()
) -> dict[str, Any]:
    """Shapes, joints and a good place to look from, as JSON values.

    Args:
        marked: names of bodies that are shown in red.
    """
    points = motion_points(geometry, carry.pose, carry.q)
    lower, upper = points.min(axis=0), points.max(axis=0)
    # How the page reads the last three numbers of a pose; the reference as x y z w.
    orientation = geometry.workcell.task.orientation
    reference = Rotation.from_matrix(orientation.reference).as_quat()
    return {
        "arms": [
            {
                "root": arm.T_world_root.ravel().tolist(),
                "origins": [origin.ravel().tolist() for origin in arm.origins],
                "axes": arm.axes.tolist(),
                "turning": list(arm.turning),
            }
            for arm in geometry.arms
        ],
        "orientation": {"vector": orientation.is_vector, "reference": reference.tolist()},
        # Where each arm presses in the box's frame, and which way.
        "contacts": [
            {"at": contact.T_box_pad[:3, 3].tolist(), "along": contact.T_box_pad[:3, 2].tolist()}
            for contact in geometry.workcell.contacts
        ],
        "solids": [_solid(solid, solid.name in marked) for solid in cell_solids(geometry)],
        "view": {
            "centre": ((lower + upper) / 2.0).tolist(),
            "radius": float(np.linalg.norm(upper - lower)) / 2.0,
        },
    }


def motion_points(geometry: CellGeometry, pose: Array, q: Array) -> Array:
    """(k, 3) what a picture of a whole motion has to show, see `extent_points`."""
    every = slice(None, None, max(1, len(pose) // _VIEWED))
    return extent_points(geometry, cell_solids(geometry), pose[every], q[every])


def scene_js() -> str:
    """The script that draws a scene; it needs three.js before it."""
    return (files("hybrid_opt.display") / "scene.js").read_text("utf-8")


def three_js() -> str:
    """three.js with its licence line."""
    return _vendored("three.min.js")


def plotly_js() -> str:
    """plotly.js with its licence line: what draws points, lines and bars."""
    return _vendored("plotly-basic.min.js")


def _vendored(name: str) -> str:
    return (files("hybrid_opt.display") / "vendor" / name).read_text("utf-8")


def embedded_json(document: Any) -> str:
    """JSON for a script element: no text in it can end the element or open another."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def packed(values: NDArray[Any], kind: type[np.generic]) -> str:
    """Little-endian numbers in base64."""
    return base64.b64encode(
        np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<")).tobytes()
    ).decode("ascii")


def _solid(solid: Solid, marked: bool) -> dict[str, Any]:
    return {
        "group": "marked" if marked else solid.group,
        "ground": solid.is_ground,
        "kind": solid.frame.kind,
        "robot": solid.frame.robot,
        "joint": solid.frame.joint,
        "vertices": packed(solid.vertices, np.float32),
        "faces": packed(solid.faces, np.uint16),
    }


MAX_SAMPLES = 200
"""Samples of a carry that are played."""


@dataclass(frozen=True)
class Look:
    """A place of a carry worth looking at.

    Attributes:
        sample: number of the sample.
        text: what is to be seen there.
        bodies: names of those that are shown in red.
    """

    sample: int
    text: str
    bodies: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class CarryView:
    """A self-contained page that plays a carry; drag orbits, right-drag pans, the wheel zooms.

    Attributes:
        carry: the carry.
        height: of the notebook's cell [px].
        look: where it begins, None for the first sample.
    """

    carry: Carry
    height: int = 480
    look: Look | None = None

    def page(self) -> str:
        """The page's text: no network, nothing but its own scripts."""
        carry = self.carry
        rows = np.unique(np.linspace(0, len(carry) - 1, min(len(carry), MAX_SAMPLES)).astype(int))
        columns = [carry.time[:, None] - carry.time[0], carry.pose, carry.q]
        samples = np.concatenate(columns, axis=1)[rows]
        look = self.look or Look(0, "")
        document = scene_data(build_geometry(carry.workcell), carry, look.bodies) | {
            "samples": packed(samples, np.float32),
            "width": samples.shape[1],
            "numbers": rows.tolist(),
            "begin": float(carry.time[look.sample] - carry.time[0]),
        }
        return Template(_own("view.html")).substitute(
            title=html.escape(heading_of(carry)),
            note=html.escape(look.text),
            data=embedded_json(document),
            three=three_js().replace("</script", "<\\/script"),
            scene=scene_js(),
            player=_own("view.js"),
        )

    def save(self, path: str | Path) -> None:
        """Write the page into a file.

        Raises:
            DisplayError: the file cannot be written.
        """
        try:
            Path(path).write_text(self.page(), encoding="utf-8")
        except OSError as error:
            raise DisplayError(f"{path}: cannot be written ({error.strerror})") from error

    def __repr__(self) -> str:
        return (
            f"View of: {heading_of(self.carry)} (shown in a notebook; save('view.html') elsewhere)"
        )

    def _repr_html_(self) -> str:
        page = html.escape(self.page(), quote=True)
        return (
            f'<iframe srcdoc="{page}" sandbox="allow-scripts" '
            f'style="width:100%;height:{self.height}px;border:0"></iframe>'
        )


def _own(name: str) -> str:
    return (files("hybrid_opt.display") / name).read_text("utf-8")
