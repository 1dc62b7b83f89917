"""Sweeps over a cell's numbers: against single recommendations, and continued."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt import sweeping
from hybrid_opt.front import Front
from symbolic.errors import SettingsError, WorkcellError
from tests.symbolic.cells import RACK

OVER = {"payload.mass": [8.0, 10.0], "contacts.friction": [0.3, 1.0]}


@pytest.fixture(scope="module")
def cell() -> ho.Cell:
    return ho.Cell.load(RACK).drivable()


def test_a_fixed_path_is_what_it_is_in_each_cell(
    cell: ho.Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "sweep.json"
    found = ho.sweep(cell, cell.initial, OVER, fixed=True, file=file)
    assert [row.values for row in found.rows] == [(8, 0.3), (8, 1), (10, 0.3), (10, 1)]
    none, light, _, heavy = found.rows
    assert np.isnan(none.duration)
    assert "friction" in none.remark
    assert light.force < heavy.force
    one = cell.changed({"payload.mass": 8.0, "contacts.friction": 1.0})
    x = np.append(one.initial[:-1], one.workcell.task.force_limit[1])
    own = ho.recommend(Front.of_search(one, "given", one.evaluator.certified(one.evaluate(x))))
    # Around the least product both are exchanged at hardly any cost.
    least = own.duration * own.force
    assert light.duration * light.force == pytest.approx(least, rel=1e-2)
    np.testing.assert_array_equal(light.x[:-1], cell.initial[:-1])

    def again(*_: object) -> None:
        raise AssertionError("what is stored was computed again")

    with monkeypatch.context() as patched:
        patched.setattr(sweeping, "_row", again)
        same = ho.sweep(cell, cell.initial, OVER, fixed=True, file=file)
    assert repr(same) == repr(found)
    with pytest.raises(SettingsError, match="another cell, or over other values"):
        ho.sweep(cell, cell.initial, OVER, file=file)


@pytest.mark.slow
def test_a_polished_path_is_better_than_the_fixed_one(cell: ho.Cell) -> None:
    over = {"payload.mass": [9.0]}
    fixed = ho.sweep(cell, cell.initial, over, fixed=True).rows[0]
    free = ho.sweep(cell, cell.initial, over).rows[0]
    assert free.duration * free.force < 0.95 * fixed.duration * fixed.force
    assert not np.array_equal(free.x[:-1], cell.initial[:-1])


def test_wrong_sweeps_are_refused(cell: ho.Cell) -> None:
    with pytest.raises(SettingsError, match="needs keys, and values of each"):
        ho.sweep(cell, cell.initial, {})
    with pytest.raises(SettingsError, match="takes a drivable cell"):
        ho.sweep(ho.Cell.load(RACK), cell.initial[:-1], OVER)
    with pytest.raises(WorkcellError, match=r"payload\.weight"):
        ho.sweep(cell, cell.initial, {"payload.weight": [1.0]})
