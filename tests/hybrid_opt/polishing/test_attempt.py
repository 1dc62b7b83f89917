"""One attempt: what is raised costs it alone."""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.attempt import Lost, solve_safely
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.residuals import UNKNOWN


def good() -> Solution:
    return Solution(np.full(2, 2.0), "fine", True, True, UNKNOWN, 1, 1, 0)


def bad() -> Solution:
    raise ValueError("no good\nat all")


def test_a_solution_is_handed_on() -> None:
    found = solve_safely(good)
    assert isinstance(found, Solution)
    np.testing.assert_array_equal(found.x, [2.0, 2.0])


def test_what_is_raised_is_a_lost_attempt() -> None:
    assert solve_safely(bad) == Lost("ValueError: no good")
