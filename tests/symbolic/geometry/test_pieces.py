"""Convex pieces: shapes, hulls and what becomes of meshes."""

from __future__ import annotations

import os
import warnings
import zipfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.covers import chain_cover, slab_cover
from symbolic.geometry.hulls import STAND_OUT, CollisionModelWarning, convex_pieces, cut
from symbolic.geometry.pieces import (
    ConvexShape,
    Hull,
    Piece,
    ball,
    bounding_box,
    box_corners,
    check_piece,
    contains,
    farthest_from_axis,
    farthest_from_point,
    sphere_chain,
    support,
    swept_cylinder,
)
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.poses import pose_matrix
from tests.machines import ur10_urdf
from tests.refusals import refused
from tests.symbolic.geometry.collision_cells import geometry_of
from tests.waiting import soon

lengths = st.floats(0.02, 1.0)
angles = st.floats(-3.0, 3.0)
shifts = st.floats(-1.0, 1.0)


def cloud(seed: int) -> Hull:
    points = np.random.default_rng(seed).normal(size=(12, 3)) * (0.2, 0.1, 0.4)
    hull = ConvexHull(points)
    return Hull(points[hull.vertices], np.zeros((0, 3), dtype=np.int64))


shapes = st.one_of(
    st.builds(lambda a, b, c: Box(np.array([a, b, c])), lengths, lengths, lengths),
    st.builds(Cylinder, lengths, lengths),
    st.builds(Sphere, lengths),
    st.builds(Capsule, lengths, lengths),
    st.builds(cloud, st.integers(0, 1000)),
)
poses = st.builds(
    lambda xyz, rpy: pose_matrix(xyz, rpy),
    st.tuples(shifts, shifts, shifts).map(np.array),
    st.tuples(angles, angles, angles).map(np.array),
)
pieces = st.builds(Piece, shapes, poses)


def surface_points(piece: Piece, rng: np.random.Generator, n: int = 400) -> Array:
    """Points of the piece's surface, extreme ones included, in the body's frame."""
    shape: ConvexShape = piece.shape
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    match shape:
        case Box():
            points = np.vstack(
                [box_corners(shape.size), rng.uniform(-0.5, 0.5, (n, 3)) * shape.size]
            )
        case Cylinder():
            around = directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1, keepdims=True)
            height = np.sign(directions[:, 2]) * shape.length / 2.0
            points = np.column_stack([shape.radius * around, height])
        case Sphere():
            points = shape.radius * directions
        case Capsule():
            points = shape.radius * directions
            points[:, 2] += np.sign(directions[:, 2]) * shape.length / 2.0
        case Hull():
            points = np.vstack(
                [shape.vertices, rng.dirichlet(np.ones(len(shape.vertices)), n) @ shape.vertices]
            )
    return np.asarray(points @ piece.rotation.T + piece.centre)


