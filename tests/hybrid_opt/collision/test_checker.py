"""The verdict: screened against unscreened FCL, FCL against Coal, tolerance, resting, touches."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import coal
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from codegen.interpreted import InterpretedFunction
from hybrid_opt.collision.between import (
    MotionVerdict,
    SampledMotions,
    check_all_between,
)
from hybrid_opt.collision.checker import RESTING_TOLERANCE, CollisionChecker, Verdict
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.separation import coal_distance, coal_geometry
from symbolic.records import AllowedContact, CollisionSettings, Uncertainty, Workcell
from tests.symbolic.geometry.collision_cells import (
    Configurations,
    functions_of,
    geometry_of,
    placed_pieces,
    rack,
    random_configurations,
    true_distances,
)


def collision_mask(
    checker: CollisionChecker, pose: Array, q_1: Array, q_2: Array
) -> NDArray[np.bool_]:
    """(n, n_pairs) FCL's answer for every pair of every sample, without screening and proofs;
    within a tolerance Coal's distance counts as well."""
    geometry = checker.geometry
    placed = checker.functions["piece_poses"].batch(pose, q_1, q_2)
    found = np.zeros((len(pose), len(geometry.active)), dtype=bool)
    for k, row in enumerate(zip(pose, q_1, q_2, strict=True)):
        resting = {
            pair
            for pair, place, departure in checker.resting_places
            if np.linalg.norm(pose[k, :3] - place) <= departure
        }
        for i, pair in enumerate(geometry.active):
            first = checker.distances.shrunk_payload if i in resting else pair.first
            found[k, i] = checker.judge.intersects(placed, k, first, pair.second)
        if geometry.tolerance.any():
            near = true_distances(geometry, *row) <= geometry.tolerance
            near[list(resting)] = False
            found[k] |= near
    return found


def unscreened(checker: CollisionChecker, at: Configurations) -> Verdict:
    """The verdict where no bound calls a pair free."""
    return checker.check(*at, np.minimum(checker.bounds(*at), checker.free_beyond))


def check_between(checker: CollisionChecker, configuration: Array) -> MotionVerdict:
    """One motion by its samples (n, 6 + all joints), without a margin."""
    clearance = checker.bounds(*checker.split(configuration))
    sampled = SampledMotions(configuration, clearance, (len(configuration),), np.zeros(1))
    return check_all_between(checker, sampled)[0]


pytestmark = pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")

RESOLUTION = 1e-5
"""FCL's and Coal's solvers agree within this [m]."""

STILL = np.zeros((1, 6))


def checker_of(geometry: CellGeometry) -> CollisionChecker:
    functions = functions_of(geometry)
    return CollisionChecker(
        geometry, {name: InterpretedFunction(f) for name, f in functions.items()}
    )


@cache
def checker(name: str, folder: Path = Path()) -> CollisionChecker:
    return checker_of(geometry_of(name, folder))


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.getbasetemp() / "checker"


def coal_mask(geometry: CellGeometry, at: Configurations) -> NDArray[np.bool_]:
    """(n, n_pairs) Coal's collisions, with bodies placed by numeric Pinocchio."""
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    mask = np.zeros((len(at[0]), len(geometry.active)), dtype=bool)
    for k, row in enumerate(zip(*at, strict=True)):
        shapes = [[coal_geometry(p) for p in body] for body in placed_pieces(geometry, *row)]
        for i, pair in enumerate(geometry.active):
            for a, T_a in shapes[pair.first]:
                for b, T_b in shapes[pair.second]:
                    result.clear()
                    mask[k, i] = mask[k, i] or coal.collide(a, T_a, b, T_b, request, result) > 0
    return mask


CELLS = pytest.mark.parametrize("name", ["rack", "obstacles", "ur10"])


