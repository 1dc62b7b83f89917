"""Compiled timings within robust forces: against `time_path` and a convex program."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.robust.cases import worst_cases
from hybrid_opt.robust.force import robust_model
from hybrid_opt.timing import PathTimer, TimingLimits, TimingStatus, drive_path, time_path
from symbolic.records import Uncertainty, Workcell
from tests.hybrid_opt.timing import convex_oracle
from tests.hybrid_opt.timing.cells import initial, near_initial, timing_of
from tests.hybrid_opt.timing.robust_oracle import robust_limit
from tests.hybrid_opt.timing.test_robust_limit import SET
from tests.symbolic.cells import hand_cell, hand_model

INTERVALS = 100


def unsure(uncertainty: Uncertainty = SET) -> Workcell:
    return replace(hand_cell(), uncertainty=uncertainty)


@cache
def timer() -> PathTimer:
    cell = unsure()
    return PathTimer(CompiledCell(cell, model=hand_model(cell)), INTERVALS, lanes=1)


def test_they_agree_with_time_path_and_keep_the_limit_on_the_tenfold_grid() -> None:
    model = timing_of(timer().workcell, INTERVALS)
    paths = np.vstack([initial(), near_initial(np.random.default_rng(3), 2)])
    limits = [TimingLimits(force=force, robust=True) for force in (63.0, 70.0, 75.0)]
    for x, limit, found in zip(paths, limits, timer().time_all(paths, limits), strict=True):
        expected = time_path(model, x, limit)
        assert found.ok, (found.status, expected.reason)
        assert found.duration == pytest.approx(expected.duration, rel=1e-3)
        judged = drive_path(model, x, found.grid_speed, limit)
        assert judged.ok, judged.reason
        assert judged.carry is not None
        peak = robust_model(model.workcell).robust_force(judged.carry).peak
        assert (peak <= 1.005 * (limit.force or 0.0)).all()
        assert found.robust_force == pytest.approx(peak, rel=1e-3)
        assert found.robust_force is not None
        assert found.peak_force.max() < found.robust_force.max()


def test_they_agree_with_a_convex_program() -> None:
    """Of four cases, each with wrenches of its own as variables."""
    some = Uncertainty(0.1, 0.05, np.array([0.005, 0.0, 0.0]), 0.003, np.array([0.0, 0.3, 0.0]))
    cell, intervals = unsure(some), 24
    model = timing_of(cell, intervals)
    limits = TimingLimits(force=64.0, torque=False, pressure=False, robust=True)
    other = PathTimer(CompiledCell(cell, model=hand_model(cell)), intervals, lanes=1)
    cases = list(worst_cases(cell, some))
    assert len(cases) == 4
    exact = convex_oracle.shortest_duration(
        model, initial(), limits, robust_limit(cases, 0.95 / 1.05)
    )
    found = other.time(initial(), limits)
    plain = other.time(initial(), replace(limits, robust=False))
    assert found.duration == pytest.approx(exact, rel=3e-3)
    assert found.duration > 1.02 * plain.duration


def test_one_nominal_case_changes_nothing() -> None:
    """Where the patches suffice the least squeeze is the planned one."""
    cell = unsure(Uncertainty())
    one = PathTimer(CompiledCell(cell, model=hand_model(cell)), INTERVALS, lanes=1)
    for force in (51.0, 60.0):
        robust = one.time(initial(), TimingLimits(force=force, robust=True))
        planned = one.time(initial(), TimingLimits(force=force))
        assert robust.duration == pytest.approx(planned.duration, rel=5e-4)
        assert robust.robust_force == pytest.approx(planned.peak_force, rel=5e-4)


def test_what_cannot_stand_still_says_with_what_force_it_could() -> None:
    weak, strong = timer().time_all(
        np.array([initial(), initial()]),
        [TimingLimits(force=force, robust=True) for force in (55.0, 63.0)],
    )
    assert strong.ok
    assert weak.status is TimingStatus.INFEASIBLE_AT_REST
    assert weak.place.constraint == "normal force"
    needed = 55.0 * weak.use["normal force"]
    assert needed == pytest.approx(weak.peak_force.max())
    still = timer().time(initial(), TimingLimits(force=1.002 * needed, robust=True))
    assert still.ok
    at_rest = timer().time(initial(), TimingLimits(force=0.998 * needed, robust=True))
    assert at_rest.status is TimingStatus.INFEASIBLE_AT_REST


def test_a_batch_gives_what_single_calls_give() -> None:
    paths = np.vstack([initial(), near_initial(np.random.default_rng(8), 2), initial()])
    paths[3] += np.tile([-2.0, 0, 0, 0, 0, 0], 3)
    limits = [
        TimingLimits(force=64.0, robust=True),
        TimingLimits(force=60.0),
        TimingLimits(force=70.0, robust=True),
        TimingLimits(force=70.0, robust=True),
    ]
    together = timer().time_all(paths, limits)
    for x, limit, timing in zip(paths, limits, together, strict=True):
        alone = timer().time(x, limit)
        assert alone.status is timing.status
        np.testing.assert_allclose(alone.grid_speed, timing.grid_speed, rtol=1e-9)
    assert together[3].status is TimingStatus.OFF_PATH
