"""The polish of a front of duration against force: the front door, resume, what it refuses."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES, duration_unit
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.front import PolishedFront
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.task import initial_decision
from tests.hybrid_opt.polishing.cells import (
    drivable_rack,
    drive_method,
    evaluator,
    functions,
    polisher,
    require_progress,
    start,
    tilted,
)
from tests.refusals import refused

BOUND = np.full(2, 1.1)


def starts() -> Array:
    return np.array([start(51.0), start(55.0, seed=1)])


TOLD: list[tuple[int, int]] = []
"""Attempts done and in all, as `polished` told them."""


@cache
def polished() -> PolishedFront:
    return polisher().polish(
        starts(),
        np.random.default_rng(0),
        on_progress=lambda done, total: TOLD.append((done, total)),
    )


def test_attempts_never_exceed_those_that_are_expected() -> None:
    require_progress(TOLD, len(polished().outcomes))


def test_the_front_dominates_more_than_before() -> None:
    before = evaluator().evaluate(starts()).objectives
    after = evaluator().certified(evaluator().evaluate(polished().x))
    assert after.feasible.all()
    np.testing.assert_array_equal(after.objectives, polished().objectives)
    assert metrics.hypervolume(after.objectives, BOUND) > metrics.hypervolume(before, BOUND) + 0.01
    assert any(outcome.status == "accepted" for outcome in polished().outcomes)


def fastest(paths: Array, forces: Array) -> Array:
    """(n,) [s] of any of some paths (k, n_path) within each force."""
    judge = drive_method().driver
    return np.array([judge.durations(paths, float(force)).min() for force in forces])


def test_the_front_reaches_from_the_gentlest_end_and_is_nowhere_behind_the_hand_made_path() -> None:
    x, task = polished().x, drivable_rack().task
    least = task.force_limit[0]
    assert x[:, -1].min() == pytest.approx(least)
    forces = np.geomspace(least - 0.999 * least, 60.0 - 0.999 * least, 40) + 0.999 * least
    hand_made = fastest(initial_decision(task)[None, :-1], forces)
    assert (fastest(x[:, :-1], forces) <= hand_made * (1.0 + 1e-9)).all()
    # Not only its paths, its points are: each at its own force.
    duration = x[:, -1], polished().objectives[:, 0] * duration_unit(drivable_rack())
    by_own = fastest(initial_decision(task)[None, :-1], duration[0])
    assert (duration[1] <= by_own * (1.0 + 1e-3)).all()


def test_known_paths_take_part() -> None:
    """Given a better path than all others, the front is nowhere behind it; given one that touches
    something, it does not notice."""
    climb = drive_method().solve_from(tilted(55.0))
    climb.run(4)
    known = climb.best.x[None, :-1]
    assert evaluator().evaluate(climb.best.x).feasible[0]
    sunk = known.copy()
    sunk[0, [2, 8, 14]] -= 0.2
    settings = DrivableSettings(first_rounds=1, rounds=1, members=4)
    owner = make_polisher(evaluator(), PolishSettings(attempts=1, drivable=settings), functions())
    rng = np.random.default_rng
    front = owner.polish(starts(), rng(0), paths=np.vstack([known, sunk]))
    forces = np.array([50.0, 53.0, 55.0])
    assert (fastest(front.x[:, :-1], forces) <= fastest(known, forces) * (1.0 + 1e-9)).all()
    alone = owner.polish(starts(), rng(0), paths=known)
    np.testing.assert_array_equal(alone.x, front.x)


def test_they_do_so_at_the_front_door() -> None:
    """Given as decision vectors, with a force limit or without."""
    settings = PolishSettings(
        attempts=1, drivable=DrivableSettings(first_rounds=1, rounds=1, members=2)
    )
    known, rng = tilted(55.0), np.random.default_rng
    owner = make_polisher(evaluator(), settings, functions())
    wanted = owner.polish(starts(), rng(0), paths=known[None, :-1])
    cell = ho.Cell(drivable_rack(), DRIVABLE_OBJECTIVES)
    found = evaluator().evaluate(starts())
    front = ho.Front(cell, "two", starts(), found.objectives, found)
    for path in (known, known[:-1]):
        polished = ho.polish(front, rng=rng(0), settings=settings, paths=[path])
        np.testing.assert_array_equal(polished.x, wanted.x)
    with pytest.raises(SettingsError, match=r"\(5,\).* 18 "):
        ho.polish(front, rng=rng(0), paths=[known[:5]])


def test_an_empty_front_stays_empty() -> None:
    assert len(polisher().polish(np.empty((0, 19)), np.random.default_rng(0)).x) == 0


def test_other_objectives_are_refused() -> None:
    other = CandidateEvaluator(
        drivable_rack(), ("duration", "mean_force"), compiled=evaluator().compiled
    )
    with refused(SettingsError, "objectives", "mean_force"):
        make_polisher(other, PolishSettings(), functions())
