"""Payloads that are no boxes: their collisions against Coal, bounds, resting, shrinking."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.collision.checker import RESTING_TOLERANCE
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.pieces import Hull, Piece, reach, shrunk
from symbolic.records import AllowedContact, Box, Cylinder, Mesh, Workcell
from tests.hybrid_opt.collision.test_checker import checker_of, coal_mask
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
    ours, theirs = judge.collision_mask(*at), coal_mask(cell, at)
    payload = [k for k, names in enumerate(cell.pair_names) if "payload" in names]
    assert ours[:, payload].any()
    bounds = judge.bounds(*at)
    for k, row in enumerate(zip(*at, strict=True)):
        apart = true_distances(cell, *row)
        assert np.abs(apart[ours[k] != theirs[k]]).max(initial=0.0) < RESOLUTION
        assert (bounds[k] <= apart + RESOLUTION).all()


def test_the_mesh_is_more_than_one_piece_and_less_than_its_hull(tmp_path: Path) -> None:
    cell = geometry("mesh", tmp_path)
    (payload,) = (body for body in cell.bodies if body.name == "payload")
    assert len(payload.pieces) == 2
    corner = np.array([0.1, 0.0, 0.1])  # within the hull of the L, beside its boards
    inside = [
        bool((piece.shape.vertices.min(axis=0) < corner).all())
        and bool((corner < piece.shape.vertices.max(axis=0)).all())
        for piece in payload.pieces
        if isinstance(piece.shape, Hull)
    ]
    assert inside == [False, False]


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


@pytest.mark.parametrize("kind", SHAPES)
def test_may_rest_where_it_is_allowed_to(kind: str, tmp_path: Path) -> None:
    """The payload stands with its lowest face on a board."""
    cell = geometry(kind, tmp_path).workcell
    board = cell.environment[0].name
    body = next(b for b in cell.environment if b.name == board)
    assert isinstance(body.shape, Box)
    standing = np.zeros(6)
    standing[:3] = body.pose[:3, 3]
    standing[2] += body.shape.size[2] / 2.0 + 0.125
    task = cell.task
    start = replace(task.waypoints[0], lower=standing, upper=standing)
    task = replace(
        task,
        waypoints=(start, *task.waypoints[1:]),
        allowed_contacts=(AllowedContact(board, 0.05),),
    )
    judge = checker_of(build_geometry(replace(cell, task=task)))
    pair = judge.geometry.pair_names.index(("payload", board))
    still = np.zeros((2, 6))
    deep = standing - [0.0, 0.0, 2.0 * RESTING_TOLERANCE, 0.0, 0.0, 0.0]
    found = judge.collisions(np.array([standing, deep]), still, still, [0, 1], [pair, pair])
    assert found == [False, True]
