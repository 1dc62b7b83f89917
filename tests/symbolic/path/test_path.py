"""The natural quintic spline against its defining conditions, solved independently."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from studies.research.plain.motion import evaluate_spline, natural_quintic, waypoints
from symbolic.array import Array
from symbolic.path.spline import path_basis, waypoint_matrix
from symbolic.records import Task, Waypoint
from tests.symbolic.cells import fixed, free, hand_cell, with_task

PARAMETER = np.linspace(0.0, 1.0, 41)


def task_with(*points: Waypoint) -> Task:
    return with_task(hand_cell(), waypoints=points).task


def waypoint_values(task: Task, x: Array) -> Array:
    symbol = ca.MX.sym("x", task.n_var)
    function = ca.Function("waypoints", [symbol], [waypoint_matrix(task, symbol)])
    return np.array(function(x)).T


def random_points(count: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6))


@pytest.mark.parametrize("count", range(2, 11))
def test_agrees_with_the_conditions_solved_one_by_one(count: int) -> None:
    points = random_points(count)
    basis = path_basis(count, PARAMETER)
    spline = natural_quintic(points)
    for order, matrix in enumerate((basis.position, basis.first, basis.second)):
        expected = [evaluate_spline(spline, u, order) for u in PARAMETER]
        np.testing.assert_allclose(matrix @ points, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("count", range(3, 11))
def test_derivatives_are_those_of_the_position(count: int) -> None:
    step = 1e-5
    inside = np.linspace(0.013, 0.987, 29)
    left, right = (path_basis(count, inside + sign * step) for sign in (-1.0, 1.0))
    here = path_basis(count, inside)
    np.testing.assert_allclose(
        (right.position - left.position) / (2 * step), here.first, atol=1e-5, rtol=1e-6
    )
    np.testing.assert_allclose(
        (right.first - left.first) / (2 * step), here.second, atol=1e-4, rtol=1e-6
    )


@pytest.mark.parametrize("count", range(3, 11))
def test_is_four_times_continuously_differentiable_and_natural_at_the_ends(count: int) -> None:
    """Third and fourth derivatives read off the quintic pieces, fitted between the knots."""
    segments = count - 1
    local = np.linspace(0.0, 1.0, 6)
    pieces: list[Array] = []
    for k in range(segments):
        position = path_basis(count, (k + local) / segments).position
        pieces.append(np.linalg.solve(np.vander(local, increasing=True), position).astype(float))
    scale = max(float(np.abs(piece).max()) for piece in pieces)

    def derivative(piece: Array, s: float, order: int) -> Array:
        polynomial = np.polynomial.Polynomial
        return np.array([polynomial(column).deriv(order)(s) for column in piece.T])

    for order in (0, 1, 2, 3, 4):
        for before, after in pairwise(pieces):
            np.testing.assert_allclose(
                derivative(before, 1.0, order), derivative(after, 0.0, order), atol=1e-8 * scale
            )
    for order in (3, 4):
        np.testing.assert_allclose(derivative(pieces[0], 0.0, order), 0.0, atol=1e-8 * scale)
        np.testing.assert_allclose(derivative(pieces[-1], 1.0, order), 0.0, atol=1e-8 * scale)


def integrated_squared_jerk(values: Array, parameter: Array) -> float:
    jerk = np.diff(values, 3) / (parameter[1] - parameter[0]) ** 3
    return float(np.sum(jerk**2) * (parameter[1] - parameter[0]))


@given(
    seed=st.integers(0, 2**31),
    count=st.integers(3, 7),
    size=st.floats(0.01, 1.0),
    harmonic=st.integers(1, 3),
)
def test_has_the_least_jerk_of_all_curves_through_the_waypoints(
    seed: int, count: int, size: float, harmonic: int
) -> None:
    fine = np.linspace(0.0, 1.0, 2001)
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, count)
    curve = path_basis(count, fine).position @ points
    # Zero at every knot, so that the perturbed curve still passes through the waypoints.
    perturbation = np.sin(np.pi * harmonic * (count - 1) * fine) * (fine + 0.3)
    least = integrated_squared_jerk(curve, fine)
    for sign in (-1.0, 1.0):
        assert integrated_squared_jerk(curve + sign * size * perturbation, fine) > least


@pytest.mark.parametrize("count", range(1, 9))
def test_decision_vector_fills_the_free_waypoints_in_order(count: int) -> None:
    centres = random_points(count, seed=count) * 0.5
    task = task_with(
        fixed(np.zeros(6)), *(free(c, np.full(6, 0.1)) for c in centres), fixed(np.ones(6) * 0.2)
    )
    assert task.n_var == 6 * count
    expected = np.vstack([np.zeros(6), centres, np.full(6, 0.2)])
    np.testing.assert_allclose(waypoint_values(task, centres.reshape(-1)), expected, atol=1e-15)


def test_fixed_inner_waypoints_stay_and_are_passed() -> None:
    via = np.array([0.1, 0.2, 0.3, 0.1, 0.0, -0.1])
    task = task_with(
        fixed(np.zeros(6)),
        free(np.full(6, 0.1), np.full(6, 0.1)),
        fixed(via),
        free(np.full(6, 0.2), np.full(6, 0.1)),
        fixed(np.full(6, 0.3)),
    )
    x = np.random.default_rng(0).uniform(task.lower, task.upper)
    values = waypoint_values(task, x)
    np.testing.assert_array_equal(values[2], via)
    np.testing.assert_allclose(path_basis(5, np.array([0.5])).position @ values, [via], atol=1e-14)


@given(
    angles=st.lists(st.tuples(*[st.floats(-12.0, 12.0) for _ in range(3)]), min_size=2, max_size=6)
)
def test_angles_are_unwrapped_as_numpy_does(angles: list[tuple[float, ...]]) -> None:
    poses = [np.concatenate([np.zeros(3), value]) for value in angles]
    task = task_with(
        fixed(np.zeros(6)), *(free(p, np.full(6, 20.0)) for p in poses[:-1]), fixed(poses[-1])
    )
    x = np.concatenate(poses[:-1])
    np.testing.assert_allclose(waypoint_values(task, x), waypoints(task, x), atol=1e-12)


@pytest.mark.parametrize("turn", [np.pi, -np.pi])
def test_half_a_turn_keeps_the_direction_that_was_written(turn: float) -> None:
    task = task_with(fixed(np.zeros(6)), fixed([0.0, 0.0, 0.0, 0.0, 0.0, turn]))
    assert waypoint_values(task, np.zeros(0))[1, 5] == turn
