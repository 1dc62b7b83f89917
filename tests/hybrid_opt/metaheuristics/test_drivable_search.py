"""Small drivable searches of cells that ship, here and in a worker."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.campaign.journal import ReplicaRequest, decode
from hybrid_opt.campaign.search_stage import run_replica
from hybrid_opt.campaign.settings import EVALUATIONS as FILE
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.campaign.stages import with_cell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.work.service import LocalExecutor, Service, answer_all
from symbolic.read.cell_files import collect_cell
from tests.symbolic.read.samples import RACK

QUICK = ("fork", "rack")
"""Cells that other tests compile as well; the rest takes minutes."""

CELLS = [
    pytest.param(path, marks=() if path.stem in QUICK else pytest.mark.slow, id=path.stem)
    for path in sorted(RACK.parent.glob("*.toml"))
]
EVALUATIONS = 6


@pytest.mark.parametrize("path", CELLS)
def test_every_cell_that_ships_is_searched(path: Path) -> None:
    cell = ho.Cell.load(path).drivable()
    rng = np.random.default_rng(1)
    front = ho.search(cell, "nsga2", evaluations=EVALUATIONS, rng=rng)
    found = front.evaluations
    assert found is not None
    assert len(found.x) == EVALUATIONS
    np.testing.assert_array_equal(found.x[0], cell.initial)
    assert found.feasible[0]
    duration, force = found.objectives[0]
    assert 0.0 < duration < np.inf
    limit = cell.initial[-1] / cell.workcell.task.reference_force.max()
    assert 0.0 < force <= limit * (1.0 + 1e-3)


def test_a_worker_elsewhere_searches_without_the_cells_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the joint allocation paths are timed one by one, which reads the robots' files."""
    cell = ho.Cell.load(RACK.with_name("fork.toml")).drivable()
    evaluator = partial(CandidateEvaluator, objectives=DRIVABLE_OBJECTIVES)
    source = partial(with_cell, evaluator, collect_cell(cell.workcell))
    settings = CampaignSettings({"random": {}}, EVALUATIONS, 1, objectives=DRIVABLE_OBJECTIVES)
    request = ReplicaRequest(settings, "random", 0, cell.initial[None])
    monkeypatch.chdir(tmp_path)
    ((files, _),) = answer_all(
        LocalExecutor(1, apart=True), Service(source, run_replica), [request]
    )
    found = decode(files[FILE], tmp_path).evaluations
    assert len(found.x) == EVALUATIONS
    expected = cell.evaluate(found.x)
    np.testing.assert_array_equal(found.objectives, expected.objectives)
    assert np.isfinite(found.objectives).all()