@given(pieces, st.integers(0, 99))
def test_support_is_the_largest_coordinate(piece: Piece, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = surface_points(piece, rng, 4000)
    u = rng.normal(size=(5, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    reached = (points @ u.T).max(axis=0)
    bound = support(piece, u)
    assert np.all(bound >= reached - 1e-12)
    size = farthest_from_point(piece, piece.centre)
    assert np.all(bound <= reached + 0.05 * size)


@given(pieces, st.integers(0, 99))
def test_farthest_distances_are_never_exceeded(piece: Piece, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = surface_points(piece, rng)
    place, axis = rng.normal(size=3), rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    away = np.linalg.norm(points - place, axis=1)
    assert away.max() <= farthest_from_point(piece, place) + 1e-12
    across = np.linalg.norm(np.cross(points - place, axis), axis=1)
    assert across.max() <= farthest_from_axis(piece, place, axis) + 1e-12


@given(st.lists(pieces, min_size=1, max_size=4), st.floats(0.5, 3.0), st.integers(0, 99))
def test_chains_and_boxes_contain_their_pieces(
    found: list[Piece], slenderness: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    box = bounding_box(tuple(found), np.eye(3))
    chain = sphere_chain(tuple(found), np.eye(3), slenderness)
    assert all(contains(box, piece) for piece in found)
    for piece in found:
        points = surface_points(piece, rng)
        nearest = np.linalg.norm(points[:, None] - chain.centres, axis=2).min(axis=1)
        assert nearest.max() <= chain.radius + 1e-12


def test_containment_is_exact_not_sampled() -> None:
    inner = Piece(Box(np.array([1.0, 1.0, 1.0])), np.eye(4))
    assert contains(ball(np.zeros(3), np.sqrt(3.0) / 2.0), inner)
    assert not contains(ball(np.zeros(3), np.sqrt(3.0) / 2.0 - 1e-9), inner)
    cylinder = Piece(Cylinder(0.5, 1.0), np.eye(4))
    assert contains(inner, cylinder)
    assert not contains(inner, Piece(Cylinder(0.5 + 1e-9, 1.0), np.eye(4)))
    with refused(CollisionModelError, "containment"):
        contains(cylinder, inner)


@given(pieces, angles, st.integers(0, 99))
def test_swept_cylinder_contains_every_rotation(piece: Piece, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    point, axis = rng.normal(size=3), rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    cylinder = swept_cylinder((piece,), point, axis)
    assert isinstance(cylinder.shape, Cylinder)
    arm = surface_points(piece, rng) - point
    turned = (
        arm * np.cos(angle)
        + np.cross(axis, arm) * np.sin(angle)
        + np.outer(arm @ axis, axis) * (1 - np.cos(angle))
    )
    local = (turned + point - cylinder.centre) @ cylinder.rotation
    assert np.hypot(local[:, 0], local[:, 1]).max() <= cylinder.shape.radius + 1e-9
    assert np.abs(local[:, 2]).max() <= cylinder.shape.length / 2.0 + 1e-9


@pytest.mark.parametrize("cell", ["rack", "ur10"])
def test_covers_of_real_links_contain_them(cell: str) -> None:
    rng = np.random.default_rng(3)
    axes = rng.normal(size=(500, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for body in geometry_of(cell).bodies:
        cover, chain = slab_cover(body), chain_cover(body)
        outer = np.max([support(piece, axes) for piece in cover], axis=0)
        spheres = np.max(axes @ chain.centres.T, axis=1) + chain.radius
        for piece in body.pieces:
            inner = support(piece, axes)
            assert np.all(inner <= outer + 1e-12), body.name
            assert np.all(inner <= spheres + 1e-12), body.name
            points = surface_points(piece, rng)
            gap = np.linalg.norm(points[:, None] - chain.centres, axis=2).min(axis=1)
            assert gap.max() <= chain.radius + 1e-12


@pytest.mark.parametrize(
    ("shape", "word"),
    [
        (Box(np.array([0.0, 1.0, 1.0])), "size[0]"),
        (Cylinder(0.0, 1.0), "radius"),
        (Cylinder(0.1, -1.0), "length"),
        (Sphere(float("nan")), "radius"),
        (Capsule(0.1, 0.0), "length"),
    ],
)
def test_shapes_without_size_are_refused(shape: ConvexShape, word: str) -> None:
    with refused(CollisionModelError, "extent", "'shelf'", word):
        check_piece(Piece(shape, np.eye(4)), "'shelf'")


def test_poses_that_are_no_poses_are_refused() -> None:
    with refused(CollisionModelError, "pose", "'shelf'"):
        check_piece(Piece(Sphere(1.0), 2.0 * np.eye(4)), "'shelf'")


MESHES = ur10_urdf().parents[1] / "meshes" / "ur10" / "collision"
ONES = np.ones(3)


def outside(points: Array, pieces: tuple[Hull, ...]) -> Array:
    """Distance of each point from the nearest piece's half-spaces; at most 0 inside one."""
    depth = [
        (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
        for hull in (ConvexHull(piece.vertices) for piece in pieces)
    ]
    return np.asarray(np.min(depth, axis=0))


def angle_profile() -> trimesh.Trimesh:
    polygon = [(0, 0), (1, 0), (1, 0.1), (0.1, 0.1), (0.1, 1), (0, 1)]
    lower, upper = (np.array([(x, y, z) for x, y in polygon]) for z in (0.0, 0.5))
    vertices = np.vstack([lower, upper])
    caps = [(0, 3, 1), (1, 3, 2), (0, 5, 3), (3, 5, 4)]
    faces = caps + [tuple(6 + k for k in reversed(face)) for face in caps]
    for k in range(6):
        n = (k + 1) % 6
        faces += [(k, n, n + 6), (k, n + 6, k + 6)]
    mesh = trimesh.Trimesh(vertices, faces)
    mesh.fix_normals()
    return mesh


@pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")
@pytest.mark.parametrize("name", sorted(path.name for path in MESHES.glob("*.stl")))
def test_pieces_of_the_ur10_contain_its_meshes(name: str) -> None:
    mesh = trimesh.load_mesh(MESHES / name)
    pieces = convex_pieces(MESHES / name, ONES)
    points, _ = trimesh.sample.sample_surface(mesh, 3000, seed=1)
    assert outside(np.vstack([points, mesh.vertices]), pieces).max() < 1e-9
    hull_volume = ConvexHull(mesh.vertices).volume
    assert sum(ConvexHull(piece.vertices).volume for piece in pieces) < 1.3 * hull_volume


def test_a_concave_mesh_is_cut_at_its_corner(tmp_path: Path) -> None:
    path = tmp_path / "angle.stl"
    mesh = angle_profile()
    mesh.export(path)
    pieces = convex_pieces(path, ONES)
    volume = sum(ConvexHull(piece.vertices).volume for piece in pieces)
    assert mesh.is_watertight
    assert volume < 1.5 * mesh.volume < ConvexHull(mesh.vertices).volume
    block = np.random.default_rng(4).uniform(0.0, (1.0, 1.0, 0.5), (4000, 3))
    inside = block[(block[:, 0] < 0.1) | (block[:, 1] < 0.1)]
    surface, _ = trimesh.sample.sample_surface(mesh, 3000, seed=2)
    assert outside(np.vstack([inside, surface, mesh.vertices]), pieces).max() < 1e-9


def test_faces_of_a_hull_point_outwards() -> None:
    (hull,) = convex_pieces(MESHES / "base.stl", ONES)
    corners = hull.vertices[hull.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.einsum("ij,ij->i", normals, corners[:, 0] - hull.vertices.mean(axis=0))
    assert np.all(outward > 0.0)


@pytest.mark.parametrize("scale", [(0.5, 1.0, 2.0), (-1.0, 1.0, 1.0)])
def test_the_scale_is_applied(tmp_path: Path, scale: tuple[float, float, float]) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((1.0, 2.0, 3.0)).export(path)
    (hull,) = convex_pieces(path, np.array(scale))
    assert np.ptp(hull.vertices, axis=0) == pytest.approx(np.abs(scale) * (1.0, 2.0, 3.0))


def test_a_mesh_with_holes_is_used_as_its_hull_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "open.stl"
    mesh = angle_profile()
    mesh.update_faces(np.arange(len(mesh.faces)) > 2)
    mesh.export(path)
    with pytest.warns(CollisionModelWarning) as said:
        (hull,) = convex_pieces(path, ONES)
    assert len(said) == 1
    assert ConvexHull(hull.vertices).volume == pytest.approx(ConvexHull(mesh.vertices).volume)


@given(st.lists(lengths, min_size=3, max_size=3), st.integers(0, 319))
def test_a_hole_of_a_part_that_is_never_cut_changes_nothing(scale: list[float], hole: int) -> None:
    """A warning would be an error."""
    closed = trimesh.creation.icosphere(subdivisions=2).apply_scale(scale)
    torn = closed.copy()
    torn.update_faces(np.arange(len(torn.faces)) != hole)
    with warnings.catch_warnings():
        warnings.simplefilter("error", CollisionModelWarning)
        found, whole = (cut(mesh, Path("part.stl")) for mesh in (torn, closed))
    assert (found.open_parts, whole.open_parts) == (1, 0)
    ((one,), (other,)) = found.hulls, whole.hulls
    np.testing.assert_allclose(np.sort(one.vertices, axis=0), np.sort(other.vertices, axis=0))


def stl(mesh: trimesh.Trimesh) -> bytes:
    return bytes(trimesh.exchange.stl.export_stl(mesh))


def flat() -> bytes:
    return stl(trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]))


def loose(count: int) -> bytes:
    """So many triangles, each on its own."""
    rng = np.random.default_rng(5)
    corners = rng.uniform(-0.5, 0.5, (count, 1, 3)) + rng.normal(0.0, 0.01, (count, 3, 3))
    faces = np.arange(3 * count).reshape(-1, 3)
    return stl(trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False))


@pytest.mark.filterwarnings("ignore:.*not watertight")
def test_a_housing_with_thousands_of_screws_is_read(tmp_path: Path) -> None:
    """Large parts keep their own pieces; one hull, said so, is around all small ones."""
    rng = np.random.default_rng(3)
    housing = trimesh.creation.box((0.4, 0.2, 0.1))
    screw = trimesh.creation.box((0.004, 0.004, 0.004))
    places = rng.uniform([-0.2, -0.1, 0.05], [0.2, 0.1, 0.07], (600, 3))
    screws = [screw.copy().apply_translation(place) for place in places]
    whole = trimesh.util.concatenate([housing, *screws])
    assert isinstance(whole, trimesh.Trimesh)
    (tmp_path / "link.stl").write_bytes(stl(whole))
    with pytest.warns(CollisionModelWarning, match="601 .* 577 "):
        pieces = convex_pieces(tmp_path / "link.stl", np.ones(3))
    assert len(pieces) <= 25
    planes = [ConvexHull(piece.vertices).equations for piece in pieces]
    inside = [
        np.all(whole.vertices @ each[:, :3].T + each[:, 3] <= 1e-6, axis=1) for each in planes
    ]
    assert np.any(inside, axis=0).all()
    top = max(float(piece.vertices[:, 2].max()) for piece in pieces)
    assert top <= whole.vertices[:, 2].max() + STAND_OUT + 1e-5


def archive() -> bytes:
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        file.writestr("box.stl", stl(trimesh.creation.box((0.1, 0.1, 0.1))))
    return content.getvalue()


def promising(kind: str) -> bytes:
    """A header that promises more than there is."""
    return (
        f"ply\nformat {kind} 1.0\nelement vertex 1000000000\nproperty double x\n"
        "property double y\nproperty double z\nelement face 1000000000\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0\n"
    ).encode()


def endless(begin: str, piece: str) -> bytes:
    return (begin + piece * 1_600_000).encode()


def encoded(encoding: str) -> bytes:
    """Entities that an encoding hides."""
    return f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE a><COLLADA/>'.encode(encoding)


EMPTY, FORMAT, LARGER = "empty-mesh", "mesh-format", "mesh-too-large"
NO_NUMBER = b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"
ENTITY = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><COLLADA>&b;</COLLADA>'
LARGE = trimesh.creation.box((300.0, 200.0, 100.0))


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("m.stl", flat, "flat-mesh"),
        ("m.stl", lambda: b"solid nothing\nendsolid nothing\n", EMPTY),
        ("m.stl", lambda: b"not a mesh at all", EMPTY),
        ("m.stl", lambda: stl(LARGE), "mesh-too-far"),
        ("m.stl", lambda: loose(190_000), LARGER),
        *((f"m.{kind}", archive, FORMAT) for kind in ("zip", "ply", "glb")),
        ("m.stl", archive, EMPTY),
        ("m.ply", lambda: promising("ascii"), EMPTY),
        ("m.ply", lambda: promising("binary_little_endian"), FORMAT),
        ("m.obj", lambda: NO_NUMBER, "not-finite"),
        ("m.dae", lambda: ENTITY, "document-type"),
        ("m.dae", lambda: encoded("utf-16"), "not-utf-8"),
        ("m.dae", lambda: encoded("utf-7"), "encoding"),
        ("m.obj", lambda: endless("v 0 0 0\n", "f 1 1 1\n"), LARGER),
        ("m.obj", lambda: endless("v 0 0 0\nf ", "1\u00a0"), LARGER),
        ("m.off", lambda: endless("OFF\n9 9 0\n", "0 0 0\n"), LARGER),
        (
            "m.ply",
            lambda: endless("ply\nformat ascii 1.0\ncomment binary\n", "0 0 0\n"),
            LARGER,
        ),
        ("m.dae", lambda: endless("<COLLADA>", "<a/>"), LARGER),
        ("m.dae", lambda: endless("<COLLADA>", "<a b='' c=''/>"), LARGER),
    ],
)
def test_unusable_meshes_are_told_at_once(
    tmp_path: Path, name: str, content: Callable[[], bytes], code: str
) -> None:
    (tmp_path / name).write_bytes(content())
    with soon(), refused(CollisionModelError, code, f"{name}: "):
        convex_pieces(tmp_path / name, ONES)


def test_what_is_missing_or_a_pipe_is_named(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    for name, code in (("gone.stl", "unreadable"), ("pipe.stl", "no-regular-file")):
        with refused(CollisionModelError, code, name):
            convex_pieces(tmp_path / name, ONES)


@pytest.mark.parametrize("scale", [(1e308, 1.0, 1.0), (-1e308, 1e308, 1e308)])
def test_a_scale_beyond_all_bounds_is_told(
    tmp_path: Path, scale: tuple[float, float, float]
) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((20.0, 20.0, 20.0)).export(path)
    with refused(CollisionModelError, "mesh-too-far"):
        convex_pieces(path, np.array(scale))


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{unit}"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 1 0 0 0 2 0 0 0 3</float_array>
<technique_common><accessor source="#a" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><matrix>{matrix}</matrix>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.mark.parametrize("unit", [1.0, 0.01])
@pytest.mark.parametrize("up", ["Z_UP", "Y_UP"])
def test_collada_units_and_transforms_count_and_its_up_axis_does_not(
    tmp_path: Path, unit: float, up: str
) -> None:
    path = tmp_path / "shape.dae"
    matrix = "0 -1 0 5  1 0 0 0  0 0 1 0  0 0 0 1"
    path.write_text(COLLADA.format(unit=unit, up=up, matrix=matrix), encoding="utf-8")
    (hull,) = convex_pieces(path, np.array([1.0, 1.0, 2.0]))
    corners = np.array([[5, 0, 0], [5, 1, 0], [3, 0, 0], [5, 0, 6]]) * unit
    found = hull.vertices[np.lexsort(hull.vertices.T)]
    assert found == pytest.approx(corners[np.lexsort(corners.T)], abs=1e-12)


@pytest.mark.parametrize("form", ["stl", "obj", "dae"])
def test_every_form_of_a_mesh_gives_the_same_pieces(tmp_path: Path, form: str) -> None:
    mesh = angle_profile()
    path = tmp_path / f"angle.{form}"
    mesh.export(path)
    pieces = convex_pieces(path, ONES)
    volume = sum(ConvexHull(piece.vertices).volume for piece in pieces)
    mesh.export(tmp_path / "angle.ply")
    expected = convex_pieces(tmp_path / "angle.ply", ONES)
    assert volume == pytest.approx(sum(ConvexHull(p.vertices).volume for p in expected), rel=1e-5)
