"""Rotation and its rates against SciPy and finite differences."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from studies.plain.motion import angular_rates
from symbolic.array import Array
from symbolic.physics.pose import rotation_from_rpy
from symbolic.physics.rotation import (
    angular_acceleration,
    angular_velocity,
    rate_matrix,
    rotation_matrix,
)

angle = st.floats(-7.0, 7.0)
angles = st.tuples(angle, angle, angle).map(np.array)

_rpy, _rate, _second = (ca.SX.sym(name, 3) for name in ("rpy", "rate", "second"))
RATES = ca.Function(
    "rates",
    [_rpy, _rate, _second],
    [
        rotation_matrix(_rpy),
        angular_velocity(_rpy, _rate),
        angular_acceleration(_rpy, _rate, _second),
        rate_matrix(_rpy),
    ],
)


def rates(rpy: Array, rate: Array, second: Array) -> tuple[Array, Array, Array]:
    rotation, velocity, acceleration, _ = (np.array(v) for v in RATES(rpy, rate, second))
    return rotation, velocity[:, 0], acceleration[:, 0]


@given(rpy=angles)
@settings(max_examples=100, deadline=None)
def test_rotation_is_yaw_pitch_roll_about_moving_axes(rpy: Array) -> None:
    expected = Rotation.from_euler("ZYX", rpy[::-1]).as_matrix()
    np.testing.assert_allclose(rates(rpy, rpy, rpy)[0], expected, atol=1e-14)
    np.testing.assert_allclose(rotation_from_rpy(rpy), expected, atol=1e-14)


@given(rpy=angles, rate=angles, second=angles)
@settings(max_examples=100, deadline=None)
def test_rates_agree_with_axes_carried_round(rpy: Array, rate: Array, second: Array) -> None:
    _, velocity, acceleration = rates(rpy, rate, second)
    expected_velocity, expected_acceleration = angular_rates(rpy, rate, second)
    np.testing.assert_allclose(velocity, expected_velocity, atol=1e-12)
    np.testing.assert_allclose(acceleration, expected_acceleration, atol=1e-11)


@given(rpy=angles, rate=angles, second=angles)
@settings(max_examples=50, deadline=None)
def test_rates_are_time_derivatives_of_the_rotation(rpy: Array, rate: Array, second: Array) -> None:
    def at(t: float) -> tuple[Array, Array]:
        R, omega, _ = rates(rpy + rate * t + second * t**2 / 2.0, rate + second * t, second)
        return R, omega

    h = 1e-5
    (before, omega_before), (after, omega_after) = at(-h), at(h)
    R, omega, alpha = rates(rpy, rate, second)
    skew = (after - before) / (2 * h) @ R.T
    from_rotation = [skew[2, 1], skew[0, 2], skew[1, 0]]
    scale = 1.0 + np.abs(rate).max() ** 3 + np.abs(rate).max() * np.abs(second).max()
    np.testing.assert_allclose(from_rotation, omega, atol=1e-7 * scale)
    np.testing.assert_allclose(
        (omega_after - omega_before) / (2 * h), alpha, atol=1e-7 * scale * (1 + np.abs(rate).max())
    )
