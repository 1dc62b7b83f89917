"""Tables for a terminal."""

from __future__ import annotations

import math

from hybrid_opt.display.table import text_table
from studies.study.terminal import counted, number


def test_columns_are_aligned_and_the_head_is_underlined() -> None:
    rows = [["name", "kg", "why"], ["a", "1.5", "x"], ["longer", "10.25", ""]]
    assert text_table(rows, left=(0, 2)).splitlines() == [
        "name       kg  why",
        "------------------",
        "a         1.5  x",
        "longer  10.25",
    ]


def test_figures_that_do_not_exist_are_a_dash() -> None:
    assert [number(v, 2) for v in (1.005, None, math.nan, math.inf)] == ["1.00", "-", "-", "-"]
    assert number(0.5, 1, 100.0) == "50.0"


def test_one_thing_is_not_plural() -> None:
    assert [counted(n, "replica") for n in (0, 1, 2)] == ["0 replicas", "1 replica", "2 replicas"]