@CELLS
@pytest.mark.parametrize("n", [250, pytest.param(10_000, marks=pytest.mark.slow)])
def test_fcl_agrees_with_coal(name: str, n: int, folder: Path) -> None:
    """They differ on no pair, but where the bodies are within their resolution."""
    geometry = geometry_of(name, folder)
    at = random_configurations(geometry, n, np.random.default_rng(31))
    ours, theirs = collision_mask(checker(name, folder), *at), coal_mask(geometry, at)
    assert ours.any()
    assert not ours.all()
    for k, i in np.argwhere(ours != theirs):
        pieces = placed_pieces(geometry, *(array[k] for array in at))
        pair = geometry.active[i]
        gap = coal_distance(pieces[pair.first], pieces[pair.second])
        assert abs(gap) < RESOLUTION, (geometry.pair_names[i], gap)


@CELLS
@pytest.mark.parametrize("n", [500, pytest.param(20_000, marks=pytest.mark.slow)])
def test_screening_changes_nothing(name: str, n: int, folder: Path) -> None:
    """Every sample's verdict and every cleared pair, against FCL on all pairs."""
    judge = checker(name, folder)
    at = random_configurations(judge.geometry, n, np.random.default_rng(33))
    bounds, mask = judge.bounds(*at), collision_mask(judge, *at)
    assert not np.any(mask & (bounds > RESOLUTION))
    before = judge.judge.calls
    screened, plain = judge.check(*at, bounds), unscreened(judge, at)
    assert screened.colliding.tolist() == plain.colliding.tolist() == mask.any(axis=1).tolist()
    assert screened.first_touch == plain.first_touch
    assert judge.judge.calls - before < 1e-3 * mask.size
    touch = screened.first_touch
    assert touch is not None
    names = judge.geometry.pair_names
    hit = [names[i] for i in np.flatnonzero(mask[touch.sample])]
    assert touch.sample == np.flatnonzero(mask.any(axis=1))[0]
    assert (touch.first, touch.second) in hit


@pytest.mark.parametrize("name", ["obstacles", "ur10"])
def test_measured_distances_are_those_of_coal(name: str, folder: Path) -> None:
    judge = checker(name, folder)
    at = random_configurations(judge.geometry, 60, np.random.default_rng(34))
    apart = ~collision_mask(judge, *at)
    measured = np.full(apart.shape, -1.0)
    assert judge.measure(*at, measured, apart).max() == -1
    expected = np.array([true_distances(judge.geometry, *row) for row in zip(*at, strict=True)])
    # Coal's own tolerance is 1e-6 of the distance.
    np.testing.assert_allclose(measured[apart], expected[apart], rtol=2e-6, atol=2e-6)
    assert np.all(measured[~apart] == -1.0)


def test_measuring_stops_at_a_collision() -> None:
    judge = checker("rack")
    at = random_configurations(judge.geometry, 30, np.random.default_rng(36))
    mask = collision_mask(judge, *at)
    hits = judge.measure(*at, judge.bounds(*at), np.ones(mask.shape, dtype=bool))
    assert (hits >= 0).tolist() == mask.any(axis=1).tolist()
    assert all(mask[k, hit] for k, hit in enumerate(hits) if hit >= 0)


def test_the_least_distance_is_found_past_the_bounds() -> None:
    judge = checker("rack")
    at = random_configurations(judge.geometry, 200, np.random.default_rng(35))
    free = ~judge.check(*at).colliding
    apart = (at[0][free], at[1][free], at[2][free])
    assert len(apart[0])
    bounds = judge.bounds(*apart)
    expected = np.array([true_distances(judge.geometry, *row) for row in zip(*apart, strict=True)])
    assert judge.min_distance(*apart, bounds) == pytest.approx(expected.min(), abs=RESOLUTION)
    assert np.argmin(bounds) != np.argmin(expected)


def above_board(gaps: list[float]) -> Configurations:
    """The box level above the middle board, both arms stretched upwards."""
    n = len(gaps)
    pose = np.zeros((n, 6))
    pose[:, 2] = 0.725 + np.array(gaps)
    return pose, np.zeros((n, 6)), np.zeros((n, 6))


def only_payload(cell: Workcell) -> CellGeometry:
    """The cell's geometry with the payload against the middle board alone."""
    geometry = build_geometry(cell)
    k = geometry.pair_names.index(("payload", "middle board"))
    return replace(geometry, active=(geometry.active[k],))


