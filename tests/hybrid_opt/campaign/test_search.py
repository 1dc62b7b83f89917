"""A campaign's results depend on its settings alone, and no interruption changes them."""

from __future__ import annotations

import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.campaign import CampaignSettings, ExecutionSettings, open_folder
from hybrid_opt.campaign.folder import replica_identity
from hybrid_opt.campaign.journal import Journal, ReplicaRequest, decode, encode_generation
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.campaign.search_stage import run_replica
from hybrid_opt.campaign.settings import EVALUATIONS
from hybrid_opt.campaign.stages import with_cell
from hybrid_opt.errors import DamagedResultsWarning, ResultsError, WorkerError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.progress import Progress
from hybrid_opt.work.service import LocalExecutor, Service, answer_all
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell
from tests.hybrid_opt.campaign.fake import (
    RACK,
    ROOT,
    FakeSource,
    files_of,
    logged,
    run_search,
    verdicts,
)
from tests.hybrid_opt.cells import drivable
from tests.waiting import HANGS, until

SETTINGS = CampaignSettings(evaluations=200, replicas=2)
FEW = CampaignSettings(evaluations=80, replicas=1)
PROGRAM = [sys.executable, "-m", "tests.hybrid_opt.campaign.fake"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return files_of(
        run_search(SETTINGS, ExecutionSettings(tmp_path_factory.mktemp("plain") / "a", jobs=1))
    )


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    root = run_search(FEW, ExecutionSettings(tmp_path_factory.mktemp("few") / "a", jobs=1))
    return root, files_of(root)


def start(output: Path, *options: str, limit: int | None = None) -> subprocess.Popen[str]:
    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.Popen(
        [*PROGRAM, str(output), *options],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limited,
        start_new_session=True,
    )


def has_seen(log: Path, size: int) -> bool:
    return log.exists() and log.stat().st_size >= size


def recorded_in(replica: Path) -> float:
    """Bytes in a replica's journal; infinitely many once it is finished."""
    journal = replica / "journal.bin"
    if (replica / "replica.json").exists():
        return math.inf
    return journal.stat().st_size if journal.exists() else 0.0


def test_results_hold_every_candidate_in_order(tmp_path: Path) -> None:
    log = tmp_path / "log"
    settings = replace(SETTINGS, algorithms={"mopso": {}}, replicas=1)
    root = run_search(settings, ExecutionSettings(tmp_path / "a", 1), FakeSource(log=str(log)))
    (replica,) = read_campaign(root).replicas
    expected = verdicts(logged(log))
    np.testing.assert_array_equal(replica.evaluations.x, expected.x)
    finite = np.isfinite(expected.objectives).all(axis=1)
    assert not finite.all()
    np.testing.assert_array_equal(replica.evaluations.feasible, expected.feasible & finite)
    np.testing.assert_array_equal(
        replica.evaluations.objectives[finite], expected.objectives[finite]
    )
    np.testing.assert_array_equal(replica.evaluations.violation[finite], expected.violation[finite])
    assert replica.generation.tolist() == sorted(replica.generation.tolist())
    assert np.bincount(replica.generation).tolist() == [0, 40, 40, 40, 40, 40]


def test_replicas_differ(undisturbed: dict[str, bytes]) -> None:
    assert len(undisturbed) == 8
    assert len(set(undisturbed.values())) == 8


def test_other_algorithms_and_replicas_do_not_matter(
    tmp_path: Path, undisturbed: dict[str, bytes]
) -> None:
    settings = replace(SETTINGS, algorithms={"random": {}, "mopso": {}}, replicas=1)
    found = files_of(run_search(settings, ExecutionSettings(tmp_path / "a", 1)))
    common = found.keys() & undisturbed.keys()
    assert len(common) == 2
    assert all(found[name] == undisturbed[name] for name in common)


def test_jobs_do_not_matter(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    assert files_of(run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 3))) == undisturbed


