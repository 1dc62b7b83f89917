"""The joint program's values against the compiled timing, its derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.polishing.drivable.front import DrivablePolisher
from hybrid_opt.polishing.drivable.intervals import IntervalGrid, IntervalValues
from hybrid_opt.polishing.drivable.program import Iterate, JointProgram, Multipliers
from hybrid_opt.polishing.drivable.timed import Goal
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.placed_carry import CarryReader
from hybrid_opt.polishing.program import place_values
from hybrid_opt.polishing.smooth_cell import SmoothCell
from symbolic.array import Array
from symbolic.records.task import initial_decision
from symbolic.smooth.reach import Reach
from tests.hybrid_opt.polishing.drivable.cells import (
    drivable_rack,
    functions,
    polisher,
    start,
    tilted,
)

FORCE = 52.0
ROWS = (PlaceRow(Reach(0), 150), PlaceRow(Reach(1), 250))


PolishedCell = tuple[DrivablePolisher, PolishFunctions]


class Programs:
    """Programs about points near one timed path."""

    def __init__(
        self, x: Array, duration: float | None = None, of: PolishedCell | None = None
    ) -> None:
        """of: another cell than the rack."""
        owner, self.functions = of or (polisher(), functions())
        workcell = owner.evaluator.workcell
        grid = Grid(workcell.task)
        self.cell = SmoothCell(workcell, self.functions, grid)
        self.half = self.cell.unit.half[:-1]
        self.x, self.duration = x, duration
        self.timed = owner.drivable.judge.timed(x[:-1], Goal("duration", FORCE))
        self.carry = CarryReader(owner.evaluator, grid, self.functions.rows).read(x)
        self.intervals = IntervalGrid(workcell, 100)

    def at(self, d: Array | None = None) -> JointProgram:
        """The program after a step d of the scaled variables from the path."""
        x, squared = self.x.copy(), self.timed.squared.copy()
        if d is not None:
            n = len(self.half)
            x[:n] += self.half * d[:n]
            squared[1:-1] *= 1.0 + d[-len(squared) + 2 :]
        driven = self.functions.driven
        assert driven is not None
        values = IntervalValues.at(self.intervals, driven, x, squared, self.timed.joints)
        places = (ROWS, place_values(self.cell, ROWS, self.carry), np.array([0.01, 0.01]))
        iterate = Iterate(x, squared, FORCE, self.duration)
        return JointProgram(self.intervals, iterate, values, self.half, places)


def direction(program: JointProgram, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    d = rng.normal(size=program.n)
    d[: program.n_path] *= 0.1
    d[program.n_path : program.n_border] = 0.0
    return d


def test_the_compiled_timing_satisfies_the_program() -> None:
    programs = Programs(start(FORCE))
    program = programs.at()
    assert program.total == pytest.approx(programs.timed.duration, rel=1e-12)
    assert program.rows.max() < 2e-3
    # Time-optimal: some limit is used fully in nearly every interval.
    by_interval = program.rows.max(axis=1).reshape(-1, 2).max(axis=1)
    assert np.mean(by_interval > -0.01) > 0.9


@pytest.mark.parametrize("seed", [0, 1])
def test_rows_have_exact_slopes(seed: int) -> None:
    assert_slopes(Programs(start(FORCE, seed)), seed)


def assert_slopes(programs: Programs, seed: int) -> None:
    """Rows by differences along a random direction."""
    program = programs.at()
    d, h = direction(program, seed), 1e-6
    difference = (programs.at(h * d).rows - programs.at(-h * d).rows) / (2.0 * h)
    foretold = program.predicted(d) - program.rows
    assert np.abs(difference - foretold).max() < 1e-6 * np.abs(foretold).max()
    chosen = program.near()
    linear = program.linear(chosen)
    rows = linear.A.times(d) * linear.scale
    m = int(chosen.sum())
    np.testing.assert_allclose(rows[:m], foretold[chosen], atol=1e-12 * np.abs(foretold).max())
    geometry = (programs.at(h * d).geometry - programs.at(-h * d).geometry) / (2.0 * h)
    np.testing.assert_allclose(rows[m:], geometry, rtol=1e-5, atol=1e-8)


def test_pressure_at_rest_has_rows_with_exact_slopes() -> None:
    programs = Programs(tilted(FORCE))
    program, h = programs.at(), 1e-6
    assert len(program.geometry) > len(ROWS)
    d = direction(program, 2)
    chosen = program.near()
    linear = program.linear(chosen)
    rows = (linear.A.times(d) * linear.scale)[int(chosen.sum()) :]
    difference = (programs.at(h * d).geometry - programs.at(-h * d).geometry) / (2.0 * h)
    np.testing.assert_allclose(rows, difference, rtol=1e-5, atol=1e-7)


def test_slopes_exist_where_the_box_does_not_turn() -> None:
    x = initial_decision(drivable_rack().task)
    x[-1] = FORCE
    program = Programs(x).at()
    assert np.isfinite(program.linear(program.near()).A.dense()).all()


@pytest.mark.parametrize("duration", [None, 3.0])
def test_the_lagrangian_has_exact_curvature(duration: float | None) -> None:
    assert_curvature(Programs(start(FORCE), duration), duration)


def assert_curvature(programs: Programs, duration: float | None) -> None:
    """Gradients by differences along a random direction."""
    program = programs.at()
    chosen = program.near()
    rng = np.random.default_rng(3)
    timing = np.where(chosen, rng.random(chosen.shape), 0.0)
    weights = rng.random(len(ROWS))
    multipliers = Multipliers(timing, weights, 0.0 if duration is None else 0.7)
    d, h = direction(program, 5), 1e-6

    def gradient(sign: float) -> Array:
        moved = programs.at(sign * h * d)
        linear = moved.linear(chosen)
        A = linear.A.dense() * linear.scale[:, None]
        share = 1.0 if duration is None else 0.7
        total = np.zeros(program.n)
        total[program.speeds] = share * moved.cost * moved.total / program.total
        total += A[: int(chosen.sum())].T @ timing[chosen]
        total += A[int(chosen.sum()) :][: len(ROWS)].T @ weights
        # Slopes by omega there are slopes by w times another w.
        total[program.speeds] /= 1.0 + sign * h * d[program.speeds]
        return total

    difference = (gradient(1.0) - gradient(-1.0)) / (2.0 * h)
    curvature = program.curvature(multipliers).dense()
    np.testing.assert_allclose(curvature, curvature.T, atol=1e-9 * np.abs(curvature).max())
    found = curvature @ d
    np.testing.assert_allclose(program.curvature(multipliers).times(d), found, atol=1e-12)
    still = np.arange(program.n) != program.n_path if duration else slice(None)
    assert np.abs(difference - found)[still].max() < 1e-5 * np.abs(found).max()


def test_geometry_after_a_step_is_what_its_slopes_do_not_foretell() -> None:
    programs = Programs(start(FORCE))
    program = programs.at()
    d = 0.1 * direction(program, 1)
    after = programs.at(d).geometry
    linear = program.linear(program.near())
    foretold = program.geometry + linear.A.times(d)[-len(ROWS) :]
    np.testing.assert_allclose(program.geometry_after(d), after - foretold, atol=1e-8)