@pytest.mark.parametrize(("tolerance", "displaced"), [(0.0, 0.0), (0.003, 0.0), (0.001, 0.002)])
def test_the_tolerance_is_decided_alike_with_and_without_screening(
    tolerance: float, displaced: float
) -> None:
    """Gaps a hair below, at and above the tolerance: one judge, so one answer. Pads that may be
    displaced have the payload as much nearer."""
    cell = replace(
        rack(),
        collision=CollisionSettings(tolerance=tolerance),
        uncertainty=Uncertainty(pad_position=displaced),
    )
    judge = checker_of(only_payload(cell))
    offsets = [s * d for d in (1e-3, 2e-5, 1e-5, 1e-6, 1e-8, 0.0) for s in (-1.0, 1.0)]
    at = above_board([tolerance + displaced + offset for offset in offsets])
    screened = judge.check(*at).colliding
    assert screened.tolist() == unscreened(judge, at).colliding.tolist()
    for offset, hit in zip(offsets, screened, strict=True):
        if abs(offset) > RESOLUTION:
            assert hit == (offset < 0.0)


def test_only_the_payload_is_kept_farther_for_displaced_pads() -> None:
    """Arms are where they are told to be, whatever they took hold of."""
    settings = CollisionSettings(tolerance=0.001)
    cell = replace(rack(), collision=settings, uncertainty=Uncertainty(pad_position=0.002))
    geometry = build_geometry(cell)
    expected = [0.003 if "payload" in names else 0.001 for names in geometry.pair_names]
    np.testing.assert_allclose(geometry.tolerance, expected)
    assert {0.001, 0.003} == set(np.round(geometry.tolerance, 6).tolist())


@given(st.floats(-2e-5, 2e-5), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3.0, 3.0))
def test_touching_is_decided_alike_at_any_tilt(
    gap: float, roll: float, pitch: float, yaw: float
) -> None:
    judge = checker("rack")
    pose = np.array([[0.0, 0.0, 0.9, roll, pitch, yaw]])
    corner = judge.bounds(pose, STILL, STILL)
    k = judge.geometry.pair_names.index(("payload", "middle board"))
    pose[0, 2] -= corner[0, k] - gap
    at = (pose, STILL, STILL)
    assert judge.check(*at).colliding[0] == collision_mask(judge, *at).any()


def resting_cell(departure: float) -> Workcell:
    """The box starts on the middle board, and may touch it near there."""
    cell = rack()
    start = np.array([0.0, 0.0, 0.725, 0.0, 0.0, 0.0])
    waypoints = (
        replace(cell.task.waypoints[0], lower=start, upper=start),
        *cell.task.waypoints[1:],
    )
    allowed = (AllowedContact("middle board", departure),)
    return replace(cell, task=replace(cell.task, waypoints=waypoints, allowed_contacts=allowed))


def test_a_box_may_rest_near_its_place_but_not_sink_in() -> None:
    judge = checker_of(only_payload(resting_cell(0.03)))
    depth = RESTING_TOLERANCE
    at = above_board([0.0, -depth + 1e-5, -depth - 1e-5, -0.01, 0.01, 0.04, *[-0.5 * depth] * 3])
    at[0][-3:, 0] = [0.0, 0.029, 0.031]
    collides = [False, False, True, True, False, False, False, False, True]
    assert judge.check(*at).colliding.tolist() == collides
    assert unscreened(judge, at).colliding.tolist() == collides


def test_a_body_not_touched_at_a_fixed_pose_gets_no_allowance() -> None:
    cell = rack()
    allowed = (AllowedContact("middle board", 0.5),)
    cell = replace(cell, task=replace(cell.task, allowed_contacts=allowed))
    judge = checker_of(only_payload(cell))
    assert judge.check(*above_board([-0.0005])).colliding.all()


def test_no_samples_are_free_and_unknown_bounds_go_to_fcl() -> None:
    """An arm that loses the path at once leaves nothing to check."""
    judge = checker_of(only_payload(rack()))
    assert judge.check(*above_board([])).is_free
    unknown = np.full((1, 1), np.nan)
    assert judge.check(*above_board([-0.1]), unknown).colliding.all()
