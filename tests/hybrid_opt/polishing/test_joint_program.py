"""The joint program's values against the compiled timing, its derivatives against differences; also
of redundant joints and of forces that a program finds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.cell import CarryReader
from hybrid_opt.polishing.front import Polisher
from hybrid_opt.polishing.intervals import IntervalGrid, IntervalValues, PathTimingProgram
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.rows import PathRow, Row
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.records.task import initial_decision
from symbolic.smooth.path_points import ManipulabilityLimit
from tests.hybrid_opt.polishing.cells import (
    disbelieved,
    drivable_rack,
    drive_method_of,
    driven,
    polisher,
    smooth_cell,
    solved,
    start,
    start_in,
    tilted,
)
from tests.hybrid_opt.polishing.transcription import without_obstacles
from tests.odd_cells import rack_on_rail
from tests.symbolic.read.samples import RACK

FORCE = 52.0
ROWS = (PathRow(ManipulabilityLimit(0), 150), PathRow(ManipulabilityLimit(1), 250))


class Programs:
    """Programs about points near one timed path."""

    def __init__(
        self, x: Array, owner: Polisher | None = None, together: Array | None = None
    ) -> None:
        """owner: of another cell than the rack; together: (n_path, k) how the scaled waypoints
        follow fewer variables."""
        owner = owner or polisher()
        self.cell = smooth_cell(owner.evaluator)
        half, self.x = self.cell.half[:-1], x
        own: Array = np.eye(len(half)) if together is None else together
        spread: Array = half[:, None] * own
        self.timed = drive_method_of(owner).driver.time_candidate(x)
        self.carry = CarryReader(self.cell).read(x)
        self.intervals = IntervalGrid(self.cell.workcell, 100, spread)

    def at(self, d: Array | None = None) -> PathTimingProgram:
        """The program after a step d of the scaled variables from the path."""
        x, squared = self.x.copy(), self.timed.squared.copy()
        if d is not None:
            spread = self.intervals.spread
            x[: len(spread)] += spread @ d[: spread.shape[1]]
            squared[1:-1] *= 1.0 + d[-len(squared) + 2 :]
        functions, joints = self.cell.functions, self.timed.joints
        values = IntervalValues(self.intervals, functions, self.cell.waypoints(x), squared, joints)
        required: dict[Row, float] = dict.fromkeys(ROWS, 0.01)
        grid = self.intervals
        return PathTimingProgram(grid, values, x, squared, self.cell, required, self.carry)


def direction(program: PathTimingProgram, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    d: Array = rng.normal(size=program.n)
    d[: program.n_path] *= 0.1
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


def test_waypoints_that_follow_others_have_exact_slopes_and_curvature() -> None:
    together = np.random.default_rng(4).normal(size=(18, 5)) / 3.0
    programs = Programs(start(FORCE), together=together)
    assert programs.at().n_path == 5
    assert_slopes(programs, 6)
    assert_curvature(programs)


def assert_slopes(programs: Programs, seed: int) -> None:
    """Rows by differences along a random direction."""
    program = programs.at()
    d, h = direction(program, seed), 1e-6
    difference = (programs.at(h * d).rows - programs.at(-h * d).rows) / (2.0 * h)
    foretold = program.predicted(d) - program.rows
    assert np.abs(difference - foretold).max() < 1e-6 * np.abs(foretold).max()
    chosen = program.near_rows()
    linear = program.linear(chosen)
    rows = (linear.A @ d) * linear.scale
    m = int(chosen.sum())
    np.testing.assert_allclose(rows[:m], foretold[chosen], atol=1e-12 * np.abs(foretold).max())
    geometry = (programs.at(h * d).geometry - programs.at(-h * d).geometry) / (2.0 * h)
    np.testing.assert_allclose(rows[m:], geometry, rtol=1e-5, atol=1e-8)


def test_pressure_at_rest_has_rows_with_exact_slopes() -> None:
    programs = Programs(tilted(FORCE))
    program, h = programs.at(), 1e-6
    assert len(program.geometry) > len(ROWS)
    d = direction(program, 2)
    chosen = program.near_rows()
    linear = program.linear(chosen)
    rows = ((linear.A @ d) * linear.scale)[int(chosen.sum()) :]
    difference = (programs.at(h * d).geometry - programs.at(-h * d).geometry) / (2.0 * h)
    np.testing.assert_allclose(rows, difference, rtol=1e-5, atol=1e-7)


def test_slopes_exist_where_the_box_does_not_turn() -> None:
    x = initial_decision(drivable_rack().task)
    x[-1] = FORCE
    program = Programs(x).at()
    assert np.isfinite(program.linear(program.near_rows()).A).all()


def test_the_lagrangian_has_exact_curvature() -> None:
    assert_curvature(Programs(start(FORCE)))


def assert_curvature(programs: Programs) -> None:
    """Gradients by differences along a random direction."""
    program = programs.at()
    chosen = program.near_rows()
    step = program.linear(chosen)
    multipliers = np.random.default_rng(3).random(len(step.b))
    # Rows of the pressure at rest count as straight.
    multipliers[len(step.point) + len(ROWS) :] = 0.0
    d, h = direction(program, 5), 1e-6

    def gradient(sign: float) -> Array:
        moved = programs.at(sign * h * d)
        linear = moved.linear(chosen)
        A = linear.A * linear.scale[:, None]
        total = A[: len(step.b)].T @ (multipliers / step.scale)
        total[program.speeds] += moved.cost * moved.total / program.total
        # Slopes by omega there are slopes by w times another w.
        total[program.speeds] /= 1.0 + sign * h * d[program.speeds]
        return np.asarray(total)

    difference = (gradient(1.0) - gradient(-1.0)) / (2.0 * h)
    curvature = program.curvature(step, multipliers)
    np.testing.assert_allclose(curvature, curvature.T, atol=1e-9 * np.abs(curvature).max())
    found = curvature @ d
    assert np.abs(difference - found).max() < 1e-5 * np.abs(found).max()


def test_geometry_after_a_step_is_what_its_slopes_do_not_foretell() -> None:
    programs = Programs(start(FORCE))
    program = programs.at()
    d = 0.1 * direction(program, 1)
    after = programs.at(d).geometry
    linear = program.linear(program.near_rows())
    foretold = program.geometry + (linear.A @ d)[-len(ROWS) :]
    np.testing.assert_allclose(program.geometry_after(d), after - foretold, atol=1e-8)


FORK_FORCE = 80.0


@pytest.fixture(scope="module")
def fork() -> Iterator[Polisher]:
    cell = ho.Cell.load(RACK.with_name("fork.toml")).drivable()  # its files last as long
    yield make_polisher(cell.evaluator, PolishSettings())
    del cell


@pytest.mark.slow
def test_derivatives_of_found_forces_are_exact(fork: Polisher) -> None:
    x = start_in(fork.evaluator.workcell, FORK_FORCE, 0)
    assert_slopes(Programs(x, fork), 0)
    assert_curvature(Programs(x, fork))


@pytest.mark.slow
def test_a_carry_is_driven_better_believed_and_stationary(fork: Polisher) -> None:
    evaluator, drive_method = fork.evaluator, drive_method_of(fork)
    x = start_in(evaluator.workcell, FORK_FORCE, 0)
    solution = solved(drive_method, x)
    assert evaluator.certified(evaluator.evaluate(solution.x)).feasible[0]
    driven = (np.append(each[:-1], FORK_FORCE) for each in (x, solution.x))
    before, after = (drive_method.driver.time_candidate(each).duration for each in driven)
    assert after < 0.85 * before
    model = TimingModel(evaluator.compiled, 100)
    assert disbelieved(evaluator.driver, model, solution.x) == ""
    assert max(solution.residuals.stationarity, solution.residuals.complementarity) < 1e-3


RAIL_FORCE = 52.0


@pytest.fixture(scope="module")
def rail(tmp_path_factory: pytest.TempPathFactory) -> Polisher:
    """The rack without its obstacles, its left robot on a slide that may move half a metre in all:
    with them the robot's base, which moves, would touch what it stands on."""
    cell = without_obstacles(driven(rack_on_rail(tmp_path_factory.mktemp("rail"), 0.4, 0.25)))
    evaluator = CandidateEvaluator(cell, DRIVABLE_OBJECTIVES, compiled=CompiledCell(cell))
    return make_polisher(evaluator, PolishSettings())


