"""How a study begins: what is refused before work, what is told, Ctrl-C while it compiles; and a
recommendation alone."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign import ExecutionSettings, Stage, open_folder, run_stages
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.evaluate.evaluation import REASONS, CandidateEvaluator
from hybrid_opt.progress import Progress
from studies import recommend, run
from studies.programs.study import campaign_settings
from studies.report import __main__ as report
from studies.study.recommendation import StoredRecommendation, read_recommendation
from symbolic.read.cell import load
from tests.hybrid_opt.campaign.fake import RACK, ROOT
from tests.hybrid_opt.cells import shipped
from tests.studies.conftest import SMALL
from tests.studies.study.test_run import CELL
from tests.waiting import HANGS, soon, until


def test_interrupt_while_compiling_ends_at_once(tmp_path: Path) -> None:
    root, cache = tmp_path / "a", tmp_path / "cache"
    command = [sys.executable, "-m", "studies.run", CELL, "--output", str(root), "--quick"]
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env=os.environ | {"DUAL_ARM_CACHE": str(cache)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until(lambda: any(cache.glob("build-*/*.c")), process)
    with soon(25.0):  # some seconds of them before Ctrl-C; all compilers take 60 s
        os.killpg(process.pid, signal.SIGINT)
        message = process.communicate(timeout=HANGS)[1]
    assert process.returncode == 130
    (said,) = [line for line in message.splitlines() if line and "compiling:" not in line]
    assert said.startswith("interrupted, nothing is lost; continue with: python -m studies.run ")


def test_what_is_refused_is_refused_before_anything_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = tmp_path / "cells" / "cell.toml"
    cell.parent.mkdir()
    shutil.copytree(ROOT / "studies" / "robots", tmp_path / "robots")
    shutil.copy(CELL, cell)
    root = tmp_path / "results"
    asked = [str(cell), "--output", str(root), *SMALL, "--quiet"]
    settings = campaign_settings(run.main.parser().parse_args([str(cell), *SMALL]))
    execution = ExecutionSettings(root)
    with open_folder(settings, execution, load(cell)) as folder:
        polished = Stage("polish", lambda folder, progress: None, {"attempts": 1})
        run_stages(folder, [polished], Progress(shown=False))

    def begin(*given: object, **more: object) -> None:
        raise AssertionError("compiles")

    monkeypatch.setattr("studies.programs.study.build_study", begin)
    assert run.main(asked) == 2
    assert "continue it with --resume, or choose another --output" in capsys.readouterr().err
    assert run.main([*asked[:-2], "--polish", "--resume"]) == 2
    assert "the stage 'polish' was run with {'attempts': 1}" in capsys.readouterr().err
    cell.write_text(cell.read_text().replace("friction = 0.8", "friction = 0.75"))
    assert run.main([*asked, "--resume"]) == 2
    told = capsys.readouterr().err
    assert "holds results of another workcell" in told
    assert "--overwrite" in told
    with pytest.raises(AssertionError, match="compiles"):
        run.main([*asked, "--overwrite"])
    assert not (root / "stages" / "polish.json").exists()


def test_a_recommendation_alone_makes_nothing_else(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "a"
    asked = [CELL, "--output", str(root), "--recommend-only", "--jobs", "1"]
    asked += ["--evaluations", "120", "--no-polish", "--force-limit", "116"]
    assert run.main(asked) == 0
    said = capfd.readouterr()
    assert said.out.startswith("Run this carry: ")
    assert "Report:" not in said.out
    assert re.search(r"recommendation: \d+ of \d+ steps \[", said.err)
    found = read_recommendation(root)
    assert isinstance(found, StoredRecommendation)
    assert found.force <= 116.0 * (1.0 + 2e-3)
    results = read_campaign(root)
    assert results.workcell.task.time_law == "optimal"
    assert [(one.algorithm, one.replica) for one in results.replicas] == [("nsga2", 0)]
    left = {path.name for path in root.iterdir()}
    assert left.isdisjoint({"report.html", "figures", "tables", "timing", "drivable"})
    # It is a study like any other: it is continued, and asked for other carries.
    assert run.main([*asked, "--resume"]) == 0
    assert capfd.readouterr().out == said.out
    assert recommend.main([str(root), "--force-limit", "117"]) == 0
    again = capfd.readouterr()
    assert again.out.startswith("Run this carry: ")
    assert re.search(r"recommendation: 0 of \d+ steps", again.err)
    assert report.main([str(root), "--quiet"]) == 2
    assert "a study with --recommend-only has no report" in capfd.readouterr().err


def test_why_carries_are_not_polished_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "stray").touch()  # so that it ends here
    (tmp_path / "robots").symlink_to(RACK.parents[1] / "robots")
    cell = tmp_path / "workcells" / "rack.toml"
    cell.parent.mkdir()
    joint = RACK.read_text("utf-8").replace("[task]", '[task]\ndrivable_allocation = "joint"')
    cell.write_text(joint, "utf-8")
    assert run.main([str(cell), "--output", str(tmp_path)]) == 2
    assert "are only searched, not polished: the polish does not" in capsys.readouterr().err


@pytest.fixture(scope="module")
def evaluator() -> CandidateEvaluator:
    return shipped("rack").evaluator


def test_the_hand_made_trajectory_is_feasible(evaluator: CandidateEvaluator) -> None:
    verdict = evaluator.evaluate(evaluator.workcell.task.initial.reshape(1, -1))
    assert verdict.feasible.all()
    # 2.9 % above the static hold, the figure of a trial by another program.
    static = evaluator.workcell.payload.mass * 9.81 / 2.0
    excess = verdict.objectives[0] * evaluator.workcell.task.reference_force / static - 1.0
    np.testing.assert_allclose(excess, 0.029, atol=5e-4)


@pytest.mark.slow
def test_few_random_candidates_are_feasible_and_for_several_reasons(
    evaluator: CandidateEvaluator,
) -> None:
    """20,000 uniform candidates: 2.01 % feasible with this seed when the bounds were chosen."""
    rng = np.random.default_rng(0)
    verdict = evaluator.evaluate(
        rng.uniform(evaluator.lower, evaluator.upper, (20000, evaluator.n_var))
    )
    assert 0.02 <= verdict.feasible.mean() <= 0.20
    violated = {REASONS[k] for k in np.flatnonzero((verdict.violation > 0.0).any(axis=0))}
    assert {"collision", "reach_1", "reach_2", "joint_limits_1", "pressure_1"} <= violated


@pytest.mark.parametrize(
    ("arguments", "started"),
    [
        (["--quick"], True),
        (["--executor", "processes"], True),
        (["--executor", "dask", "--scheduler", "tcp://here:8786"], False),
        (["--executor=dask"], False),
    ],
)
def test_workers_are_started_for_work_on_this_machine(
    arguments: list[str], started: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[tuple[str, ...]] = []
    monkeypatch.setattr(run, "warm_up", lambda *modules: loaded.append(modules))
    assert run.main([str(tmp_path / "none.toml"), *arguments]) == 2
    assert loaded == ([run.WORKERS_LOAD] if started else [])


@pytest.mark.parametrize("arguments", [["--help"], ["cell.toml", "-h"], ["cell.toml", "--qick"]])
def test_none_are_started_without_work(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def start(*modules: str) -> None:
        raise AssertionError(modules)

    monkeypatch.setattr(run, "warm_up", start)
    with pytest.raises(SystemExit):
        run.main(arguments)
    assert capsys.readouterr()
