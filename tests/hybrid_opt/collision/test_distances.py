"""Compiled distances and verdicts of convex pieces, against FCL, Coal and a quadratic program."""

from __future__ import annotations

from collections.abc import Sequence

import clarabel
import coal
import fcl
import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybrid_opt.collision.checker import PROOF_MARGIN
from hybrid_opt.collision.distances import (
    APART,
    INTERSECTING,
    OPEN,
    compiled_distances,
    shape_table,
)
from hybrid_opt.collision.judge import fcl_object
from symbolic.array import Array
from symbolic.geometry.hulls import hull_of
from symbolic.geometry.pairs import coal_distance, coal_geometry
from symbolic.geometry.pieces import ConvexShape, Hull, Piece
from symbolic.records import Box, Capsule, Cylinder, Sphere


class Pairs:
    """Pieces in pairs, the first of each with the second of it."""

    def __init__(self, pairs: Sequence[tuple[Piece, Piece]]) -> None:
        pieces = [piece for pair in pairs for piece in pair]
        index = np.arange(len(pieces))
        table = shape_table([piece.shape for piece in pieces])
        self.bodies = compiled_distances().Bodies(*table, np.append(index, len(pieces)), index)
        turned = Rotation.from_matrix(np.array([piece.rotation for piece in pieces]))
        self.quaternions = turned.as_quat(scalar_first=True)[None]
        self.positions = np.array([piece.centre for piece in pieces])[None]
        self.queries = np.zeros(len(pairs), dtype=np.int64), index[::2], index[1::2]

    def decide(self, margin: float) -> NDArray[np.int8]:
        least = np.full(len(self.queries[0]), margin)
        found: NDArray[np.int8] = self.bodies.decide(
            self.quaternions, self.positions, *self.queries, least, least
        )
        return found

    def bounds(self) -> tuple[Array, Array]:
        lower, upper = self.bodies.distances(self.quaternions, self.positions, *self.queries)
        return lower, upper


def random_shape(rng: np.random.Generator, kinds: int = 5) -> ConvexShape:
    size = rng.uniform(0.02, 0.5, 3)
    match rng.integers(kinds):
        case 1:
            return Box(size)
        case 2:
            return Cylinder(size[0], size[1])
        case 3:
            return Sphere(size[0])
        case 4:
            return Capsule(size[0], size[1])
    return hull_of(rng.standard_normal((int(rng.integers(4, 120)), 3)) * size / 3.0)


def placed(shape: ConvexShape, rng: np.random.Generator, centre: Array) -> Piece:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = centre
    return Piece(shape, pose)


def random_pair(rng: np.random.Generator, shapes: Sequence[ConvexShape]) -> tuple[Piece, Piece]:
    first, second = (shapes[k] for k in rng.integers(len(shapes), size=2))
    centre = rng.uniform(-1.0, 1.0, 3)
    off = rng.standard_normal(3) * 10.0 ** rng.uniform(-2.0, -0.2)
    return placed(first, rng, centre), placed(second, rng, centre + off)


@pytest.mark.parametrize(
    ("kinds", "n"), [(5, 3000), (1, 3000), pytest.param(1, 10**6, marks=pytest.mark.slow)]
)
def test_verdicts_are_those_of_fcl(kinds: int, n: int) -> None:
    """Of any shapes, and of hulls alone; and only what is near contact stays open."""
    rng, request = np.random.default_rng(kinds), fcl.CollisionRequest()
    counts = {APART: 0, OPEN: 0, INTERSECTING: 0}
    for _ in range(0, n, 1000):
        shapes = [random_shape(rng, kinds) for _ in range(40)]
        pairs = [random_pair(rng, shapes) for _ in range(1000)]
        known = Pairs(pairs)
        (lower, upper), verdicts = known.bounds(), known.decide(PROOF_MARGIN)
        for k, (first, second) in enumerate(pairs):
            counts[int(verdicts[k])] += 1
            if verdicts[k] == OPEN:
                assert lower[k] <= PROOF_MARGIN
                assert upper[k] >= -PROOF_MARGIN
                continue
            hit = fcl.collide(fcl_object(first), fcl_object(second), request) > 0
            assert hit == (verdicts[k] == INTERSECTING)
    assert counts[OPEN] <= 0.01 * n
    assert min(counts[APART], counts[INTERSECTING]) > 0.2 * n


def quadratic_distance(first: Piece, second: Piece) -> float:
    """The distance of two hulls: the shortest difference of convex combinations of corners."""
    corners = [
        piece.shape.vertices @ piece.rotation.T + piece.centre
        for piece in (first, second)
        if isinstance(piece.shape, Hull)
    ]
    difference = np.vstack([corners[0], -corners[1]])
    n = len(difference)
    sums = np.zeros((2, n))
    sums[0, : len(corners[0])] = sums[1, len(corners[0]) :] = 1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-14
    solver = clarabel.DefaultSolver(
        sp.csc_matrix(np.triu(difference @ difference.T)),
        np.zeros(n),
        sp.csc_matrix(np.vstack([sums, -np.eye(n)])),
        np.concatenate([np.ones(2), np.zeros(n)]),
        [clarabel.ZeroConeT(2), clarabel.NonnegativeConeT(n)],
        settings,
    )
    weights = np.array(solver.solve().x)
    return float(np.linalg.norm(difference.T @ weights))


