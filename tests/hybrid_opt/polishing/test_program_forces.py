"""Forces that a program finds in the polish: against the evaluator, differences, and in use."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.cell import CarryReader
from hybrid_opt.polishing.force import ForceProgram
from hybrid_opt.polishing.rows import PROGRAM_BRANCH, ForceRow, Row
from hybrid_opt.polishing.settings import FillSettings, PolishSettings
from studies.run import main
from symbolic.cell_model import build_cell_model
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
from tests.symbolic.cells import ROOT

WORKCELLS = ROOT / "studies" / "workcells"
SMALL = PolishSettings(attempts=4, fill=FillSettings(attempts=2))


def drum() -> Workcell:
    return load(WORKCELLS / "drum.toml")


def test_forces_are_the_evaluators_but_for_the_barriers() -> None:
    cell = drum()
    cell = replace(cell, task=replace(cell.task, samples=7))
    loads = sample_functions(cell, "load")[sample_name("load", "path", "first")]
    held = grasp_force_functions(cell)[grasp_force_name("first")]
    evaluate = candidate_function(build_cell_model(cell))
    x = initial_decision(cell.task)
    outputs = dict(zip(evaluate.name_out(), evaluate(x), strict=True))
    exact = np.array(outputs["normal_force"]).T
    load_of = np.array(loads(x, 0.0, 0.0)[0]).reshape(7, 6)
    found = np.array([np.array(held(each)[0]).ravel() for each in load_of])
    np.testing.assert_allclose(found, exact, rtol=2e-3)
    assert (found > exact).any()


@pytest.mark.slow
def test_a_programs_derivatives_are_exact() -> None:
    judge = CandidateEvaluator(drum())
    task, cell = judge.workcell.task, smooth_cell(judge)
    x = initial_decision(task)
    carry = CarryReader(cell).read(x)
    every = range(0, task.samples, 3)
    rows: list[Row] = [
        ForceRow(robot, PROGRAM_BRANCH, sample) for sample in every for robot in (0, 1)
    ]
    program = ForceProgram(cell, dict.fromkeys(rows, 0.01), TARGET, carry, x, 1.0)
    z = program.start.copy()
    values = program.rows(z)[0][program.layout.forces]
    scaled = [
        (z[-3:][row.robot] - value) * TARGET.span[row.robot] + TARGET.anchor[row.robot]
        for row, value in zip(program.layout.force_rows, values.tolist(), strict=True)
    ]
    exact = [
        carry.force[row.sample, row.robot] / task.reference_force[row.robot]
        for row in program.layout.force_rows
    ]
    np.testing.assert_allclose(scaled, exact, rtol=1e-9)
    z[: task.n_var] += np.random.default_rng(0).uniform(-0.05, 0.05, task.n_var)
    z = np.clip(z, program.low, program.high)
    require_jacobian(program, z)
    require_curvature(program, z)


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
