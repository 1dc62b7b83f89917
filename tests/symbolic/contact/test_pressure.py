"""Centre of pressure against NumPy's pseudo-inverse, tangency and minimality."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.contact.paper import pressure_shift, required_moment
from tests.symbolic.cells import call, solid_box

_moment = ca.SX.sym("moment", 3)
_arms = (ca.SX.sym("arm_1", 3), ca.SX.sym("arm_2", 3))
_forces = (ca.SX.sym("force_1", 3), ca.SX.sym("force_2", 3))
_tangents = (ca.SX.sym("tangent_1", 3), ca.SX.sym("tangent_2", 3))
_shift = pressure_shift(_moment, _arms, _forces, _tangents)
SHIFT = ca.Function(
    "shift",
    [_moment, *_arms, *_forces, *_tangents],
    [_shift.shift_1, _shift.shift_2, _shift.point_residual, _shift.residual],
    ["moment", "arm_1", "arm_2", "force_1", "force_2", "tangent_1", "tangent_2"],
    ["shift_1", "shift_2", "point_residual", "residual"],
)


def random_case(seed: int) -> tuple[list[Array], Array]:
    """Inputs of `SHIFT` for two opposite pads that press and carry, and the contact normal."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    normal = R[:, 2]
    presses = rng.uniform(20.0, 150.0, 2)
    forces = [
        sign * press * normal + R[:, :2] @ rng.normal(scale=40.0, size=2)
        for sign, press in zip((1.0, -1.0), presses, strict=True)
    ]
    arms = [-0.2 * normal + rng.normal(scale=0.03, size=3), 0.2 * normal]
    return [rng.normal(scale=3.0, size=3), *arms, *forces, R[:, 0], R[:, 1]], normal


def lever(inputs: list[Array]) -> Array:
    _, _, _, *forces, a, b = inputs
    return np.column_stack([np.cross(t, f) for f in forces for t in (a, b)])


@given(seed=st.integers(0, 2**31))
def test_agrees_with_the_pseudo_inverse(seed: int) -> None:
    inputs, _ = random_case(seed)
    moment, arm_1, arm_2, force_1, force_2, a, b = inputs
    missing = moment - np.cross(arm_1, force_1) - np.cross(arm_2, force_2)
    A = lever(inputs)
    d = np.linalg.pinv(A) @ missing
    plane = np.column_stack([a, b])
    result = call(SHIFT, *inputs)
    # The damping of 1e-12 relative counts by the square of the condition number.
    tolerance = 1e-11 * np.linalg.cond(A) ** 2 * max(1.0, float(np.abs(d).max()))
    np.testing.assert_allclose(result["point_residual"], missing, atol=1e-12)
    np.testing.assert_allclose(result["shift_1"], plane @ d[:2], atol=tolerance)
    np.testing.assert_allclose(result["shift_2"], plane @ d[2:], atol=tolerance)


@given(seed=st.integers(0, 2**31))
def test_shifts_stay_in_the_contact_planes_and_carry_the_moment(seed: int) -> None:
    inputs, normal = random_case(seed)
    moment, arm_1, arm_2, force_1, force_2, *_ = inputs
    result = call(SHIFT, *inputs)
    for shift in (result["shift_1"], result["shift_2"]):
        assert abs(shift @ normal) < 1e-9 * max(1.0, float(np.abs(shift).max()))
    carried = np.cross(arm_1 + result["shift_1"], force_1) + np.cross(
        arm_2 + result["shift_2"], force_2
    )
    np.testing.assert_allclose(carried + result["residual"], moment, atol=1e-9)
    assert np.linalg.norm(result["residual"]) < 1e-6 * np.linalg.norm(result["point_residual"])


def test_pure_squeeze_leaves_the_moment_about_its_axis() -> None:
    """Without tangential force no shift turns the box about the normal: that part remains."""
    missing = np.array([1.0, 2.0, 3.0])
    z = np.eye(3)[2]
    inputs = [missing, -0.2 * z, 0.2 * z, 80.0 * z, -80.0 * z, np.eye(3)[0], np.eye(3)[1]]
    result = call(SHIFT, *inputs)
    np.testing.assert_allclose(result["residual"], [0.0, 0.0, 3.0], atol=1e-9)
    d = np.linalg.pinv(lever(inputs), rcond=1e-6) @ missing
    np.testing.assert_allclose([*result["shift_1"][:2], *result["shift_2"][:2]], d, atol=1e-11)


def test_without_forces_nothing_is_carried() -> None:
    zero = np.zeros(3)
    result = call(SHIFT, [0.1, 0.2, 0.3], zero, zero, zero, zero, [1, 0, 0], [0, 1, 0])
    np.testing.assert_allclose(result["residual"], [0.1, 0.2, 0.3])
    assert not result["shift_1"].any()


@given(seed=st.integers(0, 2**31))
def test_required_moment_is_the_rate_of_angular_momentum(seed: int) -> None:
    """Finite difference of R I R^T omega along a rotation with constant angular acceleration."""
    rng = np.random.default_rng(seed)
    R0 = Rotation.random(rng=rng)
    omega, alpha = rng.normal(size=3), rng.normal(size=3)
    inertia = solid_box(10.0, [0.3, 0.4, 0.25]) + 0.01 * np.ones((3, 3))
    h = 1e-5

    def momentum(t: float) -> Array:
        R = (Rotation.from_rotvec(omega * t + alpha * t**2 / 2.0) * R0).as_matrix()
        value: Array = R @ inertia @ R.T @ (omega + alpha * t)
        return value

    ours: Array = np.array(
        required_moment(ca.DM(inertia), ca.DM(R0.as_matrix()), ca.DM(omega), ca.DM(alpha))
    )[:, 0]
    assert ours == pytest.approx((momentum(h) - momentum(-h)) / (2 * h), abs=1e-7)
