"""The polish as a stage: what it stores, that it gains, and that an interruption loses nothing."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.campaign import (
    CampaignSettings,
    ExecutionSettings,
    Stage,
    open_folder,
    run_stages,
    search_stage,
)
from hybrid_opt.campaign.journal import Journal, ReplicaRequest
from hybrid_opt.campaign.polish_stage import PolishLedger, polish_replica, polish_stage
from hybrid_opt.campaign.results import read_campaign, read_polished
from hybrid_opt.campaign.settings import JOURNAL, POLISH, polished_folder
from hybrid_opt.errors import DamagedResultsWarning, ResultsError, WorkerError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.polisher import Polisher
from hybrid_opt.polishing.records import PolishedFront, PolishOutcome
from hybrid_opt.polishing.settings import FillSettings, PolishSettings, ProbeSettings
from hybrid_opt.polishing.solvers.base import Residuals
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import from_json, to_json
from symbolic.array import Array
from symbolic.read.cell import load
from tests.symbolic.cells import RACK

SETTINGS = CampaignSettings(algorithms={"nsga2": {}}, evaluations=200, replicas=1, seed=5)
PROBE = ProbeSettings(starts=2, middle_starts=2)
POLISHED = PolishSettings(attempts=2, fill=FillSettings(attempts=1), probe=PROBE)
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
    polished = read_polished(finished, replica, load(RACK))
    assert polished is not None
    evaluator = CandidateEvaluator(load(RACK))
    again = evaluator.certified(evaluator.evaluate(polished.x))
    assert again.feasible.all()
    np.testing.assert_array_equal(again.objectives, polished.objectives)
    corner = metrics.REFERENCE_POINT
    before = metrics.hypervolume(replica.front, corner)
    assert metrics.hypervolume(polished.objectives, corner) > before
    assert polished.polished.any()
    # Probes of one end and of the middle, the better of two of which goes on.
    probes = 2 * (2 + 1)
    # A front that stays short is filled twice; the end and the middle are finished.
    most = POLISHED.attempts * (1 + 2 * POLISHED.fill.attempts) + 2 + probes
    assert POLISHED.attempts + probes < polished.effort.attempts <= most
    assert 0.0 < polished.effort.widest_gap < 1.0
    assert polished.effort.equivalent_evaluations > 0
    assert not (polished_folder(finished, "nsga2", 0) / JOURNAL).exists()


def test_a_lost_solve_costs_one_attempt_however_many_were_made(
    finished: Path, tmp_path: Path
) -> None:
    shutil.copytree(finished, tmp_path / "again")
    (polished_folder(tmp_path / "again", "nsga2", 0) / POLISH).unlink()
    execution = ExecutionSettings(tmp_path / "again", jobs=1, resume=True)
    with open_folder(SETTINGS, execution, load(RACK)) as folder:
        ledger = PolishLedger(folder, POLISHED, None)
        for _ in range(2 * POLISHED.attempts):
            ledger.heard(0, b"an attempt")
        for _ in range(POLISHED.attempts - 1):
            ledger.lost(0, "crashed")
        with pytest.raises(WorkerError, match="given up"):
            ledger.lost(0, "crashed")
        ledger.close()


def test_a_polisher_is_given_the_paths_that_are_known_beside(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    paths, seen = np.arange(36.0).reshape(2, 18), list[Any]()

    def polish(self: Polisher, front_x: Array, *_: object, **options: Any) -> PolishedFront:
        seen.append(options["paths"])
        raise KeyboardInterrupt

    monkeypatch.setattr(Polisher, "polish", polish)
    request = ReplicaRequest(SETTINGS, "nsga2", 0, np.empty((0, 18)), (), paths)
    with pytest.raises(KeyboardInterrupt):
        polish_replica(object.__new__(Polisher), request, lambda block: None)
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
    document = json.loads((polished_folder(finished, "nsga2", 0) / POLISH).read_text())
    for stored in document["outcomes"]:
        assert to_json(from_json(PolishOutcome, stored, "an attempt", "")) == stored
    with pytest.raises(ResultsError, match="damaged"):
        from_json(PolishOutcome, {"aim": "point"}, "an attempt", "")


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
    (replica,) = read_campaign(root).replicas
    one, other = (read_polished(folder, replica, load(RACK)) for folder in (finished, root))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.x, other.x)
    np.testing.assert_array_equal(one.objectives, other.objectives)


def test_a_damaged_front_is_polished_anew(finished: Path, tmp_path: Path) -> None:
    root = tmp_path / "results"
    shutil.copytree(finished, root)
    path = polished_folder(root, "nsga2", 0) / POLISH
    before = json.loads(path.read_text())
    path.write_text("{}")
    with pytest.warns(DamagedResultsWarning, match=r"polish.json: damaged at x: is missing"):
        run(root, resume=True)
    after = json.loads(path.read_text())
    assert [after[key] for key in ("x", "objectives")] == [before["x"], before["objectives"]]


def test_a_recorded_attempt_of_nonsense_is_told() -> None:
    request = ReplicaRequest(SETTINGS, "nsga2", 0, np.zeros((1, 18)), (b"[]",))
    for block in (b"[]", b"{}", b"\xff", b'{"x": 1e999}', b"[" * 90):
        with pytest.raises(ResultsError, match=r"nsga2 replica 0: .*; delete journal.bin in its"):
            polish_replica(Repeating(), replace(request, recorded=(block,)), lambda message: None)


class Repeating(Polisher):
    """A polisher that only reads what was recorded."""

    def __init__(self) -> None: ...

    def polish(self, *arguments: object, **recorded: object) -> PolishedFront:
        raise AssertionError


def test_other_settings_are_refused(finished: Path) -> None:
    execution = ExecutionSettings(finished, jobs=1, resume=True)
    other: Stage = polish_stage(PolishSettings(attempts=5))
    with (
        open_folder(SETTINGS, execution, load(RACK)) as folder,
        pytest.raises(ResultsError, match="polish"),
    ):
        run_stages(folder, (search_stage(), other), SILENT)


def spoilt(document: Any, fault: str) -> Any:
    x = document["x"]
    if fault == "no point":
        document |= {key: [] for key in ("x", "objectives", "parent", "polished")}
    elif fault == "too short":
        document["x"] = [point[:3] for point in x]
    elif fault == "ragged":
        x[0] = x[0][:3]
    elif fault == "fewer":
        document["x"] = x[1:]
    elif fault == "missing":
        x[0][1] = None
    elif fault == "huge":
        x[0][1] = 1e308
    elif fault == "objectives":
        document["objectives"][0] = ["a", "b"]
    elif fault == "whole":
        document["parent"][0] = 0.5
    else:
        document = {"x": []}
    return document


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("no point", "at x: found 0 points"),
        ("too short", "at x: found 3 numbers; allowed are 18"),
        ("ragged", "at x: no numbers of shape any x any"),
        ("fewer", ": its arrays have different lengths"),
        ("missing", "at x: holds numbers that are missing"),
        ("huge", "at x: is outside"),
        ("objectives", "at objectives: no numbers of shape any x 2"),
        ("whole", "at parent: holds numbers that are not whole"),
        ("nothing", "at objectives: is missing"),
    ],
)
def test_a_damaged_file_is_told(finished: Path, tmp_path: Path, fault: str, told: str) -> None:
    (replica,) = read_campaign(finished).replicas
    assert read_polished(tmp_path, replica, load(RACK)) is None
    whole = json.loads((polished_folder(finished, "nsga2", 0) / POLISH).read_text())
    path = polished_folder(tmp_path, "nsga2", 0) / POLISH
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(spoilt(whole, fault)))
    with pytest.raises(ResultsError, match=rf"damaged ?{told}.*; --resume computes it anew"):
        read_polished(tmp_path, replica, load(RACK))
