"""The cone of a round patch against pressures on it, and its barrier against its matrix."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from symbolic.array import Array
from symbolic.contact.round_patch import patch_barrier, patch_slack

_wrench = ca.SX.sym("wrench", 6)
SLACK = ca.Function("slack", [_wrench], [patch_slack(_wrench)])


def slack(wrench: Array) -> float:
    return float(SLACK(wrench))


def point_wrench(x: Array, force: Array) -> Array:
    """Scaled wrench (6,) of a unit normal force at x (2,) with friction `force` (2,)."""
    return np.array([1.0, *force, *x, x[0] * force[1] - x[1] * force[0]])


def on_disc(rng: np.random.Generator, n: int) -> Array:
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, n), np.sqrt(rng.random(n))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def inner_wrench(rng: np.random.Generator) -> Array:
    """A wrench within the cone: some of several points' and a centred squeeze."""
    n = int(rng.integers(1, 5))
    points = [point_wrench(x, f) for x, f in zip(on_disc(rng, n), on_disc(rng, n), strict=True)]
    wrench: Array = rng.dirichlet(np.ones(n)) @ np.array(points) + 0.1 * np.eye(6)[0]
    return rng.uniform(1.0, 100.0) * wrench


@given(seed=st.integers(0, 2**31), n=st.integers(1, 8))
def test_whatever_pressure_with_coulomb_friction_lies_within(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points = [point_wrench(x, f) for x, f in zip(on_disc(rng, n), on_disc(rng, n), strict=True)]
    wrench = rng.dirichlet(np.ones(n)) @ np.array(points)
    assert slack(wrench) >= -1e-12
    assert np.linalg.norm(wrench[1:3]) <= 1.0 + 1e-12
    assert np.linalg.norm(wrench[3:5]) <= 1.0 + 1e-12


@given(seed=st.integers(0, 2**31))
def test_reaches_as_far_as_pressures_do_in_every_direction(seed: int) -> None:
    """Largest c.d + a.T + b M over the cone by its formula, and over points on the disc."""
    rng = np.random.default_rng(seed)
    a, c, b = rng.normal(size=2), rng.normal(size=2), rng.normal()
    angle, radius = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 721), np.linspace(0.0, 1.0, 201))
    x = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    turned = np.stack([-x[..., 1], x[..., 0]], axis=-1)
    reach = np.linalg.norm(a + b * turned, axis=-1)
    by_points = (x @ c + reach).max()
    by_cone = (x @ c + np.sqrt(reach**2 + b**2 * (1.0 - radius**2))).max()
    assert by_cone == pytest.approx(by_points, rel=1e-4)


@given(seed=st.integers(0, 2**31))
def test_torsion_about_the_centre_of_pressure_follows_the_ellipse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, tangent = on_disc(rng, 1)[0], on_disc(rng, 1)[0]
    torsion = np.sqrt((1.0 - tangent @ tangent) * (1.0 - d @ d))
    shifted = d[0] * tangent[1] - d[1] * tangent[0]
    for sign in (1.0, -1.0):
        boundary = np.array([1.0, *tangent, *d, shifted + sign * torsion])
        assert slack(boundary) == pytest.approx(0.0, abs=1e-12)
        boundary[5] += 0.01 * sign
        assert slack(boundary) < 0.0


def hermitian(wrench: Array, z: float) -> Array:
    n, t, q = wrench[0], complex(*wrench[1:3]), complex(*wrench[3:5])
    low = np.array([[n, 0, 0], [q, n, 0], [t, z + 1j * wrench[5], n]])
    matrix: Array = low + np.tril(low, -1).conj().T
    return matrix


def barrier(wrench: Array) -> float:
    """-log det of the matrix whose determinant is largest over z, up to a constant."""
    bound = float(wrench[0])

    def minus_determinant(z: float) -> float:
        values = np.linalg.eigvalsh(hermitian(wrench, z))
        return -float(values.prod()) if values[0] > 0.0 else -float(values[0] * bound**2)

    best = minimize_scalar(minus_determinant, bounds=(-bound, bound), options={"xatol": 1e-12})
    return -float(np.log(-best.fun))


@given(seed=st.integers(0, 2**31))
def test_barrier_is_the_determinants(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrench = inner_wrench(rng)
    wrench /= wrench[0]
    gradient, hessian = (np.array(v) for v in patch_barrier()(wrench))
    h = 1e-4
    size = max(1.0, float(np.abs(gradient).max()), float(np.abs(hessian).max()))
    for direction in np.eye(6):
        before, here, after = (barrier(wrench + k * h * direction) for k in (-1.0, 0.0, 1.0))
        assert (after - before) / (2 * h) == pytest.approx(
            float(direction @ gradient[:, 0]), abs=1e-4 * size
        )
        assert (after - 2.0 * here + before) / h**2 == pytest.approx(
            float(direction @ hessian @ direction), abs=1e-3 * size
        )


@given(seed=st.integers(0, 2**31))
def test_barrier_of_a_cone_has_its_degree(seed: int) -> None:
    """A logarithmically homogeneous barrier of degree 3: -gradient.w = 3, hessian w = -gradient."""
    wrench = inner_wrench(np.random.default_rng(seed))
    gradient, hessian = (np.array(v) for v in patch_barrier()(wrench))
    assert -float(gradient[:, 0] @ wrench) == pytest.approx(3.0, rel=1e-6)
    np.testing.assert_allclose(
        hessian @ wrench, -gradient[:, 0], rtol=1e-6, atol=1e-6 * float(np.abs(gradient).max())
    )
