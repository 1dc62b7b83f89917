"""The polish as a stage: what it stores, that it gains, and that an interruption loses nothing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.campaign import (
    CampaignSettings,
    ExecutionSettings,
    open_folder,
    run_stages,
    search_stage,
)
from hybrid_opt.campaign import polish_stage as stage
from hybrid_opt.campaign.polish_stage import PolishRequest, polish_front, polish_stage
from hybrid_opt.campaign.results import read_campaign, read_polished
from hybrid_opt.campaign.settings import polished_file
from hybrid_opt.errors import DamagedResultsWarning, ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.front import PolishedFront, PolishOutcome
from hybrid_opt.polishing.settings import FillSettings, PolishSettings, ProbeSettings
from hybrid_opt.polishing.solvers.base import Residuals
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import from_json, to_json
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell
from tests.refusals import refused
from tests.symbolic.cells import RACK

SETTINGS = CampaignSettings(algorithms={"nsga2": {}}, evaluations=200, replicas=1, seed=5)
PROBE = ProbeSettings(starts=2, middle_starts=2, rounds=2)
FILL = FillSettings(solved=8, members=16, attempts=1)
POLISHED = PolishSettings(attempts=2, rounds=3, fill=FILL, probe=PROBE)
SILENT = Progress(shown=False)


def run(root: Path, resume: bool = False, polish: PolishSettings = POLISHED) -> None:
    execution = ExecutionSettings(root, jobs=1, resume=resume)
    with open_folder(SETTINGS, execution, load(RACK)) as folder:
        run_stages(folder, (search_stage(), polish_stage(polish)), SILENT)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("polish") / "results"
    run(root)
    return root


def test_a_polished_front_is_feasible_certified_and_better(finished: Path) -> None:
    (front,) = read_campaign(finished).searched
    polished = read_polished(finished, front)
    assert polished is not None
    evaluator = CandidateEvaluator(load(RACK))
    again = evaluator.certified(evaluator.evaluate(polished.x))
    assert again.feasible.all()
    np.testing.assert_array_equal(again.objectives, polished.objectives)
    corner = metrics.REFERENCE_POINT
    before = metrics.hypervolume(front.objectives, corner)
    assert metrics.hypervolume(polished.objectives, corner) > before
    assert polished.polished.any()
    # Probes of one end and of the middle, the better of two of which goes on.
    probes = 2 * (2 + 1)
    # A front that stays short is filled twice; the end and the middle are finished.
    most = POLISHED.attempts * (1 + 2 * POLISHED.fill.attempts) + 2 + probes
    assert POLISHED.attempts + probes < polished.effort.attempts <= most
    assert 0.0 < polished.effort.widest_gap < 1.0
    assert polished.effort.equivalent_evaluations > 0


def test_a_polish_is_given_the_paths_that_are_known_beside(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    paths, seen = tuple(np.arange(36.0).reshape(2, 18)), list[Any]()

    def polish(front: object, **options: Any) -> None:
        seen.append(options["paths"])
        raise KeyboardInterrupt

    monkeypatch.setattr(stage, "polish", polish)
    files, x = collect_cell(load(RACK)), np.empty((0, 18))
    request = PolishRequest(files, SETTINGS, POLISHED, "nsga2", 0, x, paths)
    with pytest.raises(KeyboardInterrupt):
        polish_front(request)
    assert seen == [paths]


def test_what_was_not_solved_counts_in_no_figure_of_solves() -> None:
    x, unknown = np.zeros(18), Residuals(np.nan, np.nan, np.nan)
    solved = PolishOutcome(
        "gap",
        -1,
        "accepted",
        "",
        x,
        np.ones(2),
        np.ones(2),
        Residuals(1e-5, 0.0, 0.0),
        1,
        1,
        0,
        2.0,
    )
    as_it_is = replace(solved, residuals=unknown, rounds=0, iterations=0, seconds=0.1)
    lost = replace(as_it_is, status="failed", reason="killed", seconds=4.0)
    front = PolishedFront(
        x[None],
        np.ones((1, 2)),
        np.array([-1]),
        np.array([True]),
        (solved, as_it_is, lost),
        1.0,
        1.0,
        "ipopt",
    )
    figures = front.effort
    assert figures.solver == "ipopt"
    assert figures.attempts == 2
    assert figures.median_attempt_seconds == 3.0
    assert figures.median_stationarity == figures.worst_stationarity == 1e-5


def test_attempts_come_back_from_their_file(finished: Path) -> None:
    document = json.loads(polished_file(finished, "nsga2", 0).read_text())
    for stored in document["outcomes"]:
        assert to_json(from_json(PolishOutcome, stored, "an attempt", "")) == stored


def test_a_damaged_front_is_polished_anew(finished: Path, tmp_path: Path) -> None:
    root = tmp_path / "results"
    shutil.copytree(finished, root)
    path = polished_file(root, "nsga2", 0)
    before = json.loads(path.read_text())
    path.write_text("{}")
    with pytest.warns(DamagedResultsWarning, match=r"00\.json: .* x: "):
        run(root, resume=True)
    after = json.loads(path.read_text())
    assert [after[key] for key in ("x", "objectives")] == [before["x"], before["objectives"]]


def test_a_study_is_not_continued_with_another_polish(finished: Path, tmp_path: Path) -> None:
    root = tmp_path / "results"
    shutil.copytree(finished, root)
    with refused(ResultsError, "another-stage-setting", "--overwrite"):
        run(root, resume=True, polish=replace(POLISHED, attempts=5))


DAMAGE: list[tuple[dict[str, Callable[[Any], Any]], str]] = [
    (
        dict.fromkeys(("x", "objectives", "parent", "polished"), lambda values: []),
        "at x: ",
    ),
    ({"x": lambda x: [point[:3] for point in x]}, "at x: found 3 numbers"),
    ({"x": lambda x: [x[0][:3], *x[1:]]}, "at x: "),
    ({"x": lambda x: x[1:]}, ": "),
    ({"x": lambda x: [[None, *x[0][1:]], *x[1:]]}, "at x: "),
    ({"x": lambda x: [[1e308, *x[0][1:]], *x[1:]]}, "at x: "),
    (
        {"objectives": lambda values: [["a", "b"], *values[1:]]},
        "at objectives: ",
    ),
    ({"parent": lambda rows: [0.5, *rows[1:]]}, "at parent: "),
]


@pytest.mark.parametrize(("damage", "told"), DAMAGE)
def test_a_damaged_file_is_told(
    finished: Path, tmp_path: Path, damage: dict[str, Callable[[Any], Any]], told: str
) -> None:
    (front,) = read_campaign(finished).searched
    assert read_polished(tmp_path, front) is None
    whole = json.loads(polished_file(finished, "nsga2", 0).read_text())
    spoilt = whole | {key: change(whole[key]) for key, change in damage.items()}
    path = polished_file(tmp_path, "nsga2", 0)
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(spoilt))
    with pytest.raises(ResultsError, match=rf"{told}.*--resume"):
        read_polished(tmp_path, front)
