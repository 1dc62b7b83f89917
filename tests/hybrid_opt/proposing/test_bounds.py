from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_opt.proposing.bounds import Sampling, find_bounds
from hybrid_opt.proposing.problem import decision_bounds
from symbolic.array import Array
from tests.symbolic.cells import hand_cell, with_task
from tests.turned_cells import turned_cell


def sampling(n: int, seed: int) -> Sampling:
    """Feasible is what lies in a ball about (0.3, ...)."""

    def feasible(x: Array) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(x - 0.3, axis=1) < 0.5)

    limits = np.array([np.full(n, -10.0), np.full(n, 10.0)])
    rng = np.random.default_rng(seed)

    def certain(x: Array) -> bool:
        return bool(feasible(x[None])[0])

    return Sampling(feasible, certain, np.full(n, 0.1), limits, rng, 0.02, 0.20, lambda: False)


@pytest.mark.parametrize("n", [3, 6, 12])
def test_the_wanted_share_of_candidates_is_feasible(n: int) -> None:
    how = sampling(n, 1)
    found = find_bounds(np.zeros(n) + 0.2, how)
    assert 0.02 <= found.share <= 0.20
    fresh = np.random.default_rng(7).uniform(found.lower, found.upper, (20_000, n))
    assert 0.015 <= how.feasible(fresh).mean() <= 0.25
    assert how.feasible(found.carry[None])[0]
    assert np.all(found.lower <= found.carry + 1e-4)
    assert np.all(found.carry <= found.upper + 1e-4)


def test_bounds_move_to_where_feasible_candidates_lie_and_the_carry_stays() -> None:
    edge = np.full(6, 0.3) - 0.45 / np.sqrt(6.0)
    found = find_bounds(edge, sampling(6, 2))
    middle = (found.lower + found.upper) / 2.0
    assert np.linalg.norm(middle - 0.3) < 0.7 * np.linalg.norm(edge - 0.3)
    assert np.all((found.lower - 1e-4 <= found.carry) & (found.carry <= found.upper + 1e-4))
    assert np.linalg.norm(found.carry - edge) < 0.7 * np.linalg.norm(middle - edge)


def test_bounds_keep_to_limits() -> None:
    how = sampling(3, 3)
    how.limits[1] = 0.35
    found = find_bounds(np.full(3, 0.2), how)
    assert np.all(found.upper <= 0.35)


def test_bounds_hold_a_carry_that_is_beyond_the_usual_limits() -> None:
    how = sampling(3, 4)
    how.limits[1] = 0.15
    found = find_bounds(np.full(3, 0.2), how)
    assert np.all(found.lower <= found.carry)
    assert np.all(found.upper >= found.carry)


@pytest.mark.parametrize("calls", [0, 3, 6])
def test_when_time_is_up_the_best_bounds_so_far_are_taken(calls: int) -> None:
    how, asked = sampling(6, 5), [0]

    def out_of_time() -> bool:
        asked[0] += 1
        return asked[0] > calls

    found = find_bounds(np.full(6, 0.2), replace(how, out_of_time=out_of_time))
    assert found.candidates >= 32
    assert how.feasible(found.carry[None])[0]


@pytest.mark.parametrize("pitch", [-3.0, 0.0, 1.4, 2.0, 3.1])
def test_limits_hold_a_box_at_any_pitch(pitch: float) -> None:
    cell = with_task(hand_cell(), initial=np.array([[0.0, 0.0, 1.0, 0.1, pitch, -0.2]] * 3))
    unit, limits = decision_bounds(cell)
    x = cell.task.initial.ravel()
    assert unit.shape == x.shape
    assert np.all(limits[0] < x)
    assert np.all(limits[1] > x)
    assert np.abs(limits[:, 4]).max() <= 6.28


@pytest.mark.parametrize("length", [0.0, 2.0, 4.5])
def test_corners_of_limits_are_rotation_vectors_that_files_may_hold(length: float) -> None:
    pose = np.array([0.0, 0.0, 1.0, 0.0, length, 0.0])
    cell = turned_cell()
    _, limits = decision_bounds(with_task(cell, initial=np.array([pose] * 3)))
    farthest = np.abs(limits[:, 3:6]).max(axis=0)
    assert np.linalg.norm(farthest) <= 5.0
    assert np.all(limits[0, 3:6] <= pose[3:])
    assert np.all(limits[1, 3:6] >= pose[3:])
