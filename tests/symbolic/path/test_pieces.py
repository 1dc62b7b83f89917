"""Waypoints between those that a file states: the same paths and more."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from symbolic.errors import WorkcellError
from symbolic.path.pieces import by_levels, in_pieces, same_paths, stated, stated_entries
from symbolic.path.spline import path_position
from symbolic.read.cell import load
from symbolic.records import Task
from symbolic.records.task import extended_waypoints, initial_decision
from tests.symbolic.read.samples import RACK

PIECES = 3


@cache
def both(name: str) -> tuple[Task, Task]:
    """A shipped task as it is stated under the time law 'optimal', and in pieces."""
    task = replace(load(RACK.with_name(f"{name}.toml")).task, time_law="optimal", pieces=1)
    return task, in_pieces(replace(task, pieces=PIECES))


def drawn(task: Task, count: int = 4) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    high = np.where(np.isfinite(task.upper), task.upper, 1e3)
    return np.random.default_rng(1).uniform(task.lower, high, (count, task.n_var))


@pytest.mark.parametrize("name", ["rack", "pandas", "transfer"])
def test_paths_through_stated_waypoints_are_paths_through_all(name: str) -> None:
    coarse, fine = both(name)
    x = drawn(coarse)
    same = same_paths(x, coarse, fine)
    assert same.shape == (len(x), fine.n_var)
    assert ((same >= fine.lower) & (same <= fine.upper)).all()
    np.testing.assert_array_equal(same[:, -1], x[:, -1])
    u = np.random.default_rng(2).uniform(size=30)
    at = [path_position(len(task.waypoints), u) for task in (coarse, fine)]
    for one, other in zip(x, same, strict=True):
        expected = at[0] @ extended_waypoints(coarse, one)
        np.testing.assert_allclose(at[1] @ extended_waypoints(fine, other), expected, atol=1e-12)
    np.testing.assert_array_equal(same_paths(same, fine, coarse), x)


@pytest.mark.parametrize("name", ["rack", "pandas", "transfer"])
def test_the_stated_task_comes_back(name: str) -> None:
    coarse, fine = both(name)
    again = stated(fine)
    assert stated(coarse) is coarse
    assert len(fine.waypoints) == PIECES * (len(coarse.waypoints) - 1) + 1
    for field in ("lower", "upper", "initial"):
        np.testing.assert_array_equal(getattr(again, field), getattr(coarse, field))
    hand_made = same_paths(initial_decision(coarse), coarse, fine)[0]
    np.testing.assert_allclose(initial_decision(fine), hand_made, atol=1e-12)
    for one, other in zip(again.redundant, coarse.redundant, strict=True):
        np.testing.assert_array_equal(one.initial, other.initial)
        np.testing.assert_array_equal(one.moving, other.moving)


@pytest.mark.parametrize("name", ["rack", "pandas"])
def test_moves_of_stated_waypoints_are_followed_by_the_others(name: str) -> None:
    coarse, fine = both(name)
    x, n, m = drawn(coarse, 1)[0], coarse.n_path, fine.n_path
    levels, square = by_levels(fine)
    assert levels.shape == (m, m)
    assert np.linalg.matrix_rank(levels) == m
    own = stated_entries(fine)
    by, others = levels[:, own], np.setdiff1d(np.arange(m), own)
    np.testing.assert_array_equal(levels[np.ix_(own, others)], 0.0)
    np.testing.assert_array_equal(square[own], 1.0)
    np.testing.assert_allclose(square[others], 1.0 / PIECES**2)
    np.testing.assert_array_equal(by[stated_entries(fine)], np.eye(n))
    step = 1e-3 * np.random.default_rng(3).normal(size=n)
    inside = np.clip(x[:n] + step, coarse.lower[:n], coarse.upper[:n])
    moved = same_paths(inside, coarse, fine)[0] - same_paths(x[:n], coarse, fine)[0]
    np.testing.assert_allclose(by @ (inside - x[:n]), moved, atol=1e-12)


def with_pieces(count: int) -> str:
    lines = RACK.read_text("utf-8").splitlines()
    lines = [line for line in lines if not line.startswith("drivable_pieces")]
    return "\n".join(lines).replace("[task]", f"[task]\ndrivable_pieces = {count}", 1)


def test_only_what_robots_drive_is_cut_into_pieces() -> None:
    text = with_pieces(2)
    usual = load(RACK, text=text.encode())
    assert len(usual.task.waypoints) == 5
    law = 'time_law = "constant"'
    driven = load(RACK, text=text.replace(law, 'time_law = "optimal"').encode())
    assert len(driven.task.waypoints) == 9
    assert driven.task.pieces == 2
    with pytest.raises(WorkcellError, match=r"task\.drivable_pieces: found 0; allowed is a whole"):
        load(RACK, text=with_pieces(0).encode())
