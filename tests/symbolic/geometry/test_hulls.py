"""Simplified hulls: few parts with few corners, which contain all that they stand for."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import numpy as np
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.geometry.bodies import MeshReader, _cut_file
from symbolic.geometry.hulls import (
    ROUNDOFF,
    SMALL_PART,
    STAND_OUT,
    _clip,
    _corners,
    cut,
    hull_of,
    simplify,
    thin,
)
from symbolic.geometry.pieces import Hull
from symbolic.read.meshes import read_mesh
from symbolic.records import Mesh


def placed(points: Array, seed: int) -> Hull:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    return hull_of(points @ turn.T + rng.uniform(-0.5, 0.5, 3))


def rod(sections: int, radius: float, length: float) -> Array:
    angle = 2.0 * np.pi * np.arange(sections) / sections
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    ends = [np.column_stack([ring, np.full(sections, z)]) for z in (0.0, length)]
    return np.concatenate(ends)


def pebble(count: int, size: tuple[float, float, float], seed: int) -> Array:
    """Points on an ellipsoid."""
    points = np.random.default_rng(seed).standard_normal((count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True) * size)


lengths = st.floats(0.002, 0.4)
seeds = st.integers(0, 10**6)
hulls = st.builds(
    placed,
    st.one_of(
        st.builds(rod, st.integers(3, 200), lengths, lengths),
        st.builds(pebble, st.integers(8, 300), st.tuples(lengths, lengths, lengths), seeds),
    ),
    seeds,
)


def contains(outer: Hull, inner: Hull) -> bool:
    planes = ConvexHull(outer.vertices).equations
    return bool(np.all(inner.vertices @ planes[:, :3].T + planes[:, 3] <= 10.0 * ROUNDOFF))


def distance(point: Array, hull: Hull) -> float:
    """Distance of a point from the convex combinations of a hull's corners."""
    heavy = 1e4  # of the row that makes the weights one together
    rows = np.vstack([hull.vertices.T - point[:, None], np.full(len(hull.vertices), heavy)])
    weights, _ = nnls(rows, np.array([0.0, 0.0, 0.0, heavy]))
    return float(np.linalg.norm(hull.vertices.T @ weights / weights.sum() - point))


@given(hulls)
def test_a_thinned_hull_contains_the_hull_and_stands_out_by_at_most_the_tolerance(
    hull: Hull,
) -> None:
    thinned = thin(hull)
    assert contains(thinned, hull)
    assert len(thinned.vertices) <= len(hull.vertices)
    some = thinned.vertices[:: max(1, len(thinned.vertices) // 20)]
    assert max(distance(point, hull) for point in some) <= STAND_OUT + 1e-9


def test_a_finely_divided_hull_is_thinned_and_a_coarse_one_is_left_as_it_is() -> None:
    fine, coarse = placed(rod(400, 0.03, 0.2), 1), placed(rod(12, 0.03, 0.2), 1)
    assert len(thin(fine).vertices) < 0.2 * len(fine.vertices)
    assert thin(coarse) is coarse


@given(st.lists(hulls, min_size=1, max_size=3), seeds)
def test_every_hull_is_in_one_of_the_simplified_ones(some: list[Hull], seed: int) -> None:
    """Also with copies, parts inside, and copies that are a little off."""
    first, shift = some[0], np.random.default_rng(seed).uniform(-1.0, 1.0, 3) * STAND_OUT / 4.0
    middle = first.vertices.mean(axis=0)
    inside = hull_of(middle + 0.5 * (first.vertices - middle))
    given_hulls = [*some, first, inside, Hull(first.vertices + shift, first.faces)]
    simple = simplify(given_hulls)
    assert len(simple) <= len(some) + 1
    for hull in given_hulls:
        assert any(contains(other, hull) for other in simple)


def test_a_copy_that_is_a_little_off_is_joined() -> None:
    hull = placed(rod(24, 0.05, 0.2), 3)
    moved = Hull(hull.vertices + 0.4 * STAND_OUT * np.array([0.6, 0.0, -0.8]), hull.faces)
    (joined,) = simplify([hull, moved])
    assert contains(joined, hull)
    assert contains(joined, moved)


def test_small_parts_share_a_hull_and_others_do_not() -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0)).vertices
    small = [hull_of(0.3 * SMALL_PART * box + [x, 0.0, 0.0]) for x in (0.0, 0.5 * SMALL_PART)]
    far = hull_of(0.3 * SMALL_PART * box + [0.1, 0.0, 0.0])
    large = [hull_of(0.05 * box + [0.0, y, 0.0]) for y in (0.2, 0.3)]
    simple = simplify([small[0], large[0], far, small[1], large[1]])
    assert [hull for hull in simple if any(hull is each for each in (far, *large))] == [
        large[0],
        far,
        large[1],
    ]
    (joined,) = (hull for hull in simple if not any(hull is each for each in (far, *large)))
    np.testing.assert_allclose(np.ptp(joined.vertices, axis=0), SMALL_PART * np.r_[0.8, 0.3, 0.3])


def test_the_pieces_of_a_mesh_are_simplified(tmp_path: Path) -> None:
    """A ball inside a housing, and a finely divided pin."""
    housing, pin = trimesh.creation.box((0.4, 0.2, 0.1)), trimesh.creation.cylinder(0.02, 0.3, 400)
    inside = trimesh.creation.icosphere(radius=0.04)
    parts = [housing, inside, pin]
    path = tmp_path / "link.stl"
    path.write_bytes(trimesh.exchange.stl.export_stl(trimesh.util.concatenate(parts)))
    found = cut(read_mesh(path, np.ones(3)), path)
    assert found.parts == len(parts)
    assert found.faces == sum(len(part.faces) for part in parts)
    assert found.vertices == sum(len(part.vertices) for part in parts)
    counts = [len(hull.vertices) for hull in found.hulls]
    assert counts[0] == 8
    assert len(counts) == 2
    assert counts[1] < 0.2 * len(pin.vertices)


def test_threads_decompose_a_mesh_once_and_again_when_its_file_changes(tmp_path: Path) -> None:
    path, together = tmp_path / "part.stl", Barrier(4)
    mesh = Mesh(path, np.ones(3))

    def corners(_: int) -> Array:
        together.wait()
        (hull,) = MeshReader().hulls(mesh)
        return hull.vertices

    def found(radius: float) -> tuple[list[Array], int]:
        trimesh.creation.icosphere(4, radius).export(path)
        before = _cut_file.cache_info().misses
        with ThreadPoolExecutor(4) as pool:
            return list(pool.map(corners, range(4))), _cut_file.cache_info().misses - before

    small, large = found(0.1), found(0.25)
    assert (small[1], large[1]) == (1, 1)
    for several, radius in ((small[0], 0.1), (large[0], 0.25)):
        for each in several:
            reach = np.linalg.norm(each, axis=1)
            assert radius - 1e-6 <= reach.max() <= radius + 1e-3


def test_the_corners_of_a_half_span_the_hull_of_its_triangles() -> None:
    mesh = trimesh.creation.torus(0.2, 0.05, 24, 12)
    triangles = np.asarray(mesh.triangles)
    for axis, level, side in ((0, 0.03, 1.0), (1, -0.1, -1.0), (2, 0.0, 1.0)):
        points = _corners(np.asarray(mesh.vertices), triangles, axis, level, side)
        half = _clip(triangles, axis, level, side).reshape(-1, 3)
        volumes = [ConvexHull(part).volume for part in (points, half)]
        assert np.isclose(volumes[0], volumes[1], rtol=1e-9)
        assert len(points) < len(half)
