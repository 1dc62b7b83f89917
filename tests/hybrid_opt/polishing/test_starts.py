"""Starts in other basins: kicks, random ones, mirror images, turned paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.evaluate.evaluation import COLLISION, REASONS
from hybrid_opt.polishing.force_attempts import better_half
from hybrid_opt.polishing.starts import (
    LEAST_CHANGE,
    LEAST_ROTATION,
    ROTATION_SHARES,
    Start,
    first_feasible,
    mirror_of,
    perturb_start,
    random_starts,
    rotated_starts,
)
from symbolic.records.task import POSE_SIZE, initial_decision
from tests.hybrid_opt.polishing.cells import drivable_rack, drive_method, start
from tests.hybrid_opt.polishing.test_force_front import evaluator

FORCE = 55.0


def test_a_kick_is_feasible_far_away_and_the_same_for_the_same_seed() -> None:
    x = initial_decision(evaluator().workcell.task)
    for objective in (0, 1):
        found = perturb_start(evaluator(), x, objective, np.random.default_rng(3), candidates=400)
        again = perturb_start(evaluator(), x, objective, np.random.default_rng(3), candidates=400)
        assert found is not None
        assert again is not None
        candidate, objectives = found
        np.testing.assert_array_equal(candidate, again[0])
        judged = evaluator().evaluate(candidate)
        assert judged.feasible[0]
        np.testing.assert_array_equal(judged.objectives[0], objectives)
        moved = np.abs(candidate - x) / (evaluator().upper - evaluator().lower)
        assert moved.max() > LEAST_CHANGE
        assert (moved == 0.0).sum() > evaluator().n_var / 2


def test_random_starts_are_feasible_and_the_same_for_the_same_seed() -> None:
    found = random_starts(evaluator(), 5, np.random.default_rng(1))
    again = random_starts(evaluator(), 5, np.random.default_rng(1))
    assert len(found) == 5
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.x, other.x)
        judged = evaluator().evaluate(one.x)
        assert judged.feasible[0]
        np.testing.assert_array_equal(judged.objectives[0], one.objectives)


@pytest.mark.parametrize("objective", [None, 0, 1])
def test_the_first_feasible_ones_are_those_of_a_verdict_on_all(objective: int | None) -> None:
    judge = evaluator()
    x = np.random.default_rng(2).uniform(judge.lower, judge.upper, (800, judge.n_var))
    found = judge.evaluate(x)
    rows = np.flatnonzero(found.feasible)
    assert (found.reason == REASONS.index(COLLISION)).any()
    if objective is not None:
        rows = rows[np.argsort(found.objectives[rows, objective])]
    for count in (1, 5, 800):
        chosen, objectives = first_feasible(judge, x, count, objective)
        np.testing.assert_array_equal(chosen, rows[:count])
        np.testing.assert_array_equal(objectives, found.objectives[rows[:count]])


@given(
    values=st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 2.0)), max_size=9),
    objective=st.sampled_from([0, 1, None]),
)
def test_the_better_half_is_no_worse_than_the_rest(
    values: list[tuple[float, float]], objective: int | None
) -> None:
    starts = [Start(np.empty(0), np.array(value)) for value in values]
    half = better_half(starts, objective)
    assert len(half) == len(starts) // 2
    rest = [start for start in starts if all(start is not kept for kept in half)]
    for kept in half:
        assert all(kept.value(objective) <= other.value(objective) for other in rest)


def test_an_image_is_as_good_with_exchanged_objectives() -> None:
    mirror = mirror_of(evaluator().workcell)
    assert mirror is not None
    rng = np.random.default_rng(7)
    x = rng.uniform(evaluator().lower, evaluator().upper, (600, evaluator().n_var))
    found = [mirror.image(row) for row in x]
    images = np.array([image for image in found if image is not None])
    assert len(images) == len(x)
    before, after = evaluator().evaluate(x), evaluator().evaluate(images)
    np.testing.assert_array_equal(after.feasible, before.feasible)
    assert before.feasible.sum() > 5
    good = before.feasible
    np.testing.assert_allclose(
        after.objectives[good], before.objectives[good][:, ::-1], rtol=0.0, atol=1e-9
    )


def test_an_image_beyond_the_bounds_is_none() -> None:
    workcell = evaluator().workcell
    mirror = mirror_of(workcell)
    assert mirror is not None
    lower = mirror.task.lower.copy()
    x = mirror.task.upper.copy()
    assert mirror.image(x) is not None
    free = next(k for k, w in enumerate(workcell.task.waypoints) if not w.is_fixed)
    narrow = list(workcell.task.waypoints)
    narrow[free] = replace(narrow[free], lower=narrow[free].lower + 0.01 * np.eye(6)[1])
    tight = mirror_of(replace(workcell, task=replace(workcell.task, waypoints=tuple(narrow))))
    assert tight is not None
    assert (tight.task.lower > lower).any()
    assert tight.image(x) is None


def test_cells_without_a_plane_have_no_image() -> None:
    workcell = evaluator().workcell
    first, second = workcell.robots
    moved = first.T_world_base.copy()
    moved[0, 3] += 0.1
    askew = replace(workcell, robots=(replace(first, T_world_base=moved), second))
    assert mirror_of(askew) is None
    moved = first.T_world_base.copy()
    moved[1, 3] += 0.1
    # The plane is elsewhere then: the ends of the path are not in it.
    uneven = replace(workcell, robots=(replace(first, T_world_base=moved), second))
    assert mirror_of(uneven) is None


def test_each_is_driven_and_turned_about_one_axis_by_one_share() -> None:
    task, judge, path = drivable_rack().task, drive_method().driver, start(FORCE)[:-1]
    found = rotated_starts(task, path, lambda paths: judge.durations(paths, FORCE))
    assert np.isfinite(judge.durations(np.array(found), FORCE)).all()
    columns, senses = task.free_entries[1], set()
    for other in found:
        changed = np.flatnonzero(other != path)
        (axis,) = set(columns[changed].tolist())
        assert 3 <= axis < POSE_SIZE
        assert len(changed) == np.count_nonzero(columns == axis)
        up = bool(other[changed[0]] > path[changed[0]])
        bound = (task.upper if up else task.lower)[changed]
        shares = (other - path)[changed] / (bound - path[changed])
        np.testing.assert_allclose(shares, shares[0])
        assert np.isclose(shares[0], ROTATION_SHARES).any()
        assert np.abs(bound - path[changed]).mean() >= LEAST_ROTATION
        senses.add((axis, up))
    assert len(senses) == len(found) >= 2


def test_a_path_that_nothing_can_drive_has_no_turned_ones() -> None:
    task, judge = drivable_rack().task, drive_method().driver
    assert rotated_starts(task, start(FORCE)[:-1], lambda paths: judge.durations(paths, 1.0)) == []
