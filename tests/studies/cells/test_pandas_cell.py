"""The cell of two Pandas that ships: redundant elbows that pass portals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import LockedEvaluator
from studies.research.locked_joints import compare, locks
from studies.run import main
from symbolic.read.cell import load
from tests.symbolic.read.samples import RACK

PANDAS = RACK.with_name("pandas.toml")


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell(load(PANDAS))


def test_elbows_are_mirrored(cell: Cell) -> None:
    north, south = cell.workcell.task.redundant
    assert (north.name, south.name) == ("north/panda_joint3", "south/panda_joint3")
    np.testing.assert_array_equal(north.initial, -south.initial)
    np.testing.assert_array_equal(north.lower, -south.upper)


@pytest.mark.slow
def test_the_hand_made_trajectory_is_feasible_and_the_bounds_searchable(cell: Cell) -> None:
    judged = cell.evaluate(cell.initial)
    assert judged.feasible.all()
    share = cell.evaluate(cell.random(1000, np.random.default_rng(1))).feasible.mean()
    assert 0.02 <= share <= 0.2


@pytest.mark.slow
def test_constant_elbows_ask_for_another_path_of_the_box(cell: Cell) -> None:
    x = cell.initial[None, : cell.workcell.task.n_box]
    tried = [LockedEvaluator(cell.evaluator, np.array(p)) for p in locks(cell.workcell.task, 16)]
    assert not any(one.evaluate(x).feasible.all() for one in tried)
    others = cell.random(400, np.random.default_rng(1))[:, : cell.workcell.task.n_box]
    assert 2 <= sum(one.evaluate(others).feasible.any() for one in tried) <= 8


@pytest.mark.slow
def test_elbows_that_move_beat_the_best_lock(cell: Cell) -> None:
    (found,) = compare(cell, 16, 1, 300, 1)
    assert found.free > max(found.locked) > 0.3


@pytest.mark.slow
def test_a_small_study_goes_through(tmp_path: Path) -> None:
    output = tmp_path / "results"
    arguments = [str(PANDAS), "--output", str(output), "--replicas", "1", "--evaluations", "120"]
    assert main([*arguments, "--no-polish", "--no-report", "--jobs", "1", "--quiet"]) == 0
    assert (output / "summary.json").exists()
