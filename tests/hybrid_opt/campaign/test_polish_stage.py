"""The polish as a stage: what it stores, that it gains, and that an interruption loses nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign import (
    CampaignSettings,
    ExecutionSettings,
    Progress,
    Stage,
    open_folder,
    run_stages,
    search_stage,
)
from hybrid_opt.campaign.journal import Journal
from hybrid_opt.campaign.layout import JOURNAL, POLISH, polished_folder
from hybrid_opt.campaign.polish_stage import polish_stage, read_polished
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.records import PolishSettings, outcome_from_json, outcome_to_json
from symbolic.workcell.file import load
from tests.symbolic.workcell.samples import RACK

SETTINGS = CampaignSettings(algorithms=("nsga2",), evaluations=200, replicas=1, seed=5)
POLISHED = PolishSettings(points=4)
SILENT = Progress(shown=False)


def run(root: Path, resume: bool = False) -> None:
    execution = ExecutionSettings(root, jobs=1, resume=resume)
    with open_folder(SETTINGS, execution, load(RACK)) as folder:
        run_stages(folder, (search_stage(), polish_stage(POLISHED)), SILENT)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("polish") / "results"
    run(root)
    return root


def test_a_polished_front_is_feasible_certified_and_better(finished: Path) -> None:
    (replica,) = read_campaign(finished).replicas
    polished = read_polished(finished, "nsga2", 0)
    assert polished is not None
    evaluator = CandidateEvaluator(load(RACK))
    again = evaluator.certified(evaluator.evaluate(polished.x))
    assert again.feasible.all()
    np.testing.assert_array_equal(again.objectives, polished.objectives)
    corner = metrics.REFERENCE_POINT
    before = metrics.hypervolume(replica.front, corner)
    assert metrics.hypervolume(polished.objectives, corner) > before
    assert polished.polished.any()
    assert polished.figures["attempts"] <= POLISHED.points
    assert polished.figures["equivalent_evaluations"] > 0
    assert not (polished_folder(finished, "nsga2", 0) / JOURNAL).exists()


def test_attempts_come_back_from_their_file(finished: Path) -> None:
    document = json.loads((polished_folder(finished, "nsga2", 0) / POLISH).read_text())
    for stored in document["attempts"]:
        assert outcome_to_json(outcome_from_json(stored)) == stored
    with pytest.raises(ResultsError, match="damaged"):
        outcome_from_json({"aim": "point"})


def test_an_interrupted_polish_repeats_no_attempt(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "results"
    append = Journal.append
    recorded = []

    def interrupt(journal: Journal, payload: bytes) -> None:
        append(journal, payload)
        if journal.path.parent == polished_folder(root, "nsga2", 0):
            recorded.append(payload)
            if len(recorded) == 2:
                raise KeyboardInterrupt

    monkeypatch.setattr(Journal, "append", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(root)
    interrupted = list(recorded)
    run(root, resume=True)
    repeated = [block for block in recorded[2:] if block in interrupted]
    assert not repeated
    one, other = (read_polished(folder, "nsga2", 0) for folder in (finished, root))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.x, other.x)
    np.testing.assert_array_equal(one.objectives, other.objectives)


def test_other_settings_are_refused(finished: Path) -> None:
    execution = ExecutionSettings(finished, jobs=1, resume=True)
    other: Stage = polish_stage(PolishSettings(points=5))
    with (
        open_folder(SETTINGS, execution, load(RACK)) as folder,
        pytest.raises(ResultsError, match="polish"),
    ):
        run_stages(folder, (search_stage(), other), SILENT)


def test_a_damaged_file_is_told(finished: Path, tmp_path: Path) -> None:
    assert read_polished(tmp_path, "nsga2", 0) is None
    path = polished_folder(tmp_path, "nsga2", 0) / POLISH
    path.parent.mkdir(parents=True)
    path.write_text('{"front": [{}], "figures": {}}')
    with pytest.raises(ResultsError, match="delete it to polish again"):
        read_polished(tmp_path, "nsga2", 0)
