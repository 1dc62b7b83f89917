"""Convex pieces: supports, distances and covers against points of the shapes themselves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.covers import chain_cover, slab_cover
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
from tests.symbolic.geometry.collision_cells import geometry_of

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
    with pytest.raises(CollisionModelError, match="cannot be proven"):
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
        (Box(np.array([0.0, 1.0, 1.0])), r"size\[0\] is 0 m"),
        (Cylinder(0.0, 1.0), "radius is 0 m"),
        (Cylinder(0.1, -1.0), "length is -1 m"),
        (Sphere(float("nan")), "radius is nan m"),
        (Capsule(0.1, 0.0), "length is 0 m"),
    ],
)
def test_shapes_without_size_are_refused(shape: ConvexShape, word: str) -> None:
    with pytest.raises(CollisionModelError, match=f"'shelf'.*{word}.*correct the size"):
        check_piece(Piece(shape, np.eye(4)), "'shelf'")


def test_poses_that_are_no_poses_are_refused() -> None:
    with pytest.raises(CollisionModelError, match="not a rotation"):
        check_piece(Piece(Sphere(1.0), 2.0 * np.eye(4)), "'shelf'")
