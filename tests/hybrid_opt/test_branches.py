"""The competition of start branches, on the rack with all of them allowed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.branches import BranchCompetition, search_branches
from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.campaign.stages import decided_cell, read_branches, store_branches
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES, front_rows
from hybrid_opt.indicators.metrics import hypervolume
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.records import SEARCHED_BRANCH
from tests.refusals import refused
from tests.symbolic.read.samples import RACK

TRANSFER = RACK.with_name("transfer.toml")


@pytest.fixture(scope="module")
def cell() -> Cell:
    # Its digest is the rack's, so that the rack's compiled functions serve it.
    return Cell(replace(load(RACK), start_branch=(SEARCHED_BRANCH, SEARCHED_BRANCH)))


@pytest.fixture(scope="module")
def found(cell: Cell) -> BranchCompetition:
    return search_branches(cell, evaluations=600, rng=np.random.default_rng(1))


def test_every_pair_is_there_once_and_the_best_wins(cell: Cell, found: BranchCompetition) -> None:
    model = cell.compiled.model
    assert len(found.pairs) == len(model.branches[0]) * len(model.branches[1])
    assert len({pair.branches for pair in found.pairs}) == len(found.pairs)
    assert found.winner == (0, 0)
    most = max(pair.rounds for pair in found.pairs)
    assert found.pairs[0].rounds == most
    assert found.pairs[0].hypervolume == max(p.hypervolume for p in found.pairs) > 0.4
    assert found.evaluations == sum(pair.evaluations for pair in found.pairs)
    others = [pair.hypervolume for pair in found.pairs[1:] if pair.rounds]
    lead = f"{found.pairs[0].hypervolume - max(others):.4f} more"
    assert (lead in str(found)) == (max(others) > 0.0)


def test_halving_gives_the_better_half_more(found: BranchCompetition) -> None:
    tried = [pair for pair in found.pairs if pair.rounds]
    rounds = [pair.rounds for pair in tried]
    assert rounds == sorted(rounds, reverse=True)
    for number in range(1, max(rounds)):
        reached = sum(r > number for r in rounds)
        assert reached == -(-sum(r >= number for r in rounds) // 2)


def test_pairs_that_hold_nothing_get_nothing(cell: Cell, found: BranchCompetition) -> None:
    x = np.vstack([cell.initial, cell.random(32, np.random.default_rng(1))])
    model = cell.compiled.model
    for pair in found.pairs:
        first, second = pair.branches
        start = (model.branches[0][first].q, model.branches[1][second].q)
        outputs = cell.evaluator.beginning_at(*start).evaluate(x)
        holds = np.all(outputs.violation[:, :6] <= 0.0, axis=1).any()
        assert holds == (pair.rounds > 0)


def test_a_robot_with_a_number_keeps_it() -> None:
    cell = Cell(replace(load(RACK), start_branch=(SEARCHED_BRANCH, 2)))
    told: list[tuple[int, int]] = []
    found = search_branches(
        cell,
        evaluations=50,
        rng=np.random.default_rng(1),
        progress=lambda done, total: told.append((done, total)),
    )
    assert {pair.branches[1] for pair in found.pairs} == {2}
    assert [done for done, _ in told] == list(range(1, told[-1][1] + 1))


def test_starting_at_the_own_branches_gives_the_same_bits(cell: Cell) -> None:
    x = cell.random(400, np.random.default_rng(5))
    again = cell.evaluator.beginning_at(*cell.compiled.model.start).evaluate(x)
    np.testing.assert_array_equal(again.penalised, cell.evaluate(x).penalised)
    rows = front_rows(again.objectives, again.feasible)
    assert hypervolume(again.objectives[rows]) > 0.0


def test_one_objective_has_no_hypervolume_to_compete_by() -> None:
    with refused(SettingsError, "objectives"):
        search_branches(Cell(load(RACK), ("peak_force",)), rng=np.random.default_rng(0))


def test_drivable_carries_choose_branches_under_the_ramped_law() -> None:
    # As a drivable experiment of the transfer cell, whose own law is 'ramped'.
    workcell = load(TRANSFER)
    task = replace(workcell.task, time_law="optimal")
    cell = Cell(
        replace(workcell, task=task, start_branch=(SEARCHED_BRANCH, -1)), DRIVABLE_OBJECTIVES
    )
    found = search_branches(cell, evaluations=50, rng=np.random.default_rng(1))
    assert found.law == "ramped"
    ramped = Cell(replace(workcell, start_branch=(SEARCHED_BRANCH, -1)))
    assert found == search_branches(ramped, evaluations=50, rng=np.random.default_rng(1))
    assert found.pairs[0].hypervolume > 0.0


def test_a_decision_is_kept_and_travels_with_the_cell(
    tmp_path: Path, found: BranchCompetition
) -> None:
    text = RACK.read_text().replace("../robots", str(RACK.parent.parent / "robots"))
    searched = 'min_manipulability = 0.03\nstart_branch = "search"'
    path = tmp_path / "cell.toml"
    path.write_text(text.replace("min_manipulability = 0.03", searched))
    root = tmp_path / "results"
    root.mkdir()
    assert str(found).casefold() in store_branches(root, found).casefold()
    execution = ExecutionSettings(output=root, resume=True)
    decided, competition = decided_cell(load(path), CampaignSettings(), execution)
    assert competition == found == read_branches(root)
    assert read_branches(tmp_path) is None
    assert decided.start_branch == found.winner
    assert decided.digest != load(path).digest
    unpacked = unpack_cell(collect_cell(decided), tmp_path / "unpacked")
    assert unpacked.start_branch == found.winner
    assert unpack_cell(collect_cell(load(path)), tmp_path / "open").start_branch == (-2, -2)
