"""Clearance bounds against Coal's distances, and their smooth form."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from symbolic.array import Array
from symbolic.geometry.expressions import EXACT, Softness, clean, quaternion
from symbolic.records.poses import pose_matrix
from tests.symbolic.geometry.collision_cells import (
    functions_of,
    placed_pieces,
    random_configurations,
    true_distances,
    whole_geometry_of,
)

pytestmark = pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")

COAL_ACCURACY = 2e-6
"""Coal's iterative distances stop within this of the truth [m]."""

WIDTH, COARSE = 2e-3, 1e-2
"""Of soft forms: each takes seconds to build."""


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.getbasetemp() / "clearance"


@cache
def functions(name: str, folder: Path, softness: Softness = EXACT) -> dict[str, ca.Function]:
    return functions_of(whole_geometry_of(name, folder), softness)


def bounds(name: str, folder: Path, *at: Array, softness: Softness = EXACT) -> Array:
    """(n, n_pairs) from configurations (n, 6) each."""
    clearance = functions(name, folder, softness)["clearance"]
    return np.array(clearance(*[array.T for array in at])).T


@pytest.mark.parametrize("name", ["rack", "obstacles", "ur10"])
def test_bounds_never_exceed_the_distance(name: str, folder: Path) -> None:
    geometry = whole_geometry_of(name, folder)
    at = random_configurations(geometry, 60, np.random.default_rng(11))
    bound = bounds(name, folder, *at)
    smooth = bounds(name, folder, *at, softness=Softness(WIDTH))
    far = near = 0
    for k, row in enumerate(zip(*at, strict=True)):
        distance = np.fmax(true_distances(geometry, *row), 0.0)
        assert np.all(np.fmax(bound[k], 0.0) <= distance + COAL_ACCURACY)
        assert np.all(np.fmax(smooth[k], 0.0) <= distance + COAL_ACCURACY)
        far += int(np.count_nonzero(distance > 0.10))
        near += int(np.count_nonzero((distance > 0.10) & (bound[k] > 0.0)))
    # A bound that never clears anything would be safe and useless.
    assert near > 0.9 * far


def test_flush_boxes_are_measured_exactly() -> None:
    """The payload level above a board: the bound is the gap itself."""
    geometry = whole_geometry_of("rack")
    k = geometry.pair_names.index(("payload", "middle board"))
    pose = np.array([[0.0, 0.0, 0.6 + 0.125 + gap, 0.0, 0.0, 0.0] for gap in (-0.01, 0.0, 0.03)])
    bound = bounds("rack", Path(), pose, np.zeros((3, 6)), np.zeros((3, 6)))[:, k]
    assert bound == pytest.approx([-0.01, 0.0, 0.03], abs=1e-12)


@pytest.mark.parametrize(
    ("name", "width"),
    [
        ("rack", COARSE),
        ("rack", WIDTH),
        ("obstacles", WIDTH),
        *(
            pytest.param(name, width, marks=pytest.mark.slow)
            for name in ("rack", "obstacles")
            for width in (1e-3, 1e-4)
        ),
    ],
)
def test_the_smooth_bound_is_lower_by_few_widths(name: str, width: float, folder: Path) -> None:
    at = random_configurations(whole_geometry_of(name, folder), 400, np.random.default_rng(12))
    gap = bounds(name, folder, *at) - bounds(name, folder, *at, softness=Softness(width))
    assert gap.min() >= -1e-9
    assert gap.max() <= 8.0 * width


@pytest.mark.parametrize("softness", [EXACT, Softness(WIDTH)])
def test_derivatives_are_finite_at_every_kink(softness: Softness) -> None:
    """Aligned axes, equal gaps and coinciding centres are where roots and maxima break."""
    f = functions("rack", Path(), softness)["clearance"]
    x = ca.MX.sym("x", 18)
    value = f(x[:6], x[6:12], x[12:])
    jacobian = ca.Function("jacobian", [x], [ca.jacobian(value, x)])
    rng = np.random.default_rng(13)
    corners = [
        np.zeros(18),
        np.r_[0, 0, 0.745, np.zeros(15)],
        np.r_[np.zeros(6), np.full(12, np.pi / 2)],
    ]
    for point in corners + list(rng.uniform(-1.0, 1.0, (10, 18))):
        assert np.all(np.isfinite(np.array(jacobian(point))))


