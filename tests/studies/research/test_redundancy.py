"""Redundant joints against locked ones: the grid of locks, and a small comparison."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from studies.research.locked_joints import as_text, compare, locks
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from tests.redundant_cells import free_pandas
from tests.symbolic.read.samples import RACK


def test_locks_are_a_grid_within_the_bounds(tmp_path: Path) -> None:
    task = free_pandas(tmp_path, "initial = 0.1, lower = [-1.0, -0.2, 0.0], upper = 1.0").task
    found = np.array(locks(task, 16))
    assert found.shape == (16, 2)
    np.testing.assert_allclose(np.unique(found[:, 0]), [-0.75, -0.25, 0.25, 0.75])
    assert len({tuple(row) for row in found.tolist()}) == 16
    assert len(locks(task, 10)) == 16


def test_a_small_comparison(tmp_path: Path) -> None:
    cell = Cell(free_pandas(tmp_path, "initial = 0.1"))
    (one,) = compare(cell, 4, 1, 60, 1)
    assert len(one.locked) == 4
    assert one.best == locks(cell.workcell.task, 4)[int(np.argmax(one.locked))]
    assert "free beats the best lock in" in as_text([one])


def test_a_cell_without_redundant_joints_has_nothing_to_compare() -> None:
    with pytest.raises(SettingsError, match="no joint of this cell is redundant"):
        compare(Cell(load(RACK)), 16, 1, 60, 1)
