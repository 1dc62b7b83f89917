"""Payloads of any shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.pieces import Hull, Piece, reach, shrunk
from symbolic.records import Box, Cylinder, Mesh, Workcell
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
