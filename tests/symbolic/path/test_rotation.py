"""Rotation and its rates against SciPy, quadrature and finite differences, in both charts."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from studies.research.plain.motion import angular_rates, vector_rates
from symbolic.array import Array
from symbolic.path.rotation import (
    angular_acceleration,
    angular_velocity,
    rotation_matrix,
)
from symbolic.records.poses import Orientation, box_placement, box_rotation, rotation_from_rpy

ANGLES = Orientation()
REFERENCE = rotation_from_rpy([0.4, -1.1, 2.0])
VECTORS = Orientation("quaternion", REFERENCE)
PLAIN_VECTORS = Orientation("quaternion")

TINY = float(np.finfo(float).tiny)
"""Below it numbers lose their digits."""

angle = st.floats(-7.0, 7.0)
angles = st.tuples(angle, angle, angle).map(np.array)

component = st.floats(-3.6, 3.6)
vectors = st.tuples(component, component, component).map(np.array)
"""Rotation vectors up to about a full turn."""


def rates_function(orientation: Orientation) -> ca.Function:
    numbers, rate, second = (ca.SX.sym(name, 3) for name in ("numbers", "rate", "second"))
    results = [
        rotation_matrix(orientation, numbers),
        angular_velocity(orientation, numbers, rate),
        angular_acceleration(orientation, numbers, rate, second),
    ]
    return ca.Function("rates", [numbers, rate, second], results)


RATES = {chart: rates_function(each) for chart, each in enumerate((ANGLES, VECTORS, PLAIN_VECTORS))}
OF_ANGLES, OF_VECTORS, OF_PLAIN_VECTORS = RATES


def rates(
    rpy: Array, rate: Array, second: Array, chart: int = OF_ANGLES
) -> tuple[Array, Array, Array]:
    rotation, velocity, acceleration = (np.array(v) for v in RATES[chart](rpy, rate, second))
    return rotation, velocity[:, 0], acceleration[:, 0]


@given(rpy=angles)
def test_rotation_is_yaw_pitch_roll_about_moving_axes(rpy: Array) -> None:
    expected = Rotation.from_euler("ZYX", rpy[::-1]).as_matrix()
    np.testing.assert_allclose(rates(rpy, rpy, rpy)[0], expected, atol=1e-14)
    np.testing.assert_allclose(rotation_from_rpy(rpy), expected, atol=1e-14)


@given(rpy=angles, rate=angles, second=angles)
def test_rates_agree_with_axes_carried_round(rpy: Array, rate: Array, second: Array) -> None:
    _, velocity, acceleration = rates(rpy, rate, second)
    expected_velocity, expected_acceleration = angular_rates(rpy, rate, second)
    np.testing.assert_allclose(velocity, expected_velocity, atol=1e-12)
    np.testing.assert_allclose(acceleration, expected_acceleration, atol=1e-11)


@given(vector=vectors)
def test_a_rotation_vector_turns_the_reference(vector: Array) -> None:
    expected = Rotation.from_rotvec(vector).as_matrix() @ REFERENCE
    np.testing.assert_allclose(rates(vector, vector, vector, OF_VECTORS)[0], expected, atol=3e-14)
    np.testing.assert_allclose(box_rotation(VECTORS, [0, 0, 0, *vector]), expected, atol=3e-14)


@given(vector=vectors, rate=angles, second=angles)
def test_rates_of_a_rotation_vector_agree_with_quadrature(
    vector: Array, rate: Array, second: Array
) -> None:
    _, velocity, acceleration = rates(vector, rate, second, OF_VECTORS)
    expected_velocity, expected_acceleration = vector_rates(vector, rate, second)
    np.testing.assert_allclose(velocity, expected_velocity, atol=1e-12)
    np.testing.assert_allclose(acceleration, expected_acceleration, atol=1e-11)


@given(vector=vectors, rate=vectors)
def test_the_derivatives_of_a_rotation_vector_hold_at_and_near_zero(
    vector: Array, rate: Array
) -> None:
    for size in (0.0, 1e-160, 1e-9, 1e-5):
        rotation, velocity, _ = rates(size * vector, rate, rate, OF_PLAIN_VECTORS)
        np.testing.assert_allclose(rotation, np.eye(3), atol=8 * size)
        np.testing.assert_allclose(velocity, rate, atol=50 * size + TINY)


@given(rpy=angles, xyz=angles)
def test_placements_of_many_poses_are_those_of_each(rpy: Array, xyz: Array) -> None:
    poses = np.array([[*xyz, *rpy], [*rpy, *xyz / 2.0]])
    for orientation in (ANGLES, VECTORS):
        placed = box_placement(orientation, poses)
        for T, pose in zip(placed, poses, strict=True):
            np.testing.assert_allclose(T, box_placement(orientation, pose), atol=1e-15)
            np.testing.assert_array_equal(T[:3, 3], pose[:3])
            np.testing.assert_array_equal(T[3], [0.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize("chart", [OF_ANGLES, OF_VECTORS])
@given(rpy=vectors, rate=angles, second=angles)
def test_rates_are_time_derivatives_of_the_rotation(
    chart: int, rpy: Array, rate: Array, second: Array
) -> None:
    def at(t: float) -> tuple[Array, Array]:
        R, omega, _ = rates(rpy + rate * t + second * t**2 / 2.0, rate + second * t, second, chart)
        return R, omega

    h = 1e-5
    (before, omega_before), (after, omega_after) = at(-h), at(h)
    R, omega, alpha = rates(rpy, rate, second, chart)
    skew = (after - before) / (2 * h) @ R.T
    from_rotation = [skew[2, 1], skew[0, 2], skew[1, 0]]
    scale = 1.0 + np.abs(rate).max() ** 3 + np.abs(rate).max() * np.abs(second).max()
    np.testing.assert_allclose(from_rotation, omega, atol=1e-7 * scale)
    np.testing.assert_allclose(
        (omega_after - omega_before) / (2 * h), alpha, atol=1e-7 * scale * (1 + np.abs(rate).max())
    )


def test_between_half_turns_about_two_axes_rates_are_those_of_the_rotation() -> None:
    """Straight between rotation vectors: rates are exact, but the way is no geodesic."""
    first, last = np.array([np.pi, 0.0, 0.0]), np.array([0.0, np.pi, 0.0])
    along, none, step = last - first, np.zeros(3), 1e-5
    speeds = []
    for u in np.linspace(0.0, 1.0, 41):
        before, here, after = (first + (u + k * step) * along for k in (-1, 0, 1))
        turn = Rotation.from_rotvec(after) * Rotation.from_rotvec(before).inv()
        _, velocity, acceleration = rates(here, along, none, OF_PLAIN_VECTORS)
        np.testing.assert_allclose(velocity, turn.as_rotvec() / (2.0 * step), atol=1e-8)
        change = [rates(v, along, none, OF_PLAIN_VECTORS)[1] for v in (before, after)]
        np.testing.assert_allclose(acceleration, (change[1] - change[0]) / (2.0 * step), atol=1e-7)
        speeds.append(np.linalg.norm(velocity))
    geodesic = (Rotation.from_rotvec(last) * Rotation.from_rotvec(first).inv()).magnitude()
    assert np.trapezoid(speeds, dx=1.0 / 40) > 1.1 * geodesic
