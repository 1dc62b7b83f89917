"""The assembled program: values against the full model, all derivatives against differences."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.functions import polish_functions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.layout import ForceRow, PlaceRow, PressureRow, Row
from hybrid_opt.polishing.placed_carry import CarryReader
from hybrid_opt.polishing.program import SmoothProgram
from hybrid_opt.polishing.smooth_cell import SmoothCell
from hybrid_opt.polishing.targets import Target
from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records.task import initial_decision
from symbolic.smooth.clearance import Clearance
from symbolic.smooth.joint_limit import JointLimit
from symbolic.smooth.passage import Passing, Separation
from symbolic.smooth.place import PlaceConstraint
from symbolic.smooth.reach import Reach
from tests.redundant_cells import rack_on_rail
from tests.symbolic.read.samples import RACK

TRANSFER = RACK.with_name("transfer.toml")

TARGET = Target(
    anchor=np.array([0.42, 0.43]),
    span=np.array([0.01, 0.02]),
    direction=np.array([1.0, 0.7]),
    offset=np.array([0.0, 0.1]),
    cost=np.array([1.0, 1e-4, 2e-4]),
)


CELLS = pytest.mark.parametrize(
    "path",
    [
        pytest.param(RACK, id="rack"),
        # The ramped time law is differentiated as a whole, which takes long to compile.
        pytest.param(TRANSFER, id="transfer", marks=pytest.mark.slow),
    ],
)


@cache
def evaluator(path: Path) -> CandidateEvaluator:
    return CandidateEvaluator(load(path))


@cache
def made(path: Path) -> tuple[SmoothProgram, Array]:
    """`program_of` a cell."""
    return program_of(evaluator(path))


def program_of(judge: CandidateEvaluator, interpreted: bool = False) -> tuple[SmoothProgram, Array]:
    """A program with rows of every kind around the hand-made trajectory, and a point near it."""
    task, grid = judge.workcell.task, Grid(judge.workcell.task)
    cell = SmoothCell(judge.workcell, polish_functions(judge.compiled), grid)
    if interpreted:
        cell.bind = lambda parts: None
    x = initial_decision(task)
    carry = CarryReader(judge, grid, cell.functions.rows).read(x)
    box, *_ = sorted(cell.functions.rows.separable)
    arms = [k for k in range(carry.clearance.shape[1]) if k not in cell.functions.rows.separable]
    rows: list[Row] = [
        ForceRow(robot, branch, sample)
        for sample in range(0, task.samples, 7)
        for robot in (0, 1)
        for branch in (0, 3)
    ]
    rows += [
        PressureRow(1, 0),
        PressureRow(0, 40),
        PressureRow(1, 40),
        PressureRow(0, task.samples - 1),
    ]
    kinds: list[PlaceConstraint] = [
        Clearance(pair) for pair in (arms[0], arms[len(arms) // 2], arms[-1])
    ]
    kinds += [Separation(box, 3), Passing(box, 5, 0), Reach(0), Reach(1)]
    kinds += [JointLimit(0, 2, "lower"), JointLimit(1, 4, "upper")]
    rows += [PlaceRow(kind, place) for kind in kinds for place in (44, 120, 222)]
    program = SmoothProgram(cell, dict.fromkeys(rows, 0.01), TARGET, carry, x, 1.0)
    z = program.start.copy()
    z[program.layout.decision] += np.random.default_rng(0).uniform(-0.05, 0.05, task.n_var)
    return program, np.clip(z, program.low, program.high)


@CELLS
def test_jacobian_is_that_of_the_constraints(path: Path) -> None:
    require_jacobian(*made(path))


@CELLS
def test_curvature_is_that_of_the_constraints(path: Path) -> None:
    require_curvature(*made(path))


@pytest.mark.slow
def test_derivatives_by_the_path_of_a_slide_are_exact(tmp_path: Path) -> None:
    judge = CandidateEvaluator(rack_on_rail(tmp_path, 0.3, 0.1))
    program, z = program_of(judge)
    assert len(z) == 18 + 5 + 3
    require_jacobian(program, z)
    require_curvature(program, z)
    require_same(program, program_of(judge, interpreted=True)[0], z)


@CELLS
def test_rows_put_together_in_c_are_those_of_numpy(path: Path) -> None:
    (program, z), (other, _) = made(path), program_of(evaluator(path), interpreted=True)
    require_same(program, other, z)
    # A whole turn more is none.
    task, turned = evaluator(path).workcell.task, z.copy()
    turned[5] += 4.0 * np.pi / (task.upper[5] - task.lower[5])
    require_same(program, other, turned)
    places = program.layout.places
    values = program.constraints(z)[0][places].copy()
    np.testing.assert_allclose(program.constraints(turned)[0][places], values, atol=1e-9)


def require_same(program: SmoothProgram, other: SmoothProgram, z: Array) -> None:
    """Values and derivatives are, but for rounding; first where few rows matter, then all."""
    rng = np.random.default_rng(2)
    for few in (True, False):
        multipliers = rng.normal(size=program.layout.n_rows)
        if few:
            multipliers[rng.random(len(multipliers)) < 0.8] *= 1e-12
        for found, wanted in zip(program.constraints(z), other.constraints(z), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)
        wanted = other.curvature(z, multipliers)
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(program.curvature(z, multipliers), wanted, atol=1e-9 * scale)


def require_jacobian(program: SmoothProgram, z: Array) -> None:
    """It is that of differences."""
    step = 1e-6
    columns = [
        (program.constraints(z + step * d)[0] - program.constraints(z - step * d)[0]) / (2 * step)
        for d in np.eye(len(z))
    ]
    exact = program.constraints(z)[1]
    np.testing.assert_allclose(np.array(columns).T, exact, rtol=1e-5, atol=1e-4)


def require_curvature(program: SmoothProgram, z: Array) -> None:
    """It is that of differences."""
    multipliers = np.random.default_rng(1).normal(size=program.layout.n_rows)

    def slope(at: Array) -> Array:
        return program.constraints(at)[1].T @ multipliers

    step = 1e-6
    rows = [(slope(z + step * d) - slope(z - step * d)) / (2 * step) for d in np.eye(len(z))]
    np.testing.assert_allclose(
        np.array(rows), program.curvature(z, multipliers), rtol=1e-4, atol=1e-3
    )


@CELLS
def test_rows_of_samples_are_what_the_evaluator_finds(path: Path) -> None:
    program, z = made(path)
    cell, layout = evaluator(path).workcell, program.layout
    found = {k: v[0] for k, v in evaluator(path).outputs(program.candidate(z)[None]).items()}
    values = program.constraints(z)[0]

    leave = [
        1.0
        - (found["pressure_shift"][row.sample, row.robot] / cell.contacts[row.robot].patch_radius)
        ** 2
        for row in layout.pressure_rows
    ]
    np.testing.assert_allclose(values[layout.patches], leave, rtol=1e-9)

    # The ruling branch is the evaluator's force; the others lie below it.
    highest: dict[tuple[int, int], float] = {}
    for row, value in zip(layout.force_rows, values[layout.forces].tolist(), strict=True):
        key = (row.robot, row.sample)
        scaled = (value + z[layout.peaks][row.robot]) * TARGET.span[row.robot]
        highest[key] = max(highest.get(key, -np.inf), scaled + TARGET.anchor[row.robot])
    forces = [
        found["normal_force"][sample, robot] / cell.task.reference_force[robot]
        for robot, sample in highest
    ]
    np.testing.assert_allclose(list(highest.values()), forces, rtol=1e-9)


def test_rows_at_places_are_in_the_order_of_the_layout() -> None:
    program, z = made(RACK)
    layout = program.layout
    values = program.constraints(z)[0][layout.places]
    box = next(
        row.constraint.pair for row in layout.place_rows if isinstance(row.constraint, Separation)
    )
    grid = Grid(evaluator(RACK).workcell.task)
    functions = polish_functions(evaluator(RACK).compiled)
    carry = CarryReader(evaluator(RACK), grid, functions.rows).read(program.candidate(z))
    checked = 0
    for row, value in zip(layout.place_rows, values.tolist(), strict=True):
        kind = row.constraint
        if isinstance(kind, JointLimit):
            robot = evaluator(RACK).workcell.robots[kind.arm]
            q = carry.q[kind.arm][row.place, kind.joint]
            limit = robot.position_lower if kind.side == "lower" else robot.position_upper
            expected = abs(q - limit[kind.joint])
        elif isinstance(kind, Reach):
            expected = carry.manipulability[row.place, kind.arm] ** 2 - 1.0
            if row.place % grid.per_sample:
                continue
        elif isinstance(kind, Clearance):
            assert value * kind.scale <= carry.clearance[row.place, kind.pair] + 1e-9
            continue
        else:
            assert value * kind.scale <= carry.clearance[row.place, box] + 0.01
            continue
        assert value * kind.scale == pytest.approx(expected, rel=1e-6)
        checked += 1
    assert checked >= 6


def test_the_box_of_trust_bounds_the_decision_vector() -> None:
    program, _ = made(RACK)
    task = evaluator(RACK).workcell.task
    for z in (program.low, program.high):
        x = program.candidate(z)
        assert np.all(x >= task.lower - 1e-12)
        assert np.all(x <= task.upper + 1e-12)
