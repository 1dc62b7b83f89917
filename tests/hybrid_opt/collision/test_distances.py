"""Compiled distances and verdicts of convex pieces, against FCL, Coal and a quadratic program."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import clarabel
import coal
import fcl
import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybrid_opt.collision.checker import APART, INTERSECTING, OPEN, PROOF_MARGIN
from hybrid_opt.collision.solids import compiled_distances, fcl_object, shape_table
from symbolic.array import Array
from symbolic.geometry.bodies import collision_bodies
from symbolic.geometry.hulls import hull_of
from symbolic.geometry.pieces import ConvexShape, Hull, Piece
from symbolic.geometry.separation import coal_distance, coal_geometry
from symbolic.records import Box, Capsule, Cylinder, Sphere
from tests.hybrid_opt.cells import shipped
from tests.symbolic.geometry.collision_cells import ur10_cell


class Pairs:
    """Pieces in pairs, the first of each with the second of it; a shape that is shared is one."""

    def __init__(self, pairs: Sequence[tuple[Piece, Piece]]) -> None:
        shapes = {id(piece.shape): piece.shape for pair in pairs for piece in pair}
        place, n = {key: k for k, key in enumerate(shapes)}, len(shapes)
        # Every shape is two bodies, which are placed by the first and by the second of a pair.
        self.bodies = compiled_distances().Bodies(
            *shape_table(2 * list(shapes.values())), np.arange(2 * n + 1), np.repeat([0, 1], n)
        )
        pieces = [piece for pair in pairs for piece in pair]
        turned = Rotation.from_matrix(np.array([piece.rotation for piece in pieces]))
        self.quaternions = turned.as_quat(scalar_first=True).reshape(-1, 2, 4)
        self.positions = np.array([piece.centre for piece in pieces]).reshape(-1, 2, 3)
        first, second = np.array([place[id(piece.shape)] for piece in pieces]).reshape(-1, 2).T
        self.queries = np.arange(len(pairs)), first, n + second

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


@cache
def link_hulls() -> tuple[Hull, ...]:
    """Hulls of the links of Pandas, a TIAGo and UR10s, about the mean of their corners."""
    cells = shipped("pandas").workcell, shipped("tiago").workcell, ur10_cell()
    pieces = [piece for cell in cells for body in collision_bodies(cell) for piece in body.pieces]
    hulls = {id(piece.shape): piece.shape for piece in pieces if isinstance(piece.shape, Hull)}
    return tuple(Hull(h.vertices - h.vertices.mean(axis=0), h.faces) for h in hulls.values())


def some_shapes(kind: str, rng: np.random.Generator) -> list[ConvexShape]:
    if kind == "links":
        hulls = link_hulls()
        return [hulls[k] for k in rng.integers(len(hulls), size=40)]
    return [random_shape(rng, 5 if kind == "any" else 1) for _ in range(40)]


class FclPairs:
    """What FCL finds; its objects are made once for every shape."""

    def __init__(self) -> None:
        self._objects: dict[int, list[fcl.CollisionObject]] = {}
        self._request = fcl.CollisionRequest()

    def intersect(self, pair: tuple[Piece, Piece]) -> bool:
        objects = []
        for side, piece in enumerate(pair):
            known = self._objects.setdefault(id(piece.shape), [])
            while len(known) < 2:
                known.append(fcl_object(piece))
            known[side].setTransform(fcl.Transform(piece.rotation, piece.centre))
            objects.append(known[side])
        return bool(fcl.collide(*objects, self._request) > 0)


@pytest.mark.parametrize(
    ("kind", "n"),
    [
        ("any", 3000),
        ("hulls", 3000),
        ("links", 3000),
        pytest.param("hulls", 500_000, marks=pytest.mark.slow),
        pytest.param("links", 500_000, marks=pytest.mark.slow),
    ],
)
def test_verdicts_are_those_of_fcl(kind: str, n: int) -> None:
    """Of any shapes, of random hulls and of robots' links; and only what is near contact stays
    open. The nightly cases are 10^6 pairs of hulls together."""
    rng = np.random.default_rng(len(kind))
    counts = {APART: 0, OPEN: 0, INTERSECTING: 0}
    for _ in range(0, n, 1000):
        shapes = some_shapes(kind, rng)
        pairs = [random_pair(rng, shapes) for _ in range(1000)]
        known, judge = Pairs(pairs), FclPairs()
        (lower, upper), verdicts = known.bounds(), known.decide(PROOF_MARGIN)
        for k, pair in enumerate(pairs):
            counts[int(verdicts[k])] += 1
            if verdicts[k] == OPEN:
                assert lower[k] <= PROOF_MARGIN
                assert upper[k] >= -PROOF_MARGIN
            else:
                assert judge.intersect(pair) == (verdicts[k] == INTERSECTING)
    print(f"{kind}: {counts[APART]} apart, {counts[INTERSECTING]} intersect, {counts[OPEN]} open")
    assert counts[OPEN] <= 0.01 * n
    assert min(counts[APART], counts[INTERSECTING]) > 0.1 * n


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
    """Nor where the sample before found a direction."""
    rng = np.random.default_rng(2)
    for shape in (Box(np.full(3, 0.2)), random_shape(rng, 1)):
        still = placed(shape, rng, np.zeros(3))
        known = Pairs([(still, placed(shape, rng, at)) for at in (np.full(3, 2.0), centre)])
        assert known.decide(PROOF_MARGIN).tolist() == [APART, OPEN]
        lower, upper = known.bounds()
        assert np.isfinite([lower[0], upper[0]]).all()
        assert np.isneginf(lower[1])
        assert np.isposinf(upper[1])
