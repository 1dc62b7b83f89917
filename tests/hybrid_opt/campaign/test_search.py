"""A campaign's results depend on its settings alone, and no interruption changes them."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.campaign import CampaignSettings, ExecutionSettings, open_folder
from hybrid_opt.campaign.candidates import decode, encode
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.campaign.search_stage import SearchRequest, search_replica
from hybrid_opt.errors import DamagedResultsWarning, ResultsError, WorkerError
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.progress import Progress
from hybrid_opt.workers import LocalWorkers
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
from tests.refusals import refused
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


def test_replicas_differ(undisturbed: dict[str, bytes]) -> None:
    assert len(undisturbed) == 4
    assert len(set(undisturbed.values())) == 4


def test_other_algorithms_and_replicas_do_not_matter(
    tmp_path: Path, undisturbed: dict[str, bytes]
) -> None:
    settings = replace(SETTINGS, algorithms={"random": {}, "mopso": {}}, replicas=1)
    found = files_of(run_search(settings, ExecutionSettings(tmp_path / "a", 1)))
    common = found.keys() & undisturbed.keys()
    assert len(common) == 1
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
    kept: dict[str, bytes] = {}
    for generations in (2, 9, 16):
        process = start(output, *options)
        seen = 40 * 4 * 8 * generations
        until(partial(has_seen, log, seen))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        found = files_of(output)
        assert kept.items() <= found.items() <= undisturbed.items()
        kept = found
    process = start(output, *options)
    assert process.wait(120) == 0, process.communicate()[1]
    assert files_of(output) == undisturbed
    evaluated = logged(log)
    distinct = np.unique(evaluated, axis=0)
    assert len(distinct) == 4 * 200
    # What was finished is not repeated: at most one replica per worker and kill.
    assert len(evaluated) - len(distinct) <= 3 * 200 * int(jobs)


def test_resume_of_a_complete_campaign_evaluates_nothing(tmp_path: Path) -> None:
    execution = ExecutionSettings(tmp_path / "a", 1)
    settings = replace(SETTINGS, evaluations=80, replicas=1)
    before = files_of(run_search(settings, execution))
    log = tmp_path / "log"
    run_search(settings, replace(execution, resume=True), FakeSource(log=str(log)))
    assert not log.exists()
    assert files_of(execution.output) == before


@pytest.mark.parametrize("damage", ["flipped bit", "pipe", "cut", "another's"])
def test_damaged_results_are_made_again(
    tmp_path: Path, few: tuple[Path, dict[str, bytes]], damage: str
) -> None:
    whole, before = few
    output = tmp_path / "a"
    shutil.copytree(whole, output)
    path = output / "replicas/mopso/00.csv.gz"
    content = bytearray(path.read_bytes())
    if damage == "flipped bit":
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    elif damage == "pipe":
        path.unlink()
        os.mkfifo(path)
    elif damage == "cut":
        path.write_bytes(content[:-100])
    else:
        found = decode(bytes(content), path)
        path.write_bytes(encode(replace(found, objective_names=("duration", "peak_force"))))
    with pytest.raises(ResultsError) as caught:
        read_campaign(output)
    assert "/replicas/mopso/00.csv.gz" in str(caught.value)
    execution = ExecutionSettings(output, 1, resume=True)
    with pytest.warns(DamagedResultsWarning, match=r"replicas/mopso/00.*--resume"):
        again = run_search(FEW, execution)
    assert files_of(again) == before
    assert read_campaign(output).replicas


@pytest.mark.slow
def test_a_killed_worker_is_replaced(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    log, marker = tmp_path / "log", tmp_path / "dead"
    source = FakeSource(log=str(log), dies_once=str(marker))
    root = run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 2), source)
    assert marker.exists()
    assert files_of(root) == undisturbed


@pytest.mark.slow
def test_workers_that_keep_dying_end_the_campaign(tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match=r" 3 .* --resume"):
        run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 2), FakeSource(always_dies=True))


def test_full_disk_loses_nothing(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    output = tmp_path / "a"
    # Large enough for the workcell's copy, too small for 200 candidates.
    process = start(output, limit=12_000)
    message = process.communicate(timeout=HANGS)[1]
    assert process.returncode == 2
    assert message.count("\n") == 1
    assert "--resume" in message
    process = start(output)
    assert process.wait(60) == 0
    assert files_of(output) == undisturbed


def test_a_folder_serves_one_process(tmp_path: Path) -> None:
    log = tmp_path / "log"
    process = start(tmp_path / "a", "--delay", "0.1", "--log", str(log))
    until(log.exists)
    with pytest.raises(ResultsError, match=str(process.pid)):
        run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 1, resume=True))
    process.kill()
    process.communicate()
    run_search(SETTINGS, ExecutionSettings(tmp_path / "a", 1, resume=True))


def test_unfinished_results_are_told(tmp_path: Path) -> None:
    with open_folder(SETTINGS, ExecutionSettings(tmp_path, 1), load(RACK)):
        pass
    with pytest.raises(ResultsError, match=r"nsga2 .*0"):
        read_campaign(tmp_path)
    with refused(ResultsError, "no-results-folder"):
        read_campaign(tmp_path / "replicas")


def test_nothing_is_shown_when_not_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    for shown in (False, True):
        with Progress(shown).stage("search", 3, "evaluations", 1) as advance:
            advance(2)
        assert ("search: 3 of 3 evaluations" in capsys.readouterr().err) is shown


# --- drivable searches of cells that ship, here and in a worker ---


QUICK = ("rack",)
"""The cell that most tests compile as well; the rest takes minutes."""

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
    settings = CampaignSettings({"random": {}}, CANDIDATES, 2, objectives=DRIVABLE_OBJECTIVES)
    files = collect_cell(cell.workcell)
    requests = [SearchRequest(files, settings, "random", replica) for replica in range(2)]
    monkeypatch.chdir(tmp_path)
    with LocalWorkers(2) as workers:
        contents = workers.map(search_replica, requests)
    found = decode(contents[0], tmp_path).evaluations
    assert len(found.x) == CANDIDATES
    expected = cell.evaluate(found.x)
    np.testing.assert_array_equal(found.objectives, expected.objectives)
    assert np.isfinite(found.objectives).all()