def test_seed_matters(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    found = files_of(run_search(replace(SETTINGS, seed=2), ExecutionSettings(tmp_path / "a", 1)))
    assert found.keys() == undisturbed.keys()
    assert not set(found.values()) & set(undisturbed.values())


@pytest.mark.parametrize("jobs", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_killed_at_any_moment_and_resumed(
    tmp_path: Path, jobs: str, undisturbed: dict[str, bytes]
) -> None:
    output, log = tmp_path / "a", tmp_path / "log"
    options = ["--jobs", jobs, "--delay", "0.05", "--log", str(log)]
    kept = 0.0
    for generations in (2, 9, 13):
        process = start(output, *options)
        seen = 40 * 4 * 8 * generations
        until(partial(has_seen, log, seen))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        recorded = sum(map(recorded_in, output.glob("replicas/*/*")))
        assert recorded >= kept
        kept = recorded
    process = start(output, *options)
    assert process.wait(120) == 0, process.communicate()[1]
    assert files_of(output) == undisturbed
    assert not list(output.glob("replicas/*/*/journal.bin"))
    evaluated = logged(log)
    distinct = np.unique(evaluated, axis=0)
    assert len(distinct) == 4 * 200
    # Only what was evaluated but not yet recorded at one of three kills may have been repeated:
    # at most one generation per worker.
    assert len(evaluated) - len(distinct) <= 3 * 40 * int(jobs)


def test_resume_of_a_complete_campaign_evaluates_nothing(tmp_path: Path) -> None:
    execution = ExecutionSettings(tmp_path / "a", 1)
    settings = replace(SETTINGS, evaluations=80, replicas=1)
    before = files_of(run_search(settings, execution))
    log = tmp_path / "log"
    run_search(settings, replace(execution, resume=True), FakeSource(log=str(log)))
    assert not log.exists()
    assert files_of(execution.output) == before


MARK = "replica.json"
DAMAGED_MARKS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no object": lambda mark: [],
    "infinite": lambda mark: mark | {"seconds": float("inf")},
    "checksums of others": lambda mark: mark | {"sha256": {"/dev/zero": "0" * 64}},
}


@pytest.mark.parametrize("damage", ["candidates", "pipe", "bytes", *DAMAGED_MARKS])
def test_damaged_results_are_made_again(
    tmp_path: Path, few: tuple[Path, dict[str, bytes]], damage: str
) -> None:
    whole, before = few
    output = tmp_path / "a"
    shutil.copytree(whole, output)
    folder = output / "replicas/mopso/00"
    candidates = folder / "evaluations.csv.gz"
    if damage == "candidates":
        content = bytearray(candidates.read_bytes())
        content[len(content) // 2] ^= 1
        candidates.write_bytes(content)
    elif damage == "pipe":
        candidates.unlink()
        os.mkfifo(candidates)
    elif damage == "bytes":
        (folder / MARK).write_bytes(b"\xff{")
    else:
        mark = DAMAGED_MARKS[damage](json.loads((folder / MARK).read_bytes()))
        (folder / MARK).write_text(json.dumps(mark))
    with pytest.raises(ResultsError) as caught:
        read_campaign(output)
    assert "/replicas/mopso/00/" in str(caught.value)
    execution = ExecutionSettings(output, 1, resume=True)
    with pytest.warns(DamagedResultsWarning, match=r"replicas/mopso/00/.*--resume computes it"):
        again = run_search(FEW, execution)
    assert files_of(again) == before
    assert read_campaign(output).replicas


def test_a_journal_of_nonsense_is_told(tmp_path: Path, few: tuple[Path, dict[str, bytes]]) -> None:
    whole, before = few
    output = tmp_path / "a"
    shutil.copytree(whole, output)
    folder = output / "replicas/mopso/00"
    (folder / MARK).unlink()
    (output / "stages/search.json").unlink()
    found = read_campaign(whole).of("mopso")[0].evaluations
    stored = json.loads((output / "configuration.json").read_bytes())
    head = replica_identity({"campaign": stored}, "mopso", 0)
    for block in (b"\0" * 12, encode_generation(float("nan"), found)):
        journal = Journal(folder / "journal.bin", head)
        journal.append(block)
        journal.close()
        with pytest.raises(ResultsError, match=r"mopso replica 0: .* delete the replica's folder"):
            run_search(FEW, ExecutionSettings(output, 1, resume=True))
        (folder / "journal.bin").unlink()
    shutil.rmtree(folder)
    assert files_of(run_search(FEW, ExecutionSettings(output, 1, resume=True))) == before


@pytest.mark.slow
def test_a_killed_worker_is_replaced(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    log, marker = tmp_path / "log", tmp_path / "dead"
    source = FakeSource(log=str(log), dies_once=str(marker))
    root = run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 2), source)
    assert marker.exists()
    assert files_of(root) == undisturbed


@pytest.mark.slow
def test_workers_that_keep_dying_end_the_campaign(tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match=r"died 3 times over one task .* --resume"):
        run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 2), FakeSource(always_dies=True))


