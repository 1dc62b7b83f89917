"""Forces of the joint allocation in the polish: against the evaluator, differences, and in use."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from codegen.interpreted import InterpretedFunction
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.constraints.forces import CONE_TIGHT, Forces
from hybrid_opt.polishing.constraints.kind import Surroundings
from hybrid_opt.polishing.force_values import ForceValues
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions, quantities_of
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.layout import HELD, ForceRow
from hybrid_opt.polishing.placed_carry import CarryReader
from hybrid_opt.polishing.program import SmoothProgram
from hybrid_opt.polishing.settings import FillSettings, PolishSettings
from hybrid_opt.polishing.smooth_cell import SmoothCell
from studies.run import main
from symbolic.array import Array
from symbolic.functions import candidate_function
from symbolic.read.cell import load
from symbolic.records import TimeLaw, Workcell
from symbolic.records.task import initial_decision
from symbolic.smooth.held import held_functions
from symbolic.smooth.samples import sample_blocks, sample_functions
from tests.hybrid_opt.polishing.test_program import (
    TARGET,
    require_curvature,
    require_jacobian,
    require_same,
)
from tests.symbolic.cells import ROOT, hand_cell, hand_model
from tests.symbolic.read.samples import RACK

WORKCELLS = ROOT / "studies" / "workcells"
SMALL = PolishSettings(attempts=4, fill=FillSettings(attempts=2))


def jointly(cell: Workcell, radius: float, centre_of_mass: list[float]) -> Workcell:
    """A cell whose pads press jointly, on round patches of a radius [m]."""
    first, second = (replace(contact, patch_radius=radius) for contact in cell.contacts)
    payload = replace(cell.payload, centre_of_mass=np.array(centre_of_mass))
    task = replace(cell.task, allocation="joint")
    return replace(cell, contacts=(first, second), task=task, payload=payload)


def force_values(cell: Workcell, rows: list[ForceRow]) -> ForceValues:
    """Of rows, interpreted."""
    samples = {
        key: InterpretedFunction(function)
        for quantity in quantities_of(cell)
        for key, function in sample_functions(cell, quantity).items()
    }
    held = {key: InterpretedFunction(f) for key, f in held_functions(cell).items()}
    functions = PolishFunctions(samples, {}, None, held)  # type: ignore[arg-type]
    return ForceValues(rows, sample_blocks(cell.task), functions, 0.0)


def short_hand_cell(time_law: TimeLaw) -> Workcell:
    cell = jointly(hand_cell(), 0.02, [0.01, 0.03, -0.02])
    return replace(cell, task=replace(cell.task, samples=7, time_law=time_law))


@pytest.mark.parametrize("time_law", ["constant", "ramped"])
def test_forces_are_the_evaluators_but_for_the_barriers(time_law: TimeLaw) -> None:
    cell = short_hand_cell(time_law)
    values = force_values(cell, [ForceRow(0, HELD, k) for k in range(7)])
    evaluate = candidate_function(hand_model(cell))
    for seed in range(3):
        x = np.random.default_rng(seed).uniform(cell.task.lower, cell.task.upper)
        outputs = dict(zip(evaluate.name_out(), evaluate(x), strict=True))
        exact = np.array(outputs["normal_force"]).T
        found = values.values(x)[values.column]
        np.testing.assert_allclose(found, exact, rtol=2e-3)
        assert (found > exact).any()


@pytest.mark.parametrize("time_law", ["constant", "ramped"])
def test_derivatives_by_the_decision_vector_are_those_of_differences(time_law: TimeLaw) -> None:
    cell = short_hand_cell(time_law)
    rows = [ForceRow(0, HELD, k) for k in (0, 2, 3, 6)] + [ForceRow(1, CONE_TIGHT, 4)]
    values = force_values(cell, rows)
    rng = np.random.default_rng(4)
    x = rng.uniform(cell.task.lower, cell.task.upper)
    weight, step = rng.normal(size=(values.count, 2)), 1e-6

    def at(point: Array) -> tuple[Array, Array]:
        values.values(point)
        return values.split.found.copy(), np.einsum("kix,ki->x", values.gradients, weight)

    pairs = [(at(x + step * d), at(x - step * d)) for d in np.eye(len(x))]
    of_values = np.stack([(a[0] - b[0]) / (2 * step) for a, b in pairs], axis=-1)
    of_slopes = np.stack([(a[1] - b[1]) / (2 * step) for a, b in pairs], axis=-1)
    values.values(x)
    np.testing.assert_allclose(values.gradients, of_values, rtol=1e-5, atol=1e-4)
    exact = values.second(x, weight)
    np.testing.assert_allclose(exact, of_slopes, atol=1e-5 * np.abs(exact).max())


@cache
def judge_of(name: str) -> CandidateEvaluator:
    """The rack with small patches that press jointly, or a shipped cell."""
    if name == "rack":
        return CandidateEvaluator(jointly(load(RACK), 0.022, [0.0, 0.02, 0.0]))
    return CandidateEvaluator(load(WORKCELLS / f"{name}.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rack", "drum"])
def test_a_programs_derivatives_are_exact_and_c_says_what_numpy_says(name: str) -> None:
    judge = judge_of(name)
    task, grid = judge.workcell.task, Grid(judge.workcell.task)
    functions = polish_functions(judge.compiled)
    x = initial_decision(task)
    carry = CarryReader(judge, grid, functions.rows).read(x)
    every = range(0, task.samples, 3)
    rows = [ForceRow(robot, HELD, sample) for sample in every for robot in (0, 1)]
    if judge.workcell.has_facing_pads:
        rows += [ForceRow(0, CONE_TIGHT, sample) for sample in range(0, task.samples, 7)]
    programs = []
    for interpreted in (False, True):
        cell = SmoothCell(judge.workcell, functions, grid, rounding=1e-3)
        if interpreted:
            cell.bind = lambda parts: None
        programs.append(SmoothProgram(cell, dict.fromkeys(rows, 0.01), TARGET, carry, x, 1.0))
    program, other = programs
    z = program.start.copy()
    values = program.constraints(z)[0][program.layout.forces]
    exact = [
        carry.force[row.sample, row.robot] / task.reference_force[row.robot]
        for row in program.layout.force_rows
        if row.branch == HELD
    ]
    scaled = [
        (value + z[program.layout.peaks][row.robot]) * TARGET.span[row.robot]
        + TARGET.anchor[row.robot]
        for row, value in zip(program.layout.force_rows, values.tolist(), strict=True)
        if row.branch == HELD
    ]
    np.testing.assert_allclose(scaled, exact, rtol=1e-9)
    z[program.layout.decision] += np.random.default_rng(0).uniform(-0.05, 0.05, task.n_var)
    z = np.clip(z, program.low, program.high)
    require_jacobian(program, z)
    require_curvature(program, z)
    require_same(program, other, z)


@pytest.mark.slow
def test_rows_are_the_papers_where_patches_suffice_and_joint_ones_elsewhere() -> None:
    judge = judge_of("rack")
    grid, functions = Grid(judge.workcell.task), polish_functions(judge.compiled)
    cell = SmoothCell(judge.workcell, functions, grid)
    # Some of it is turned so much that the patches do not suffice.
    x = np.random.default_rng(0).uniform(judge.lower, judge.upper)
    carry = CarryReader(judge, grid, functions.rows).read(x)
    rows = set(Forces(Surroundings(judge, cell, PolishSettings())).near(carry, TARGET))
    held = {row.sample for row in rows if row.branch == HELD}
    closed = {row.sample for row in rows if row.branch == CONE_TIGHT}
    assert held
    assert closed
    assert not held & closed
    papers = np.einsum("rk,nk->nr", cell.coefficients[:, CONE_TIGHT], carry.split)
    for sample in closed:
        np.testing.assert_allclose(carry.force[sample], papers[sample], rtol=1e-5)
        assert carry.shift[sample].max() <= PolishSettings().near.pressure_share
    assert any((carry.force[sample] > 1.01 * papers[sample]).all() for sample in held)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["drum", "uneven"])
def test_a_front_gets_better_and_all_of_it_is_believed(name: str) -> None:
    cell = ho.Cell.load(WORKCELLS / f"{name}.toml")
    front = ho.search(cell, "nsga2", evaluations=200, rng=np.random.default_rng(1))
    done = ho.polish(cell, front, rng=np.random.default_rng(1), settings=SMALL)
    assert done.hypervolume() > front.hypervolume() + 1e-3
    for point in front.objectives:
        assert (done.objectives <= point + 1e-12).all(axis=1).any()
    again = cell.evaluator.certified(cell.evaluator.evaluate(np.array(done.x)))
    assert again.feasible.all()
    np.testing.assert_allclose(again.objectives, done.objectives, rtol=1e-12)
    assert done.polished is not None
    accepted = [one for one in done.polished.outcomes if one.status == "accepted"]
    assert np.median([one.residuals.stationarity for one in accepted]) < 1e-2


@pytest.mark.slow
def test_a_study_polishes_a_cell_without_closed_form(tmp_path: Path) -> None:
    output = tmp_path / "results"
    arguments = [str(WORKCELLS / "drum.toml"), "--output", str(output), "--replicas", "1"]
    arguments += ["--evaluations", "120", "--polish-attempts", "2", "--no-drivable", "--no-report"]
    arguments += ["--algorithm", "nsga2"]
    assert main([*arguments, "--jobs", "1", "--quiet"]) == 0
    summary = json.loads((output / "summary.json").read_text(encoding="utf-8"))
    (replica,) = summary["algorithms"]["nsga2"]["replicas"]
    assert replica["polished"]["hypervolume"] > replica["hypervolume"] + 1e-3
