"""What a climb trusts and remembers, and which rows keep a payload from an obstacle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.polishing.cell import PlacedCarry
from hybrid_opt.polishing.constraints.distances import Gaps, edges, passing, separation
from hybrid_opt.polishing.constraints.kinds import RowSelector
from hybrid_opt.polishing.point import (
    ACTIVE_ROW_LIFETIME,
    LARGEST_RADIUS,
    Iterate,
    Step,
    StepEvaluation,
    StepMethod,
    TrustRegion,
    TrustRegionSolve,
    WorkingSet,
)
from hybrid_opt.polishing.rows import PathRow, Row
from hybrid_opt.polishing.solvers.base import UNKNOWN
from symbolic.array import Array
from symbolic.smooth.passage import AxisSwitchGap, SeparatingAxisGap
from symbolic.smooth.path_points import Clearance

LEAST = 1e-3


def test_it_grows_after_two_steps_in_a_row_that_it_stopped() -> None:
    region = TrustRegion(0.5, LEAST)
    region.on_accept(0.5)
    assert region.radius == 0.5
    region.on_accept(0.5)
    assert region.radius == 1.0
    region.on_reject(is_new=True)
    region.on_accept(1.0)
    assert region.radius == 1.0


def test_a_promised_gain_tells_at_once_whether_the_model_holds() -> None:
    region = TrustRegion(0.5, LEAST)
    region.on_accept(0.5, reduction_ratio=0.5)
    assert region.radius == 0.5
    region.on_accept(0.5, reduction_ratio=0.9)
    assert region.radius == 1.0
    region.on_accept(0.1, reduction_ratio=2.0)
    assert region.radius == 1.0
    region.on_accept(0.1, reduction_ratio=0.1)
    assert region.radius == 0.5


@given(st.lists(st.sampled_from(["lost", "refused", "barren", "taken"]), max_size=40))
def test_it_never_exceeds_its_largest_and_is_spent_at_last(events: list[str]) -> None:
    region = TrustRegion(1.0, LEAST)
    for event in events:
        match event:
            case "lost":
                region.on_failed_subproblem()
            case "refused":
                region.on_reject(is_new=False)
            case "barren":
                region.on_no_improvement(region.radius / 2.0)
            case _:
                region.on_accept(region.radius)
        assert 0.0 < region.radius <= LARGEST_RADIUS
    for _ in range(20):
        region.on_failed_subproblem()
    assert region.is_exhausted


NOTHING = cast(PlacedCarry, None)
NEAR, FAR, GAP = (
    PathRow(Clearance(0, 0), 3),
    PathRow(Clearance(0, 0), 9),
    PathRow(SeparatingAxisGap(1, 2), 5),
)
HALF = np.array([0.5, 2.0])
HERE, THERE = np.zeros(2), np.array([0.1, 0.0])
"""A path, and one that is 0.2 half ranges away."""


class RowsOfOne:
    """Requires 1 of every row and demands 3; rows of clearances last."""

    def near_rows(self, *_: Any) -> set[Row]:
        return {NEAR}

    def required_values(
        self, carry: PlacedCarry, rows: Iterable[Row], is_relaxed: bool
    ) -> dict[Row, float]:
        return dict.fromkeys(rows, 1.0)

    def tightened_bounds(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Iterable[Row], before: Mapping[Row, Any]
    ) -> dict[Row, float]:
        return dict.fromkeys(rows, 3.0)

    def persists(self, row: Row) -> bool:
        return row != GAP

    def violated_rows(self, carry: Any, known: Any, asked: Any) -> set[Row]:
        return {FAR} if carry.is_refused else set()


class Foretold(StepMethod[Iterate, Step]):
    """Steps with known gains of a level of 1; without one a step is refused."""

    least_radius = 0.0

    def __init__(self, gains: list[float | None]) -> None:
        self.half, self.active, self._gains = HALF, cast(RowSelector, RowsOfOne()), iter(gains)
        self.cell = cast(Any, SimpleNamespace(task=SimpleNamespace(lower=-HALF, upper=HALF)))

    def evaluate(self, x: Array) -> Iterate:
        return Iterate(x, NOTHING, 1.0)

    def propose_step(self, best: Iterate, required: Mapping[Row, float], radius: float) -> Step:
        return Step(length=0.1, required=required, residuals=lambda _: UNKNOWN, iterations=1)

    def evaluate_step(self, best: Iterate, step: Step) -> StepEvaluation[Iterate]:
        gain = next(self._gains)
        carry = cast(PlacedCarry, SimpleNamespace(is_refused=gain is None, is_reachable=True))
        return StepEvaluation(Iterate(best.x, carry, best.level - (gain or 0.0)), improved=True)

    def evaluate_fraction(self, *_: Any) -> None:
        return None


def test_rounds_that_bring_little_end_a_climb_after_its_first_step() -> None:
    climb = TrustRegionSolve(Foretold([None, None, None, 0.1, 1e-5, 1e-5, 0.1]), HERE, 0.2)
    assert climb.run(7, least_gain=1e-3).rounds == 6
    assert climb.best.level == pytest.approx(0.9 - 2e-5)


def memory() -> WorkingSet:
    return WorkingSet(cast(RowSelector, RowsOfOne()), HALF)


def required(known: WorkingSet, radius: float = 0.2) -> dict[Row, float]:
    values = dict.fromkeys({NEAR} | known.rows, 1.0)
    known.tighten(values, HERE, radius)
    return values


@pytest.mark.parametrize(("radius", "share"), [(0.4, 1.0), (0.2, 1.0), (0.1, 0.5), (0.0, 0.0)])
def test_what_a_step_taught_counts_as_far_as_the_box_reaches(radius: float, share: float) -> None:
    known = memory()
    assert known.learn_from_rejection({FAR: 3.0}, THERE, {})
    assert required(known, radius) == pytest.approx({NEAR: 1.0, FAR: 1.0 + 2.0 * share})


def test_rows_that_pressed_stay_for_some_programs_while_steps_are_short() -> None:
    known = memory()
    known.mark_active([FAR])
    for _ in range(ACTIVE_ROW_LIFETIME - 1):
        known.mark_active([])
        known.on_new_best(keep_active_set=True)
        assert set(required(known)) == {NEAR, FAR}
    known.mark_active([])
    assert set(required(known)) == {NEAR}
    known.mark_active([GAP])
    known.on_new_best(keep_active_set=False)
    assert set(required(known)) == {NEAR}


PLACES, LOW = 120, 0.06


def v_shape(kink: float, height: float, slope: float = 3e-3) -> Gaps:
    """Two gaps that cross at a point: one falls, the other rises."""
    away = np.arange(PLACES) - kink
    return Gaps.from_values(np.column_stack([height - slope * away, height + slope * away]))


@given(kink=st.floats(20.0, 100.0), height=st.floats(-0.02, LOW - 0.01))
def test_where_an_edge_is_passed_there_is_one_kink(kink: float, height: float) -> None:
    gaps = v_shape(kink, height)
    ((before, point),) = edges(gaps, LOW)
    assert abs(point - kink) <= 1.0
    assert before <= kink <= before + 1
    row = passing(7, gaps, before, point)
    assert row == PathRow(AxisSwitchGap(7, 0, 1), point)


def test_a_separation_is_of_the_largest_gap() -> None:
    gaps = v_shape(50.4, 0.01)
    assert separation(3, gaps, 20) == PathRow(SeparatingAxisGap(3, 0), 20)
    assert separation(3, gaps, 80) == PathRow(SeparatingAxisGap(3, 1), 80)