@pytest.mark.slow
def test_derivatives_of_redundant_joints_are_exact(rail: Polisher) -> None:
    cell = rail.evaluator.workcell
    x = start_in(cell, RAIL_FORCE, 0)
    assert Programs(x, rail).at().n_path == 18 + len(cell.task.waypoints)
    assert_slopes(Programs(x, rail), 0)
    assert_curvature(Programs(x, rail))


@pytest.mark.slow
def test_a_carry_with_a_redundant_joint_is_driven_better_and_believed(rail: Polisher) -> None:
    evaluator, drive_method = rail.evaluator, drive_method_of(rail)
    x = start_in(evaluator.workcell, RAIL_FORCE, 0)
    begun = drive_method.driver.time_candidate(np.append(x[:-1], RAIL_FORCE)).duration
    found = solved(drive_method, x, 16)
    assert (
        drive_method.driver.time_candidate(np.append(found.x[:-1], RAIL_FORCE)).duration
        < 0.9 * begun
    )
    # The slide's values are used, not only the box's path.
    assert np.abs(found.x[18:-1] - x[18:-1]).max() > 1e-3
    assert evaluator.certified(evaluator.evaluate(found.x)).feasible[0]
    timings = TimingModel(evaluator.compiled, drive_method.driver.timer.intervals)
    assert disbelieved(drive_method.driver, timings, found.x) == ""
