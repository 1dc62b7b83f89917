"""What a climb remembers of geometric rows, with a set of rows that answers from tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, cast

import numpy as np
import pytest

from hybrid_opt.polishing.carry import PlacedCarry
from hybrid_opt.polishing.constraints.active import KEPT, ActiveSet, LearnedRows
from hybrid_opt.polishing.rows import PlaceRow, Row
from symbolic.smooth.passage import Separation
from symbolic.smooth.places import Clearance

NOTHING = cast(PlacedCarry, None)
NEAR, FAR, GAP = (
    PlaceRow(Clearance(0, 0), 3),
    PlaceRow(Clearance(0, 0), 9),
    PlaceRow(Separation(1, 2), 5),
)
HALF = np.array([0.5, 2.0])
HERE, THERE = np.zeros(2), np.array([0.1, 0.0])
"""A path, and one that is 0.2 half ranges away."""


class Rows:
    """Requires 1 of every row and demands 3; rows of clearances last."""

    def near(self, *_: Any) -> set[Row]:
        return {NEAR}

    def required(self, carry: PlacedCarry, rows: Iterable[Row], lenient: bool) -> dict[Row, float]:
        return dict.fromkeys(rows, 1.0)

    def demanded(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Iterable[Row], before: Mapping[Row, Any]
    ) -> dict[Row, float]:
        return dict.fromkeys(rows, 3.0)

    def lasting(self, row: Row) -> bool:
        return row != GAP


def memory() -> LearnedRows:
    return LearnedRows(cast(ActiveSet, Rows()), HALF)


def required(known: LearnedRows, radius: float = 0.2) -> dict[Row, float]:
    return known.required(NOTHING, (True, True), HERE, radius, lenient=False)


@pytest.mark.parametrize(("radius", "share"), [(0.4, 1.0), (0.2, 1.0), (0.1, 0.5), (0.0, 0.0)])
def test_what_a_step_taught_counts_as_far_as_the_box_reaches(radius: float, share: float) -> None:
    known = memory()
    assert known.refuse(NOTHING, NOTHING, THERE, [FAR], {})
    assert required(known, radius) == pytest.approx({NEAR: 1.0, FAR: 1.0 + 2.0 * share})


def test_rows_that_pressed_stay_for_some_programs_while_steps_are_short() -> None:
    known = memory()
    known.press([FAR])
    for _ in range(KEPT - 1):
        known.press([])
        known.move(is_short=True)
        assert set(required(known)) == {NEAR, FAR}
    known.press([])
    assert set(required(known)) == {NEAR}
    known.press([GAP])
    known.move(is_short=False)
    assert set(required(known)) == {NEAR}
