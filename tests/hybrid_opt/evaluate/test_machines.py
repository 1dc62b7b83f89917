"""Carries of machines with two arms, and of arms with a seventh joint, evaluated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from codegen.build import build
from codegen.interpreted import InterpretedFunction
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from studies.research.plain.candidate import PlainJudge
from studies.research.turns import interleaved
from symbolic.array import Array
from symbolic.cell_model import build_cell_model
from symbolic.functions import cell_functions
from symbolic.records import Workcell
from symbolic.records.task import initial_decision
from tests.hybrid_opt.evaluate.test_evaluation import assert_agrees
from tests.machines import MACHINES, SINGLE, cell_of
from tests.odd_cells import free_pandas, locked_pandas, machine_on_lift, seven_joints
from tests.symbolic.cells import with_task

pytestmark = pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")

AGREEMENT = 1e-11
"""Largest difference of compiled and interpreted values, absolute or relative."""

SEVEN = [name for name, arm in SINGLE.items() if arm.locked] + list(MACHINES)
"""Those whose arms have seven joints, of which one is else held."""

ASIDE = 0.2
"""How far redundant joints are from where they hold the box, within their limits [rad or m]."""


def around(workcell: Workcell, n: int, seed: int, widening: float) -> Array:
    """Candidates (n, n_var) around the one in the middle, in bounds widened by a factor."""
    task = workcell.task
    middle, half = initial_decision(task), (task.upper - task.lower) / 2.0
    room = np.minimum(middle - task.lower, task.upper - middle)
    half[task.n_box :] = np.minimum(ASIDE, room[task.n_box :])
    half *= widening
    return np.random.default_rng(seed).uniform(middle - half, middle + half, (n, len(half)))


def agree(workcell: Workcell, fully: bool = True) -> None:
    """Hold verdicts and values of candidates, compiled, interpreted and plain, to one another.

    Args:
        fully: as searches evaluate, in lanes and optimised; else without both, which is compiled
            much faster.
    """
    model = build_cell_model(workcell)
    made = cell_functions(model)
    plainly = None if fully else build(made, levels=dict.fromkeys(made, 0)).functions
    compiled = CandidateEvaluator(workcell, functions=plainly)
    functions = {name: InterpretedFunction(function) for name, function in made.items()}
    interpreted = CandidateEvaluator(workcell, functions=functions)
    n = 6 if fully else 3
    x = np.vstack([around(workcell, n, 7, 1.0), around(workcell, n, 8, 10.0)])
    found, expected = compiled.evaluate(x), interpreted.evaluate(x)
    assert len(np.unique(expected.reason)) > 1, "verdicts of one kind prove little"
    outputs = compiled.outputs(x)
    pairs = {name: (getattr(found, name), values) for name, values in vars(expected).items()}
    pairs |= {name: (outputs[name], values) for name, values in interpreted.outputs(x).items()}
    for name, (here, there) in pairs.items():
        if there.dtype == float:
            np.testing.assert_allclose(here, there, rtol=AGREEMENT, atol=AGREEMENT, err_msg=name)
        else:
            np.testing.assert_array_equal(here, there, err_msg=name)
    plain = PlainJudge(workcell, model.start)
    for k, values in enumerate(x):
        assert_agrees(found, k, plain(values))


@pytest.mark.slow
def test_six_joints_and_both_arms_in_one_file(tmp_path: Path) -> None:
    agree(cell_of("pr2", tmp_path), fully=False)


def test_seven_joints(tmp_path: Path) -> None:
    agree(seven_joints("panda", tmp_path), fully=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SINGLE, *MACHINES])
def test_every_machine_with_six_joints(name: str, tmp_path: Path) -> None:
    agree(cell_of(name, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("name", SEVEN)
def test_every_machine_with_seven_joints(name: str, tmp_path: Path) -> None:
    agree(seven_joints(name, tmp_path))


@pytest.mark.slow
def test_both_arms_on_one_lift(tmp_path: Path) -> None:
    agree(machine_on_lift(tmp_path, 0.1, free=True))


ANGLE = 0.1
SAMPLES = 100
MOST_COST = 1.35
"""Of a seven-joint candidate, in one of six joints."""

DRAWN, BATCH = 2000, 64


@pytest.fixture(scope="module")
def pandas(tmp_path_factory: pytest.TempPathFactory) -> tuple[Cell, Cell]:
    """With seven joints per arm, and with six."""

    def cell(workcell: Workcell) -> Cell:
        return Cell(with_task(workcell, samples=SAMPLES))

    free = free_pandas(tmp_path_factory.mktemp("free"), f"initial = {ANGLE}")
    return cell(free), cell(locked_pandas(tmp_path_factory.mktemp("locked"), ANGLE))


def carries(pandas: tuple[Cell, Cell], spread: float) -> tuple[Array, Array]:
    """Candidates that are feasible in both, the same box paths: every sample of them counts.
    Redundant joints stray by so much [rad]."""
    free, locked = pandas
    rng = np.random.default_rng(2)
    box = locked.random(DRAWN, rng)
    more = ANGLE + rng.uniform(-spread, spread, (DRAWN, len(free.initial) - box.shape[1]))
    whole = np.hstack([box, more])
    fine = np.flatnonzero(free.evaluate(whole).feasible & locked.evaluate(box).feasible)[:BATCH]
    assert len(fine) == BATCH
    return whole[fine], box[fine]


@pytest.mark.slow
def test_it_costs_little(pandas: tuple[Cell, Cell]) -> None:
    x = carries(pandas, 0.05)
    times = interleaved(
        {"seven": pandas[0].evaluate, "six": pandas[1].evaluate},
        {"seven": x[0][None], "six": x[1][None]},
        30,
    )
    cost = float(np.median(times["seven"] / times["six"]))
    assert cost <= MOST_COST, f"a seven-joint candidate costs {cost:.2f} times one of six joints"