def test_full_disk_loses_nothing(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    output = tmp_path / "a"
    # Large enough for the workcell's copy, too small for a journal of 200 candidates.
    process = start(output, limit=40_000)
    message = process.communicate(timeout=HANGS)[1]
    assert process.returncode == 2
    assert message.count("\n") == 1
    assert "no space left to write" in message
    assert "--resume" in message
    assert list(output.glob("replicas/*/*/journal.bin"))
    process = start(output)
    assert process.wait(60) == 0
    assert files_of(output) == undisturbed


def test_a_folder_serves_one_process(tmp_path: Path) -> None:
    log = tmp_path / "log"
    process = start(tmp_path / "a", "--delay", "0.1", "--log", str(log))
    until(log.exists)
    with pytest.raises(ResultsError, match=rf"in use by another process \(id {process.pid}\)"):
        run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 1, resume=True))
    process.kill()
    process.communicate()
    run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 1, resume=True))


def test_unfinished_results_are_told(tmp_path: Path) -> None:
    with open_folder(SETTINGS, ExecutionSettings(tmp_path, 1), load(RACK)):
        pass
    with pytest.raises(ResultsError, match="nsga2 replica 0 is not finished"):
        read_campaign(tmp_path)
    with pytest.raises(ResultsError, match="is no results folder"):
        read_campaign(tmp_path / "replicas")


def test_nothing_is_shown_when_not_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    for shown in (False, True):
        with Progress(shown).stage("search", 3, "evaluations", 1) as advance:
            advance(2)
        assert ("search: 3 of 3 evaluations" in capsys.readouterr().err) is shown


# --- drivable searches of cells that ship, here and in a worker ---


QUICK = ("fork", "rack")
"""Cells that other tests compile as well; the rest takes minutes."""

CELLS = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
    for name in sorted(path.stem for path in RACK.parent.glob("*.toml"))
]
CANDIDATES = 6


@pytest.mark.parametrize("name", CELLS)
def test_every_cell_that_ships_is_searched(name: str) -> None:
    cell = drivable(name)
    rng = np.random.default_rng(1)
    front = ho.search(cell, "nsga2", evaluations=CANDIDATES, rng=rng)
    found = front.evaluations
    assert found is not None
    assert len(found.x) == CANDIDATES
    np.testing.assert_array_equal(found.x[0], cell.initial)
    assert found.feasible[0]
    duration, force = found.objectives[0]
    assert 0.0 < duration < np.inf
    limit = cell.initial[-1] / cell.workcell.task.reference_force.max()
    assert 0.0 < force <= limit * (1.0 + 1e-3)


def test_a_worker_elsewhere_searches_without_the_cells_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a cell without a closed form."""
    cell = drivable("fork")
    evaluator = partial(CandidateEvaluator, objectives=DRIVABLE_OBJECTIVES)
    source = partial(with_cell, evaluator, collect_cell(cell.workcell))
    settings = CampaignSettings({"random": {}}, CANDIDATES, 1, objectives=DRIVABLE_OBJECTIVES)
    request = ReplicaRequest(settings, "random", 0, cell.initial[None])
    monkeypatch.chdir(tmp_path)
    ((files, _),) = answer_all(
        LocalExecutor(1, apart=True), Service(source, run_replica), [request]
    )
    found = decode(files[EVALUATIONS], tmp_path).evaluations
    assert len(found.x) == CANDIDATES
    expected = cell.evaluate(found.x)
    np.testing.assert_array_equal(found.objectives, expected.objectives)
    assert np.isfinite(found.objectives).all()
