"""Forces of the joint allocation in the polish: against the evaluator, differences, and in use."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.carry import CarryReader
from hybrid_opt.polishing.constraints.kinds import CONE_TIGHT, PRESSURE_SHARE, Forces
from hybrid_opt.polishing.force import ForceProgram
from hybrid_opt.polishing.rows import PROGRAM_BRANCH, ForceRow, Row
from hybrid_opt.polishing.settings import FillSettings, PolishSettings
from studies.run import main
from symbolic.functions import candidate_function
from symbolic.read.cell import load
from symbolic.records.cell import Workcell
from symbolic.records.task import initial_decision
from symbolic.smooth.samples import (
    grasp_force_functions,
    grasp_force_name,
    sample_functions,
    sample_name,
)
from tests.hybrid_opt.polishing.cells import smooth_cell
from tests.hybrid_opt.polishing.test_force import TARGET, require_curvature, require_jacobian
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


def test_forces_are_the_evaluators_but_for_the_barriers() -> None:
    cell = jointly(hand_cell(), 0.02, [0.01, 0.03, -0.02])
    cell = replace(cell, task=replace(cell.task, samples=7, time_law="ramped"))
    loads = sample_functions(cell, "load")[sample_name("load", "path", "first")]
    held = grasp_force_functions(cell)[grasp_force_name("first")]
    evaluate = candidate_function(hand_model(cell))
    for seed in range(3):
        x = np.random.default_rng(seed).uniform(cell.task.lower, cell.task.upper)
        outputs = dict(zip(evaluate.name_out(), evaluate(x), strict=True))
        exact = np.array(outputs["normal_force"]).T
        load_of = np.array(loads(x, 0.0, 0.0)[0]).reshape(7, 6)
        found = np.array([np.array(held(each)[0]).ravel() for each in load_of])
        np.testing.assert_allclose(found, exact, rtol=2e-3)
        assert (found > exact).any()


@cache
def judge_of(name: str) -> CandidateEvaluator:
    """The rack with small patches that press jointly, or a shipped cell."""
    if name == "rack":
        return CandidateEvaluator(jointly(load(RACK), 0.022, [0.0, 0.02, 0.0]))
    return CandidateEvaluator(load(WORKCELLS / f"{name}.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rack", "drum"])
def test_a_programs_derivatives_are_exact(name: str) -> None:
    judge = judge_of(name)
    task, cell = judge.workcell.task, smooth_cell(judge)
    x = initial_decision(task)
    carry = CarryReader(cell).read(x)
    every = range(0, task.samples, 3)
    rows: list[Row] = [
        ForceRow(robot, PROGRAM_BRANCH, sample) for sample in every for robot in (0, 1)
    ]
    if judge.workcell.has_facing_pads:
        rows += [ForceRow(0, CONE_TIGHT, sample) for sample in range(0, task.samples, 7)]
    program = ForceProgram(cell, dict.fromkeys(rows, 0.01), TARGET, carry, x, 1.0)
    z = program.start.copy()
    values = program.rows(z)[0][program.layout.forces]
    exact = [
        carry.force[row.sample, row.robot] / task.reference_force[row.robot]
        for row in program.layout.force_rows
        if row.branch == PROGRAM_BRANCH
    ]
    scaled = [
        (z[-3:][row.robot] - value) * TARGET.span[row.robot] + TARGET.anchor[row.robot]
        for row, value in zip(program.layout.force_rows, values.tolist(), strict=True)
        if row.branch == PROGRAM_BRANCH
    ]
    np.testing.assert_allclose(scaled, exact, rtol=1e-9)
    z[: task.n_var] += np.random.default_rng(0).uniform(-0.05, 0.05, task.n_var)
    z = np.clip(z, program.low, program.high)
    require_jacobian(program, z)
    require_curvature(program, z)


@pytest.mark.slow
def test_rows_are_the_papers_where_patches_suffice_and_joint_ones_elsewhere() -> None:
    judge = judge_of("rack")
    cell = smooth_cell(judge)
    # Some of it is turned so much that the patches do not suffice.
    x = np.random.default_rng(0).uniform(judge.lower, judge.upper)
    carry = CarryReader(cell).read(x)
    rows = set(Forces(cell).near_rows(carry, TARGET.limits))
    held = {row.sample for row in rows if row.branch == PROGRAM_BRANCH}
    closed = {row.sample for row in rows if row.branch == CONE_TIGHT}
    assert held
    assert closed
    assert not held & closed
    papers = np.einsum("rk,nk->nr", cell.coefficients[:, CONE_TIGHT], carry.split)
    for sample in closed:
        np.testing.assert_allclose(carry.force[sample], papers[sample], rtol=1e-5)
        assert carry.shift[sample].max() <= PRESSURE_SHARE
    assert any((carry.force[sample] > 1.01 * papers[sample]).all() for sample in held)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["drum", "uneven"])
def test_a_front_gets_better_and_all_of_it_is_believed(name: str) -> None:
    cell = ho.Cell.load(WORKCELLS / f"{name}.toml")
    front = ho.search(cell, "nsga2", evaluations=200, rng=np.random.default_rng(1))
    done = ho.polish(front, rng=np.random.default_rng(1), settings=SMALL)
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
