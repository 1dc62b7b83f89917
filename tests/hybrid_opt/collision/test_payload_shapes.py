"""Payloads of any shape, and verdicts before FCL is asked."""

from __future__ import annotations

import ctypes
import subprocess
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import fcl
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hybrid_opt.collision.judge import fcl_object
from hybrid_opt.evaluate.kernel import PROOF_MARGIN, shape_table
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.pieces import ConvexShape, Hull, Piece, reach, shrunk
from symbolic.records import Box, Capsule, Cylinder, Mesh, Sphere, Workcell
from tests.hybrid_opt.collision.test_checker import checker_of, coal_mask, collision_mask
from tests.symbolic.geometry.collision_cells import (
    rack,
    random_configurations,
    true_distances,
)

RESOLUTION = 1e-5
SHAPES = ("cylinder", "mesh")


def angle_mesh(folder: Path) -> Mesh:
    """An L of two boards, which is cut into convex pieces."""
    boards = [
        trimesh.creation.box(extents=[0.3, 0.36, 0.05]),
        trimesh.creation.box(extents=[0.05, 0.36, 0.2]),
    ]
    boards[0].apply_translation([0.0, 0.0, -0.1])
    boards[1].apply_translation([-0.125, 0.0, 0.025])
    path = folder / "angle.stl"
    (boards[0] + boards[1]).export(path)
    return Mesh(path, np.ones(3))


def geometry(kind: str, folder: Path) -> CellGeometry:
    """The rack cell with another payload."""
    cell: Workcell = rack()
    shape = Cylinder(0.14, 0.25) if kind == "cylinder" else angle_mesh(folder)
    return build_geometry(replace(cell, payload=replace(cell.payload, shape=shape)))


@pytest.mark.parametrize("kind", SHAPES)
def test_agrees_with_coal_and_bounds_stay_below(kind: str, tmp_path: Path) -> None:
    cell = geometry(kind, tmp_path)
    at = random_configurations(cell, 40, np.random.default_rng(4))
    judge = checker_of(cell)
    ours, theirs = collision_mask(judge, *at), coal_mask(cell, at)
    payload = [k for k, names in enumerate(cell.pair_names) if "payload" in names]
    assert ours[:, payload].any()
    bounds = judge.bounds(*at)
    for k, row in enumerate(zip(*at, strict=True)):
        apart = true_distances(cell, *row)
        assert np.abs(apart[ours[k] != theirs[k]]).max(initial=0.0) < RESOLUTION
        assert (bounds[k] <= apart + RESOLUTION).all()


@given(by=st.floats(1e-4, 5e-3), seed=st.integers(0, 2**31))
def test_shrinks_on_every_side(by: float, seed: int) -> None:
    """In every direction across a face by the length, or by more."""
    rng = np.random.default_rng(seed)
    box = trimesh.creation.box(extents=rng.uniform(0.05, 0.4, 3))
    hull = Hull(np.asarray(box.vertices, dtype=float), np.asarray(box.faces, dtype=np.int64))
    axes = np.vstack([np.eye(3), -np.eye(3)])
    for shape, least in ((hull, True), (Box(np.array([0.1, 0.2, 0.3])), False)):
        smaller = shrunk(Piece(shape, np.eye(4)), by).shape
        less = reach(shape, axes) - reach(smaller, axes)
        assert (less >= by * (1.0 - 1e-9)).all()
        if not least:
            np.testing.assert_allclose(less, by, rtol=1e-9)
    drum = Cylinder(0.1, 0.2)
    less = reach(drum, axes) - reach(shrunk(Piece(drum, np.eye(4)), by).shape, axes)
    np.testing.assert_allclose(less, by, rtol=1e-9)


APART, OPEN, INTERSECTING = 1, 0, -1