@pytest.mark.parametrize("kinds", [1, 5])
def test_distances_are_those_of_coal_and_of_a_quadratic_program(kinds: int) -> None:
    rng = np.random.default_rng(10 + kinds)
    pairs = [random_pair(rng, [random_shape(rng, kinds) for _ in range(2)]) for _ in range(600)]
    lower, upper = Pairs(pairs).bounds()
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = 1e-9
    apart = 0
    for k, (first, second) in enumerate(pairs):
        result.clear()
        both = (*coal_geometry(first), *coal_geometry(second))
        expected = coal.distance(*both, request, result)
        if expected <= 1e-6:
            assert lower[k] <= 1e-6
            continue
        apart += 1
        assert lower[k] == pytest.approx(expected, abs=1e-7)
        assert upper[k] == pytest.approx(expected, abs=1e-7)
        assert lower[k] <= upper[k] + 1e-9  # GJK's projections on flat simplices round
        if kinds == 1 and apart < 60:
            assert lower[k] == pytest.approx(quadratic_distance(first, second), abs=1e-6)
    assert apart > 100


def test_several_pieces_are_as_far_apart_as_the_nearest_two() -> None:
    """Bodies of many pieces, at many placements, which share their starts."""
    rng = np.random.default_rng(4)
    pieces = [placed(random_shape(rng), rng, rng.uniform(-0.5, 0.5, 3)) for _ in range(9)]
    first_piece = np.array([0, 4, 9])
    bodies = compiled_distances().Bodies(
        *shape_table([piece.shape for piece in pieces]), first_piece, np.arange(9)
    )
    n = 300
    away = np.outer(np.linspace(0.0, 1.5, n), [1.0, 0.3, -0.2])
    turned = Rotation.from_matrix(np.array([piece.rotation for piece in pieces]))
    quaternions = np.tile(turned.as_quat(scalar_first=True), (n, 1, 1))
    positions = np.tile([piece.centre for piece in pieces], (n, 1, 1))
    positions[:, 4:] += away[:, None]
    queries = np.arange(n), np.zeros(n, dtype=np.int64), np.ones(n, dtype=np.int64)
    lower, upper = bodies.distances(quaternions, positions, *queries)
    margin = np.full(n, PROOF_MARGIN)
    verdicts = bodies.decide(quaternions, positions, *queries, margin, margin)
    for k in range(n):
        T = np.eye(4)
        T[:3, 3] = away[k]
        moved = tuple(piece.moved(T) for piece in pieces[4:])
        expected = coal_distance(tuple(pieces[:4]), moved)
        if expected > 1e-6:
            np.testing.assert_allclose([lower[k], upper[k]], expected, rtol=2e-6, atol=2e-6)
        if abs(expected) > 2.0 * PROOF_MARGIN:
            assert verdicts[k] == (APART if expected > 0.0 else INTERSECTING)
    assert {APART, INTERSECTING} <= set(verdicts.tolist())


def test_margins_are_kept() -> None:
    """Two spheres and two boxes face to face, whose distance is known."""
    rng = np.random.default_rng(1)
    margin, pairs, distances = 1e-3, [], []
    for _ in range(300):
        distance = rng.uniform(-3e-3, 3e-3)
        a, b = rng.uniform(0.05, 0.4, 2)
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        pairs.append(
            (
                placed(Sphere(a), rng, np.zeros(3)),
                placed(Sphere(b), rng, (a + b + distance) * direction),
            )
        )
        R = Rotation.random(random_state=rng).as_matrix()
        boxes = []
        for half, along in ((a, 0.0), (b, a + b + distance)):
            pose = np.eye(4)
            pose[:3, :3] = R
            pose[:3, 3] = R @ np.array([along, rng.uniform(-0.02, 0.02), 0.0])
            boxes.append(Piece(Box(2.0 * np.array([half, 0.2, 0.3])), pose))
        pairs.append((boxes[0], boxes[1]))
        distances += [distance, distance]
    for found, distance in zip(Pairs(pairs).decide(margin).tolist(), distances, strict=True):
        if distance <= margin:
            assert found != APART
        if distance >= -margin:
            assert found != INTERSECTING
        if abs(distance) > margin + 1e-5:
            assert found != OPEN


@pytest.mark.parametrize("centre", [np.full(3, np.nan), np.full(3, np.inf)])
def test_no_answer_to_what_is_no_pose(centre: Array) -> None:
    rng = np.random.default_rng(2)
    known = Pairs(
        [
            (placed(one, rng, np.zeros(3)), placed(one, rng, centre))
            for one in (Box(np.full(3, 0.2)), random_shape(rng, 1))
        ]
    )
    assert known.decide(PROOF_MARGIN).tolist() == [OPEN, OPEN]
    lower, upper = known.bounds()
    assert np.isneginf(lower).all()
    assert np.isposinf(upper).all()
    # Nor where the sample before found a direction.
    positions = np.repeat(known.positions, 2, axis=0)
    positions[0, 1::2] = 2.0
    quaternions = np.repeat(known.quaternions, 2, axis=0)
    least, rows = np.full(2, PROOF_MARGIN), np.arange(2)
    for pair in range(2):
        queries = rows, np.full(2, 2 * pair), np.full(2, 2 * pair + 1)
        found = known.bodies.decide(quaternions, positions, *queries, least, least)
        assert found.tolist() == [APART, OPEN]
