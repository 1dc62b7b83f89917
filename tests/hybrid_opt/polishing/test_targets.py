"""Scalarisations: what they prefer, checked on points of the objective plane."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.targets import (
    CLOSED_SIDE,
    balance,
    epsilon_constraint,
    extreme,
    level,
    needed_level,
    pascoletti_serafini,
)
from symbolic.errors import SettingsError

ANCHOR, SPAN = np.array([0.42, 0.43]), np.array([0.01, 0.02])
shifts = st.tuples(*[st.floats(-0.02, 0.02)] * 2).map(np.array)


@given(shifts)
def test_pascoletti_serafini_is_better_only_where_neither_side_is_worse(shift: np.ndarray) -> None:
    target = pascoletti_serafini(ANCHOR, SPAN)
    better = level(target, ANCHOR + shift) < level(target, ANCHOR) - 1e-3
    if better:
        assert np.all(shift <= 0.0)
    # The level is the larger of both scaled shifts.
    assert needed_level(target, shift / SPAN) == pytest.approx(float(np.max(shift / SPAN)))


@given(shifts)
def test_epsilon_constraint_improves_one_side_and_holds_the_other(shift: np.ndarray) -> None:
    for objective in (0, 1):
        target = epsilon_constraint(ANCHOR, SPAN, objective)
        other = 1 - objective
        value = level(target, ANCHOR + shift)
        if shift[other] > 1.01 * CLOSED_SIDE * SPAN[other]:
            assert value == float("inf")
        elif shift[objective] < -1e-4 and shift[other] < 0.0:
            assert value < level(target, ANCHOR)


@given(shifts, shifts)
def test_an_end_compares_one_objective_and_breaks_ties(a: np.ndarray, b: np.ndarray) -> None:
    for objective in (0, 1):
        target = extreme(ANCHOR, SPAN, objective)
        if a[objective] < b[objective] - 1e-4:
            assert level(target, ANCHOR + a) < level(target, ANCHOR + b)
        a_tied = a.copy()
        a_tied[1 - objective] -= 0.01
        assert level(target, ANCHOR + a_tied) < level(target, ANCHOR + a)


@given(shifts, shifts)
def test_the_middle_compares_sums_and_the_larger(a: np.ndarray, b: np.ndarray) -> None:
    target = balance(ANCHOR, np.full(2, 0.01))
    first, second = ANCHOR + a, ANCHOR + b
    if a.sum() < b.sum() - 1e-4 and first.max() <= second.max():
        assert level(target, first) < level(target, second)
    even = np.full(2, first.mean())
    assert level(target, even) <= level(target, first) + 1e-12


def test_a_normal_reaches_both_ends_of_its_chord_alike() -> None:
    normal = np.array([0.6, 0.8])
    target = pascoletti_serafini(ANCHOR, SPAN, normal)
    assert needed_level(target, -0.5 * normal) == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("attempts", -1),
        ("attempts", 2.5),
        ("max_iterations", 0),
        ("rounds", 0),
        ("margin", 0.0),
        ("max_seconds", float("nan")),
        ("method", "weights"),
    ],
)
def test_wrong_settings_are_told(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=f"polish {name}"):
        PolishSettings(**{name: value})  # type: ignore[arg-type]


def test_settings_are_the_same_after_json() -> None:
    settings = asdict(PolishSettings())
    assert json.loads(json.dumps(settings)) == settings
