"""The profile is smooth, monotone, and at rest at both ends up to its third derivative."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.job.motions import PEAK_RATE, at_even_steps, rise


def test_the_profile_goes_from_rest_to_rest() -> None:
    found = rise(2.0, 2001)
    assert found.value[0] == 0.0
    assert found.value[-1] == pytest.approx(1.0, abs=1e-12)
    assert (np.diff(found.value) >= 0.0).all()
    for derivative in (found.rate, found.second, found.third):
        np.testing.assert_allclose(derivative[[0, -1]], 0.0)
        np.testing.assert_allclose(derivative[[1, -2]], 0.0, atol=0.1)
    assert found.rate.max() == pytest.approx(PEAK_RATE / 2.0)


def test_its_derivatives_are_those_of_differences() -> None:
    found = rise(0.7, 4001)
    for values, derivative in (
        (found.value, found.rate),
        (found.rate, found.second),
        (found.second, found.third),
    ):
        slope = np.gradient(values, found.time)
        np.testing.assert_allclose(slope[1:-1], derivative[1:-1], atol=2e-4 * abs(derivative).max())


@pytest.mark.parametrize(("duration", "whole"), [(0.8, 0.8), (0.801, 0.808), (1e-9, 0.008)])
def test_durations_are_whole_steps(duration: float, whole: float) -> None:
    assert at_even_steps(duration, 0.008) == pytest.approx(whole, abs=1e-12)