WRAPPER = """
#include <math.h>
#include <string.h>
{}
int check(const shape* shapes, const placed* at, const double* vertices, double margin) {{
  return prejudge_shapes(shapes, at, shapes + 1, at + 1, vertices, margin, margin);
}}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("prejudge")
    own = files("hybrid_opt").joinpath("collision", "prejudge.c").read_text()
    source: Path = folder / "prejudge.c"
    source.write_text(WRAPPER.format(own))
    built = folder / "prejudge.so"
    command = ["cc", "-O1", "-shared", "-fPIC", "-o", str(built), str(source), "-lm"]
    subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(built))
    loaded.check.argtypes = [ctypes.c_void_p] * 3 + [ctypes.c_double]
    return loaded


def check(library: ctypes.CDLL, first: Piece, second: Piece, margin: float = PROOF_MARGIN) -> int:
    shapes, vertices = shape_table([first.shape, second.shape])
    placed = np.concatenate([np.append(p.rotation.ravel(), p.centre) for p in (first, second)])
    return int(library.check(shapes.ctypes.data, placed.ctypes.data, vertices.ctypes.data, margin))


def random_shape(rng: np.random.Generator) -> ConvexShape:
    size = rng.uniform(0.02, 0.5, 3)
    match rng.integers(5):
        case 0:
            return Box(size)
        case 1:
            return Cylinder(size[0], size[1])
        case 2:
            return Sphere(size[0])
        case 3:
            return Capsule(size[0], size[1])
    points = rng.uniform(-0.5, 0.5, (int(rng.integers(4, 25)), 3)) * size
    hull = ConvexHull(points)
    outward = [
        face if np.linalg.det(points[face] - points.mean(axis=0)) > 0.0 else face[::-1]
        for face in hull.simplices
    ]
    return Hull(points, np.array(outward))


def placed(shape: ConvexShape, rng: np.random.Generator, centre: Array) -> Piece:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = centre
    return Piece(shape, pose)


def test_proofs_never_contradict_fcl(library: ctypes.CDLL) -> None:
    rng = np.random.default_rng(0)
    counts = {APART: 0, OPEN: 0, INTERSECTING: 0}
    request = fcl.CollisionRequest()
    for _ in range(4000):
        first = placed(random_shape(rng), rng, rng.uniform(-1.0, 1.0, 3))
        off = rng.standard_normal(3) * 10.0 ** rng.uniform(-2.0, -0.2)
        second = placed(random_shape(rng), rng, first.centre + off)
        found = check(library, first, second)
        counts[found] += 1
        hit = fcl.collide(fcl_object(first), fcl_object(second), request) > 0
        if found != OPEN:
            assert hit == (found == INTERSECTING)
    # Coaxial and concentric ones, whose simplices are flat.
    assert counts[OPEN] < 0.25 * 4000
    assert min(counts[APART], counts[INTERSECTING]) > 800


def test_margins_are_kept(library: ctypes.CDLL) -> None:
    """Two spheres and two boxes face to face, whose distance is known."""
    rng = np.random.default_rng(1)
    margin = 1e-3
    for _ in range(300):
        distance = rng.uniform(-3e-3, 3e-3)
        a, b = rng.uniform(0.05, 0.4, 2)
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        spheres = [
            placed(Sphere(a), rng, np.zeros(3)),
            placed(Sphere(b), rng, (a + b + distance) * direction),
        ]
        R = Rotation.random(random_state=rng).as_matrix()
        boxes = []
        for half, along in ((a, 0.0), (b, a + b + distance)):
            pose = np.eye(4)
            pose[:3, :3] = R
            pose[:3, 3] = R @ np.array([along, rng.uniform(-0.02, 0.02), 0.0])
            boxes.append(Piece(Box(2.0 * np.array([half, 0.2, 0.3])), pose))
        for first, second in (spheres, boxes):
            found = check(library, first, second, margin)
            if distance <= margin:
                assert found != APART
            if distance >= -margin:
                assert found != INTERSECTING
            if distance > margin + 1e-6:
                assert found == APART


@pytest.mark.parametrize("centre", [np.full(3, np.nan), np.full(3, np.inf)])
def test_no_answer_to_what_is_no_pose(library: ctypes.CDLL, centre: Array) -> None:
    rng = np.random.default_rng(2)
    first = placed(Box(np.full(3, 0.2)), rng, np.zeros(3))
    second = placed(Box(np.full(3, 0.2)), rng, centre)
    assert check(library, first, second) == OPEN
