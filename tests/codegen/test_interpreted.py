"""The comparison itself: what counts as a difference."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from codegen.build import compile_function
from codegen.cache import Cache
from codegen.interpreted import compare, relative_difference


@pytest.mark.parametrize(
    ("reference", "other", "expected"),
    [
        ([2.0, 1.0], [2.0, 1.0], 0.0),
        ([2.0, 1.0], [2.0, 1.5], 0.25),
        ([np.nan, 4.0], [np.nan, 3.0], 0.25),
        ([np.nan, 4.0], [0.0, 4.0], np.inf),
        ([0.0, 4.0], [np.nan, 4.0], np.inf),
        ([np.inf], [np.inf], 0.0),
        ([np.inf], [-np.inf], np.inf),
        ([np.nan], [np.nan], 0.0),
        ([], [], 0.0),
        ([0.0], [1e-17], 1e-11),
    ],
)
def test_relative_difference(reference: list[float], other: list[float], expected: float) -> None:
    found = relative_difference(np.array(reference), np.array(other))
    assert found == pytest.approx(expected)


def test_another_function_is_told_apart(cache: Cache) -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.sin(x)], ["x"], ["y"])
    shifted = ca.Function("f", [x], [ca.sin(x) + 1e-9], ["x"], ["y"])
    bounds = {"x": (np.full(2, 0.5), np.full(2, 1.0))}
    rng = np.random.default_rng(0)
    same = compare(function, compile_function(function, cache), bounds, rng, cache=cache)
    assert same.agrees
    other = compare(function, compile_function(shifted, cache), bounds, rng, cache=cache)
    assert not other.agrees
    assert other.worst_output == "y"
    assert 1e-9 <= other.outputs < 3e-9


def test_inputs_stay_within_their_bounds(cache: Cache) -> None:
    """Outside the bounds this function is NaN, which would hide every difference."""
    x = ca.SX.sym("x", 2)
    inside = ca.if_else(ca.logic_and(x[0] > 3.0, x[0] < 4.0), x[0], 1e3)
    function = ca.Function("f", [x], [inside], ["x"], ["y"])
    other = ca.Function("f", [x], [x[0]], ["x"], ["y"])
    bounds = {"x": (np.full(2, 3.0), np.full(2, 4.0))}
    rng = np.random.default_rng(0)
    assert compare(function, compile_function(other, cache), bounds, rng, cache=cache).agrees
    loose = {"x": (np.full(2, 2.0), np.full(2, 5.0))}
    assert not compare(function, compile_function(other, cache), loose, rng, cache=cache).agrees