def test_second_derivatives_of_the_smooth_bound_match_differences() -> None:
    geometry = whole_geometry_of("rack")
    f = functions("rack", Path(), Softness(COARSE))["clearance"]
    x = ca.MX.sym("x", 18)
    rows = [
        geometry.pair_names.index(pair)
        for pair in (("payload", "middle board"), ("left/link_4", "top board"),
                     ("left/link_4", "left/pad"), ("left/link_4", "payload"))
    ]  # fmt: skip
    value = ca.sum1(f(x[:6], x[6:12], x[12:])[rows])
    hessian, gradient = ca.hessian(value, x)
    h, g = ca.Function("h", [x], [hessian]), ca.Function("g", [x], [gradient])
    rng = np.random.default_rng(14)
    at = np.r_[0.0, 0.0, 0.8, 0.1, 0.1, 0.1, rng.uniform(-1.0, 1.0, 12)]
    exact = np.array(h(at))
    assert np.all(np.isfinite(exact))
    step = 1e-5
    for k in range(18):
        e = step * np.eye(18)[k]
        difference = np.ravel(np.array(g(at + e)) - np.array(g(at - e))) / (2.0 * step)
        assert exact[:, k] == pytest.approx(difference, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("name", ["rack", "ur10"])
def test_piece_poses_agree_with_numeric_pinocchio(name: str, folder: Path) -> None:
    geometry = whole_geometry_of(name, folder)
    at = random_configurations(geometry, 5, np.random.default_rng(15))
    f = functions(name, folder)["piece_poses"]
    for row in zip(*at, strict=True):
        quaternions, positions = (np.array(value) for value in f(*row))
        placed = [p for body in placed_pieces(geometry, *row) for p in body]
        for k, piece in enumerate(placed):
            assert positions[:, k] == pytest.approx(piece.centre, abs=1e-12)
            assert matrix(quaternions[:, k]) == pytest.approx(piece.rotation, abs=1e-12)


def matrix(q: Array) -> Array:
    """Rotation of a unit quaternion w x y z, from its definition v -> q v q*."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray((w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * cross)


@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
def test_quaternions_are_stable_for_every_angle(rpy: tuple[float, float, float]) -> None:
    R = ca.SX.sym("R", 3, 3)
    f = ca.Function("f", [R], [quaternion(R)])
    rotation = pose_matrix(np.zeros(3), np.array(rpy))[:3, :3]
    found = np.ravel(np.array(f(rotation)))
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-14)
    assert matrix(found) == pytest.approx(rotation, abs=1e-14)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_a_quaternion(axis: int) -> None:
    R = ca.SX.sym("R", 3, 3)
    f = ca.Function("f", [R], [quaternion(R)])
    turn = -np.eye(3)
    turn[axis, axis] = 1.0
    assert matrix(np.ravel(np.array(f(turn)))) == pytest.approx(turn, abs=1e-15)


def test_cleaning_only_touches_roundoff() -> None:
    assert clean(np.array([6e-17, 1.0 - 2e-16, -1.0, 0.5, 1e-9, 2.0])).tolist() == [
        0.0, 1.0, -1.0, 0.5, 1e-9, 2.0,
    ]  # fmt: skip


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(1e-6, 0.5))
def test_soft_operations_err_to_their_side(a: float, b: float, width: float) -> None:
    soft = Softness(width)
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    values = [
        soft.absolute_above(x) - ca.fabs(x),
        ca.fabs(x) - soft.absolute_below(x),
        soft.ramp_above(x) - ca.fmax(x, 0),
        soft.maximum_above([x, y]) - ca.fmax(x, y),
        ca.fmax(x, y) - soft.maximum_below([x, y]),
        ca.fmin(x, y) - soft.minimum_below([x, y]),
        ca.sqrt(x * x + y * y) - soft.norm_below(x * x + y * y),
        soft.cosine_above(x / 3) - ca.sqrt(1 - (x / 3) ** 2),
    ]
    excess = np.ravel(np.array(ca.Function("f", [x, y], [ca.vertcat(*values)])(a, b)))
    limits = np.array([1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0]) * width
    assert np.all(excess >= -1e-12)
    assert np.all(excess <= limits + 1e-12)
