"""A robot as people have it, from its files to evaluated candidates and an inspection; the oracle
is the same cell written plainly."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import REASONS
from studies.programs.inspection import inspected
from studies.research.plain.candidate import PlainJudge
from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.functions import candidate_function
from tests.described_cells import SOURCES, described_cell, plain_cell


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("described")
    with pytest.MonkeyPatch.context() as patch:
        for variable, name in zip(SOURCES, ("ament", "ros"), strict=True):
            patch.setenv(variable, str(folder / name))
        patch.syspath_prepend(str(folder / "site"))
        yield Cell(described_cell(folder))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    return build_cell_model(plain_cell(tmp_path_factory.mktemp("plain")))


def candidates(cell: Cell) -> Array:
    """The hand-made trajectory and some around it, of which not all are feasible."""
    rng = np.random.default_rng(1)
    near = cell.initial + rng.uniform(-0.06, 0.06, (5, len(cell.initial)))
    return np.vstack([cell.initial, np.clip(near, cell.lower, cell.upper)])


def test_the_model_is_that_of_the_plain_cell(described: Cell, plain: CellModel) -> None:
    model = described.compiled.model
    assert model.robots[0].joint_names == plain.robots[0].joint_names
    found, expected = (set(map(frozenset, m.geometry.pair_names)) for m in (model, plain))
    assert found == expected
    assert not any("left/grip" in name for pair in model.geometry.pair_names for name in pair)
    for x in candidates(described):
        values = (candidate_function(m)(ca.DM(x)) for m in (model, plain))
        for value, other in zip(*values, strict=True):
            np.testing.assert_allclose(np.array(value), np.array(other), atol=1e-9)


@pytest.mark.slow
def test_verdicts_are_those_of_the_plain_cell(described: Cell, plain: CellModel) -> None:
    x = candidates(described)
    judge = PlainJudge(plain.workcell, plain.start)
    judged = described.evaluate(x)
    assert judged.feasible[0]
    for row, values in enumerate(x):
        expected = judge(values)
        assert bool(judged.feasible[row]) == expected.feasible
        if not expected.feasible:
            assert REASONS[int(judged.reason[row])] == expected.reason


@pytest.mark.slow
def test_an_inspection_tells_of_it(described: Cell, tmp_path: Path) -> None:
    view = tmp_path / "view.html"
    parts = list(inspected(described.workcell, 40, 1, view=view, pairs=True))
    text = "\n".join(line for part in parts for line in part.lines)
    assert "left/link_1 – left/link_4: disabled in gofa.srdf: Never" in text
    why = {
        frozenset(pair[:2]): pair[2]
        for part in parts
        for pair in part.values.get("excluded_pairs", ())
    }
    pair = frozenset(("right/grip_finger", "middle board"))
    assert why[pair] == "ignored in the file: for the test"
    assert "left/grip_finger" not in text
    assert (tmp_path / "view.html").exists()
