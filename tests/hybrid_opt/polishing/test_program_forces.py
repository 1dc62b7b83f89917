"""Drivable carries whose forces a program finds: several pads of one arm."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import hybrid_opt as ho
from hybrid_opt.polishing.drive_front import second_opinion
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.timing.model import TimingModel
from tests.hybrid_opt.polishing.cells import solved, start_in, way_of
from tests.hybrid_opt.polishing.test_joint_program import Programs, assert_curvature, assert_slopes
from tests.symbolic.read.samples import RACK

pytestmark = pytest.mark.slow  # its functions compile for a minute

FORCE = 80.0


@pytest.fixture(scope="module")
def fork() -> Iterator[Polisher]:
    cell = ho.Cell.load(RACK.with_name("fork.toml")).drivable()  # its files last as long
    yield Polisher(cell.evaluator, PolishSettings(drivable=DrivableSettings(rounds=30)))
    del cell


def test_derivatives_are_exact(fork: Polisher) -> None:
    x = start_in(fork.evaluator.workcell, FORCE, 0)
    assert_slopes(Programs(x, fork), 0)
    assert_curvature(Programs(x, fork))


def test_a_carry_is_driven_better_believed_and_stationary(fork: Polisher) -> None:
    evaluator, way = fork.evaluator, way_of(fork)
    x = start_in(evaluator.workcell, FORCE, 0)
    solution = solved(way, x)
    assert evaluator.certified(evaluator.evaluate(solution.x)).feasible[0]
    before, after = (way.paths.timed(each[:-1], FORCE).duration for each in (x, solution.x))
    assert after < 0.85 * before
    model = TimingModel(evaluator.compiled, 100)
    assert evaluator.driver is not None
    assert second_opinion(evaluator.driver, model, solution.x) == ""
    assert max(solution.residuals.stationarity, solution.residuals.complementarity) < 1e-3
