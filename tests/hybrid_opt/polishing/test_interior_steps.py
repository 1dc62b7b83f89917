"""The interior-point method's pieces against what they are defined by."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.polishing.interior_steps import (
    DUAL_RANGE,
    LONGEST,
    direction,
    estimated,
    kept,
    largest,
    until,
)

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS)
def test_a_definite_system_is_solved_as_it_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    M, right = root @ root.T + np.eye(6), rng.normal(size=6)
    dz = direction(M, right, np.full(6, 1e9))
    assert dz is not None
    np.testing.assert_allclose(M @ dz, right, atol=1e-8)


@given(SEEDS)
def test_an_indefinite_system_gives_a_descent_direction_of_bounded_length(seed: int) -> None:
    rng = np.random.default_rng(seed)
    M, right, width = rng.normal(size=(6, 6)), rng.normal(size=6), np.full(6, 0.1)
    dz = direction(M + M.T - 3.0 * np.eye(6), right, width)
    assert dz is not None
    assert right @ dz > 0.0
    assert (np.abs(dz) <= LONGEST * width).all()


def test_no_direction_where_the_matrix_is_not_finite() -> None:
    assert direction(np.full((2, 2), np.nan), np.ones(2), np.ones(2)) is None


@given(SEEDS)
def test_the_largest_step_keeps_its_share_of_every_value(seed: int) -> None:
    rng = np.random.default_rng(seed)
    value, change = rng.uniform(0.1, 1.0, 8), rng.normal(0.0, 2.0, 8)
    share = largest(value, change, 0.99)
    left = value + share * change
    assert (left >= 0.01 * value - 1e-12).all()
    assert share == 1.0 or left.min() < 0.02 * value.max()


def test_parabolas_tell_where_values_have_fallen_to_a_tenth() -> None:
    value, change, bend = np.array([1.0, 2.0]), np.array([0.5, 1.0]), np.array([-4.0, -1.0])
    share = until(value, change, value + change + bend)
    fallen = value + change * share + bend * share**2
    assert fallen[0] == pytest.approx(0.1)
    assert fallen[1] > 0.2


def test_multipliers_stay_near_what_the_barrier_asks_for() -> None:
    found = kept(np.array([0.0, 1.0, np.inf]), np.ones(3))
    np.testing.assert_allclose(found, [1.0 / DUAL_RANGE, 1.0, DUAL_RANGE])


def test_multipliers_of_an_optimum_are_found() -> None:
    """Minimise -z_0 - 2 z_1 with z_0 + z_1 <= 1 (its slack is 1 - z_0 - z_1) and z_1 <= 0.25."""
    cost = np.array([-1.0, -2.0])
    A = np.array([[-1.0, -1.0], [1.0, 0.0]])
    slacks = (np.array([0.0, 3.0]), np.array([5.75, 5.25]), np.array([4.25, 0.0]))
    bounds, y = estimated(cost, A, slacks)
    np.testing.assert_allclose(y, [1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(bounds, [0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(cost - A.T @ y + bounds, 0.0, atol=1e-9)


def test_what_is_far_from_its_limit_has_no_multiplier() -> None:
    cost, A, far = np.array([-1.0, 0.0]), np.array([[-1.0, 0.0]]), np.full(2, 5.0)
    bounds, y = estimated(cost, A, (np.array([2.0]), far, far))
    assert not bounds.any()
    assert not y.any()
    # A bound far away takes nothing over from a row that is near.
    bounds, y = estimated(cost, A, (np.array([0.0]), far, far))
    assert not bounds.any()
    assert y == pytest.approx([1.0])
