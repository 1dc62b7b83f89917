"""Targets by what they prefer; the assembled program: values against the full model and CasADi's
expressions, all derivatives against differences."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.cell import CarryReader
from hybrid_opt.polishing.force import (
    ForceProgram,
    Scalarisation,
    balanced_scalarisation,
    extreme_scalarisation,
    pascoletti_serafini,
)
from hybrid_opt.polishing.rows import ConstraintRows, ForceRow, PathRow, PressureRow, Row, RowLayout
from hybrid_opt.polishing.settings import FillSettings, PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.task import initial_decision
from symbolic.smooth.passage import AxisSwitchGap, SeparatingAxisGap
from symbolic.smooth.path_points import (
    Clearance,
    JointLimit,
    ManipulabilityLimit,
    PathConstraint,
    PathPointSymbols,
    closure_functions,
    closure_name,
    row_function,
)
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.polishing.cells import smooth_cell
from tests.odd_cells import rack_on_rail
from tests.symbolic.read.samples import RACK

TRANSFER = RACK.with_name("transfer.toml")

TARGET = Scalarisation(
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


def evaluator(path: Path) -> CandidateEvaluator:
    return shipped(path.stem).evaluator


@cache
def made(path: Path) -> tuple[ForceProgram, Array]:
    """`program_of` a cell."""
    return program_of(evaluator(path))


def program_of(judge: CandidateEvaluator) -> tuple[ForceProgram, Array]:
    """A program with rows of every kind around the hand-made trajectory, and a point near it."""
    task, cell = judge.workcell.task, smooth_cell(judge)
    x = initial_decision(task)
    carry = CarryReader(cell).read(x)
    box, *_ = sorted(cell.functions.separable)
    separable, pairs = cell.functions.separable, carry.distances.bounds.shape[1]
    columns = cell.evaluator.checker.geometry.columns
    arms = [k for k in range(pairs) if k not in separable]
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
    kinds: list[PathConstraint] = [
        Clearance(pair, int(columns[pair])) for pair in (arms[0], arms[len(arms) // 2], arms[-1])
    ]
    kinds += [
        SeparatingAxisGap(box, 3),
        AxisSwitchGap(box, 5, 0),
        ManipulabilityLimit(0),
        ManipulabilityLimit(1),
    ]
    kinds += [JointLimit(0, 2, "lower"), JointLimit(1, 4, "upper")]
    rows += [PathRow(kind, point) for kind in kinds for point in (44, 120, 222)]
    program = ForceProgram(cell, dict.fromkeys(rows, 0.01), TARGET, carry, x, 1.0)
    z = program.start.copy()
    z[: task.n_var] += np.random.default_rng(0).uniform(-0.05, 0.05, task.n_var)
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


@CELLS
def test_a_whole_turn_more_is_none(path: Path) -> None:
    program, z = made(path)
    task, turned = evaluator(path).workcell.task, z.copy()
    turned[5] += 4.0 * np.pi / (task.upper[5] - task.lower[5])
    points = program.layout.points
    values = program.rows(z)[0][points].copy()
    np.testing.assert_allclose(program.rows(turned)[0][points], values, atol=1e-9)


def require_jacobian(program: ForceProgram, z: Array) -> None:
    """It is that of differences."""
    step = 1e-6
    columns = [
        (program.rows(z + step * d)[0] - program.rows(z - step * d)[0]) / (2 * step)
        for d in np.eye(len(z))
    ]
    exact = program.rows(z)[1]
    np.testing.assert_allclose(np.array(columns).T, exact, rtol=1e-5, atol=1e-4)


def require_curvature(program: ForceProgram, z: Array) -> None:
    """It is that of differences."""
    multipliers = np.random.default_rng(1).normal(size=program.layout.n_rows)

    def slope(at: Array) -> Array:
        return program.rows(at)[1].T @ multipliers

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
    values = program.rows(z)[0]

    leave = [
        1.0
        - (found["pressure_shift"][row.sample, row.robot] / cell.contacts[row.robot].patch_radius)
        ** 2
        for row in layout.pressure_rows
    ]
    # The time law's kinks are rounded, which is corrected at the program's candidate alone.
    np.testing.assert_allclose(values[layout.patches] + 0.01, leave, rtol=1e-6)

    # The ruling branch is the evaluator's force; the others lie below it.
    highest: dict[tuple[int, int], float] = {}
    for row, value in zip(layout.force_rows, values[layout.forces].tolist(), strict=True):
        key = (row.robot, row.sample)
        scaled = (z[-3:][row.robot] - value) * TARGET.span[row.robot]
        highest[key] = max(highest.get(key, -np.inf), scaled + TARGET.anchor[row.robot])
    forces = [
        found["normal_force"][sample, robot] / cell.task.reference_force[robot]
        for robot, sample in highest
    ]
    np.testing.assert_allclose(list(highest.values()), forces, rtol=1e-6)


def test_the_box_of_trust_bounds_the_decision_vector() -> None:
    program, _ = made(RACK)
    task = evaluator(RACK).workcell.task
    for z in (program.low, program.high):
        x = program.candidate(z)
        assert np.all(x >= task.lower - 1e-12)
        assert np.all(x <= task.upper + 1e-12)


ANCHOR, SPAN = np.array([0.42, 0.43]), np.array([0.01, 0.02])
shifts = st.tuples(*[st.floats(-0.02, 0.02)] * 2).map(np.array)


@given(shifts)
def test_pascoletti_serafini_is_better_only_where_neither_side_is_worse(shift: np.ndarray) -> None:
    target = pascoletti_serafini(ANCHOR, SPAN)
    better = target.level(ANCHOR + shift) < target.level(ANCHOR) - 1e-3
    if better:
        assert np.all(shift <= 0.0)
    # The level is the larger of both scaled shifts.
    assert target.least_level(shift / SPAN) == pytest.approx(float(np.max(shift / SPAN)))


@given(shifts, shifts)
def test_an_end_compares_one_objective_and_breaks_ties(a: np.ndarray, b: np.ndarray) -> None:
    for objective in (0, 1):
        target = extreme_scalarisation(ANCHOR, SPAN, objective)
        if a[objective] < b[objective] - 1e-4:
            assert target.level(ANCHOR + a) < target.level(ANCHOR + b)
        a_tied = a.copy()
        a_tied[1 - objective] -= 0.01
        assert target.level(ANCHOR + a_tied) < target.level(ANCHOR + a)


@given(shifts, shifts)
def test_the_middle_compares_sums_and_the_larger(a: np.ndarray, b: np.ndarray) -> None:
    target = balanced_scalarisation(ANCHOR, np.full(2, 0.01))
    first, second = ANCHOR + a, ANCHOR + b
    if a.sum() < b.sum() - 1e-4 and first.max() <= second.max():
        assert target.level(first) < target.level(second)
    even = np.full(2, first.mean())
    assert target.level(even) <= target.level(first) + 1e-12


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("attempts", -1),
        ("attempts", 2.5),
        ("max_iterations", 0),
        ("rounds", 0),
        ("clearance", 0.0),
        ("clearance", float("nan")),
        ("solver", "simplex"),
    ],
)
def test_wrong_settings_are_told(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=f"polish {name}"):
        PolishSettings(**{name: value})  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match=r"polish fill\.members"):
        FillSettings(members=-1)


def test_settings_are_the_same_after_json() -> None:
    settings = asdict(PolishSettings())
    assert json.loads(json.dumps(settings)) == settings


def written(constraint: PathConstraint, point: int, x: Array, near: tuple[Array, Array]) -> Array:
    """A row's value, then its gradient by the decision vector: CasADi's functions one by one,
    joints following the box by the implicit function.

    Args:
        near: both arms' joints near those that hold the box there.
    """
    cell, model = smooth_cell(evaluator(RACK)), evaluator(RACK).compiled.model
    front_attempts, symbols = cell.waypoints(x), PathPointSymbols(model)
    pose, rate = (
        basis[point] @ front_attempts for basis in (cell.grid.basis, cell.grid.rate_basis)
    )
    joints, follow = [], []
    for arm in (0, 1):
        closure = closure_functions(model, arm)[closure_name(arm, "first")]
        q, by_pose, _ = (np.array(out) for out in closure(pose, near[arm]))
        joints.append(q.ravel())
        follow.append(by_pose)
    numbers = [constraint.numbers(symbols)] if constraint.count(symbols) else []
    value, gradient = row_function(symbols, constraint, "first")(pose, rate, *joints, *numbers)
    slope = np.array(gradient).ravel()
    by_pose, at = slope[:6].copy(), 6
    by_rate = np.zeros(6)
    if constraint.moving:
        by_rate, at = slope[6:12], 12
    for arm in constraint.arms(model):
        by_pose += follow[arm].T @ slope[at : at + 6]
        at += 6
    rows, columns = cell.free
    by_x = cell.grid.basis[point][rows] * by_pose[columns]
    by_x += cell.grid.rate_basis[point][rows] * by_rate[columns]
    return np.append(float(ca.DM(value)), by_x) / constraint.scale


def test_values_and_slopes_are_those_of_the_expressions() -> None:
    cell = smooth_cell(evaluator(RACK))
    x = initial_decision(cell.task)
    carry = CarryReader(cell).read(x)
    box, *_ = sorted(cell.functions.separable)
    arm = next(k for k in range(99) if k not in cell.functions.separable)
    column = int(cell.evaluator.checker.geometry.columns[arm])
    kinds: list[PathConstraint] = [
        Clearance(arm, column),
        ManipulabilityLimit(1),
        JointLimit(0, 2, "lower"),
    ]
    kinds += [JointLimit(1, 4, "upper"), SeparatingAxisGap(box, 3), AxisSwitchGap(box, 5, 0)]
    listed: list[Row] = [PathRow(kind, point) for kind in kinds for point in (60, 150)]
    layout = RowLayout(listed)
    rows = ConstraintRows(cell, layout, carry.q)
    x = x + np.random.default_rng(0).uniform(-0.02, 0.02, len(x))
    values, slopes = rows.values(x), rows.slopes()
    for k, row in enumerate(layout.point_rows):
        near = carry.q[0][row.point], carry.q[1][row.point]
        wanted = written(row.constraint, row.point, x, near)
        found = np.append(values[k], slopes[k])
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-8)
