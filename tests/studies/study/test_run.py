"""The programs that people start: whole studies, how they begin, their messages and exit codes."""

from __future__ import annotations

import csv
import gzip
import html
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.campaign import ExecutionSettings, Stage, open_folder, run_stages
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.errors import NoCarryError
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES, front_of
from hybrid_opt.indicators import metrics
from hybrid_opt.progress import Progress
from hybrid_opt.recommending.choice import Wish
from hybrid_opt.store.trajectory_file import read_trajectory, replay
from hybrid_opt.timing.analysis import read_timing
from studies import export, rack, recommend, run
from studies import replay as replay_program
from studies.program import Program
from studies.programs.study import campaign_settings, polish_settings, study_text
from studies.report import PAGE
from studies.report import __main__ as report
from studies.study.answer import answer, carry_text
from studies.study.recommendation import (
    FRONT,
    StoredRecommendation,
    read_recommendation,
    recommend_from,
)
from studies.study.summary import read_summary
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, drivable_files, unpack_cell
from tests.refusals import ended_by, refused
from tests.studies.conftest import SMALL, TRANSFER
from tests.symbolic.cells import ROOT, standing_text
from tests.waiting import HANGS, soon, until

CELL = str(TRANSFER)


def test_study_leaves_everything_behind(program_run: tuple[Path, str]) -> None:
    root, printed = program_run
    summary = read_summary(root)
    results = read_campaign(root)
    assert [found.algorithm for found in results.replicas] == ["nsga2"] * 2 + ["mopso"] * 2
    for replica in results.replicas:
        entry = summary.algorithms[replica.algorithm].replicas[replica.replica]
        found = replica.evaluations
        assert len(found) == entry.evaluations == 120
        assert entry.feasible == int(found.feasible.sum()) > 0
        assert entry.feasible + sum(entry.infeasible_by_reason.values()) == 120
        # Dominance by its definition, point by point.
        alive = found.objectives[found.feasible]
        best = [p for p in alive if not any((q <= p).all() and (q < p).any() for q in alive)]
        assert entry.non_dominated == len(np.unique(best, axis=0)) == len(replica.front)
        assert entry.hypervolume == metrics.hypervolume(replica.front)
        assert entry.selected is not None
        assert entry.selected.file is not None
        stored = read_trajectory(root / entry.selected.file)
        np.testing.assert_array_equal(stored.x, found.x[entry.selected.evaluation - 1])
        assert stored.figures["payload_limit"] == entry.payload_limit
        assert entry.payload_limit < summary.static_hold.payload_limit
        rows = list(csv.reader((root / f"fronts/{replica.algorithm}.csv").open()))
        assert rows[0] == ["peak_force_1", "peak_force_2"]
        # Searches start from the initial trajectory.
        initial = results.workcell.task.initial.ravel()
        assert (found.x[0] == initial).all()
        assert not (found.x[1:40] == initial).all(axis=1).any()
    reference = np.loadtxt(root / "fronts/reference.csv", delimiter=",", skiprows=1, ndmin=2)
    union = np.concatenate([replica.front for replica in results.replicas])
    np.testing.assert_array_equal(reference, front_of(union))
    levels = np.loadtxt(root / "fronts/mopso-attainment.csv", delimiter=",", skiprows=1, ndmin=2)
    assert set(levels[:, 0]) == {25.0, 50.0, 75.0, 100.0}
    assert "Table 1" in printed
    assert "Table 2" not in printed, "the page and tables/ have it"
    assert len(printed.splitlines()) <= 34, "one screen"
    assert str(root) in printed
    assert "paper" not in printed.lower()


def test_study_opens_with_a_carry_to_run(program_run: tuple[Path, str], tmp_path: Path) -> None:
    """Terminal, summary.json and the stored trajectory agree; the hand-made one stands beside."""
    root, printed = program_run
    found = read_summary(root).recommendation
    assert found is not None
    opening = answer(found, str(root))
    assert printed.startswith(opening.terminal())
    assert sum(part.force for part in found.parts) == pytest.approx(found.force)
    assert f"= {found.force:.1f} N; " in printed
    assert "--target torque --output" in printed
    (command,) = (fact.text for fact in answer(found, "").commands if fact.is_command)
    assert "--force-limit" not in command, "a carry is exported as it is stored"
    assert str(root) not in command, "it holds wherever the folder is moved"
    stored = read_trajectory(root / found.file)
    assert replay(stored, stored.open_cell(tmp_path)).reproduced
    assert stored.x[-1] == found.force_limit
    drivable = read_campaign(root / "drivable")
    assert drivable.objectives == ("duration", "peak_force")
    assert drivable.workcell.task.time_law == "optimal"
    fronts = np.concatenate([replica.front_x for replica in drivable.replicas])
    assert (fronts[:, :-1] == stored.x[:-1]).all(axis=1).any()
    assert [rival.label for rival in found.rivals] == ["hand-made", "least-force"]
    labels = [row.label for row in found.durations.rows]
    assert labels == ["hand-made", "recommended", "least-force", FRONT]
    assert found.durations.forces[-1] == 117.68
    for folder, law in ((root, "ramped"), (root / "drivable", "optimal")):
        task, hand_made = read_campaign(folder).workcell.task, folder / "selected/hand-made.json"
        assert task.time_law == law
        own = load(TRANSFER).task.initial.ravel()
        np.testing.assert_array_equal(read_trajectory(hand_made).x[: task.n_path], own)
    assert (root / "timing/hand-made.json").exists()
    jerk = read_timing(root / "drivable/timing/nsga2/00.json").jerk
    assert jerk is not None
    assert jerk.duration > jerk.without
    assert max(jerk.joint_use, jerk.payload_use) == pytest.approx(1.0, abs=0.01)


def test_every_program_states_the_same_carry(
    program_run: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Terminal, page, recommend, replay and export: the line of the carry to the last digit. The
    tutorial explains its words."""
    root, printed = program_run
    found = read_summary(root).recommendation
    assert found is not None
    line = carry_text(found.duration, found.force, found.job_duration, found.order)
    file, page = root / found.file, (root / PAGE).read_text("utf-8")
    assert f": {line}\n" in printed
    assert f": {line}<" in page
    for fact in answer(found, "").facts:
        assert re.search(rf"  {fact.heading} +{re.escape(fact.sentence)}\n", printed)
        assert html.escape(fact.text) in page
    tutorial = (ROOT / "docs/tutorials/demo.md").read_text("utf-8")
    terms = re.findall(r"^- (?:The )?\*([a-z -]+)\*", tutorial, flags=re.MULTILINE)
    assert len(terms) == 3
    assert [term for term in terms if term not in printed] == []
    assert found.parts[0].name in terms
    calls: list[tuple[Program, list[str]]] = [
        (recommend.main, [str(root), "--output", str(tmp_path / "again.json"), "--quiet"]),
        (replay_program.main, [str(file)]),
        (export.main, [str(file), "--target", "torque", "--output", str(tmp_path / "bundle")]),
    ]
    for program, arguments in calls:
        assert program(arguments) == 0
        assert line in capsys.readouterr().out, program.name


def test_drivable_fronts_are_polished_as_one_and_others_replica_by_replica(study: Path) -> None:
    """Polishes of drivable fronts begin with the same best path: they would compare it with
    itself."""
    paper, drivable = read_campaign(study), read_campaign(study / "drivable")
    replicas = [("nsga2", 0), ("nsga2", 1), ("mopso", 0), ("mopso", 1)]
    assert [front.key for front in paper.to_polish] == replicas
    (union,) = drivable.to_polish
    assert union.key == ("union", 0)
    points = np.concatenate([replica.front for replica in drivable.replicas])
    np.testing.assert_array_equal(union.objectives, front_of(points))
    every = np.concatenate([replica.front_x for replica in drivable.replicas])
    assert (union.x[:, None] == every).all(axis=2).any(axis=1).all()
    assert drivable.cell.evaluate(union.x).feasible.all()


@pytest.mark.slow
def test_another_wish_needs_no_other_study(
    program_run: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, _ = program_run
    file = tmp_path / "gentle.json"
    assert recommend.main([str(root), "--duration", "4", "--output", str(file)]) == 0
    printed = capsys.readouterr().out
    assert " 4 s" in printed
    assert str(file) in printed
    assert read_trajectory(file).figures["duration"] < 4.1
    with ended_by("two-wishes"):
        assert recommend.main([str(root), "--duration", "4", "--force-limit", "90"]) == 2
    other = ["--payload", "6", "--reference-force", "115", "--uncertainty", "friction=0.01"]
    assert recommend.main([str(root), *other, "--output", str(file)]) == 0
    printed = capsys.readouterr().out
    assert " 6 kg" in printed
    assert " 115 N" in printed
    cell = read_trajectory(file).open_cell(tmp_path / "cell").workcell
    assert (cell.payload.mass, cell.uncertainty.friction) == (6.0, 0.01)
    assert cell.task.reference_force.tolist() == [115.0, 115.0]


def test_a_stored_study_can_be_repeated_from_its_own_workcell(
    program_run: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, _ = program_run
    configuration = json.loads((root / "configuration.json").read_text())
    cell = str(root / configuration["workcell"]["file"])
    arguments = [cell, "--output", str(tmp_path / "b"), *SMALL, "--no-drivable", "--no-report"]
    assert run.main([*arguments, "--replicas", "1", "--quiet"]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "--no-drivable" in told.out
    assert "Table 2" in told.out, "no report has it"
    for name in ("mopso", "nsga2"):
        file = f"replicas/{name}/00.csv.gz"
        contents = [gzip.decompress((each / file).read_bytes()) for each in (tmp_path / "b", root)]
        # But for the first line, with the time that it took.
        assert len({content.partition(b"\n")[2] for content in contents}) == 1


def test_resuming_a_finished_study_only_tells(
    program_run: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    root, printed = program_run
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*.*") if path.name != ".lock"}
    assert run.main([CELL, "--output", str(root), *SMALL, "--resume"]) == 0
    assert capsys.readouterr().out == printed
    assert before == {p: p.stat().st_mtime_ns for p in root.rglob("*.*") if p.name != ".lock"}


def interrupted(
    options: list[str], cache: Path | None, ready: Callable[[], bool], seconds: float = HANGS
) -> list[str]:
    """What a study of the cell says when Ctrl-C comes as soon as it is ready: it ends by then."""
    process = subprocess.Popen(
        [sys.executable, "-m", "studies.run", CELL, *options],
        cwd=ROOT,
        env=os.environ | ({} if cache is None else {"DUAL_ARM_CACHE": str(cache)}),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until(ready, process)
    with soon(seconds):
        os.killpg(process.pid, signal.SIGINT)
        message = process.communicate(timeout=HANGS)[1]
    assert process.returncode == 130
    assert "Traceback" not in message
    return message.strip().splitlines()


CONTINUED = "interrupted, nothing is lost; continue with: python -m studies.run "


def test_interrupt_tells_how_to_go_on(tmp_path: Path) -> None:
    root = tmp_path / "my results"
    options = ["--no-polish", "--no-drivable"]  # what they need is not compiled for it
    options += ["--evaluations", "20000", "--replicas", "1", "--jobs", "2", "--seed", "5"]
    last = interrupted(
        ["--output", str(root), *options],
        None,
        (root / "stages" / "search.json").exists,
    )[-1]
    assert last.startswith(CONTINUED)
    assert f"--output '{root}'" in last
    assert last.endswith("--seed 5 --resume")


def test_interrupt_while_compiling_ends_at_once(tmp_path: Path) -> None:
    cache, options = tmp_path / "cache", ["--output", str(tmp_path / "a"), "--quick"]
    # Some seconds of compilers before Ctrl-C; all take 60 s.
    lines = interrupted(options, cache, lambda: any(cache.glob("build-*/*.c")), 25.0)
    budget, said = [line for line in lines if line and "compiling:" not in line]
    assert re.search(r"\d N of \d", budget)
    assert said.startswith(CONTINUED)


@pytest.mark.parametrize(
    ("arguments", "quoted"),
    [
        (["--evaluation", "5"], "'--evaluations'"),
        (["--evaluations", "many"], "'many'"),
        (["--evaluations", "0"], "evaluations is 0"),
        (["--algorithm", "nsga3"], "'nsga3'; known are nsga2, mopso"),
        (["--objective", "speed"], "'speed'; known are peak_force_1"),
        (["--constraint-handling", "hope"], "'hope'"),
        (["--first-generation", "lucky"], "'lucky'"),
        (["--population", "nsga2"], "NAME=N"),
        (["--population", "nsga3=4"], "'nsga3'"),
        (["--executor", "dask"], "--scheduler"),
        (["--jobs", "-2"], "jobs is -2"),
        (["--resume", "--overwrite"], "--overwrite"),
    ],
)
def test_wrong_options_get_one_message(
    arguments: list[str], quoted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = rack.main(["--output", str(tmp_path / "a"), *arguments])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else -1
    assert code == 2
    told = capsys.readouterr()
    assert quoted in told.err
    assert told.err.startswith("python -m studies.rack: ")
    assert told.err.count("\n") == 1
    assert told.out == ""
    assert not (tmp_path / "a").exists()


def test_a_study_without_a_recommendation_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Force limits that are below what holds the box still leave no drivable carry. The cell's own
    time law is optimal, so that there is one experiment."""
    cell = unpack_cell(drivable_files(collect_cell(load(Path(CELL)))), tmp_path / "cell").source
    cell.write_text(cell.read_text().replace("[task]", "[task]\nforce_limit = [20.0, 30.0]"))
    root = tmp_path / "results"
    options = ["--algorithm", "random", "--evaluations", "4", "--replicas", "1", "--jobs", "1"]
    options += ["--no-polish", "--quiet", "--output", str(root)]
    assert run.main([str(cell), *options]) == 0
    summary = read_summary(root)
    assert summary.objectives == ("duration", "peak_force")
    assert not (root / "drivable").exists()
    assert summary.recommendation is None
    assert re.search(r" 4 drivable .* 1[67]\d\.\d % ", summary.no_recommendation)
    assert f"  {summary.no_recommendation}" in capsys.readouterr().out
    assert html.escape(summary.no_recommendation) in (root / PAGE).read_text()
    with refused(NoCarryError, "no-carry", summary.no_recommendation):
        recommend_from(root, Wish(), tmp_path / "carry.json", Progress(shown=False))


def test_options_are_explained_and_become_settings() -> None:
    parser, usual = rack.main.parser(), ho.PolishSettings()
    told = re.split(r"\n(?=  --)", parser.format_whole_help())[1:]
    assert len(told) == len([action for action in parser._actions if action.dest != "help"])
    valued = [option for option in told if not option.lstrip().startswith(("--help", "--version"))]
    assert len(valued) == len(told) - 2
    assert all(re.search(r"\(default:", option) for option in valued)
    assert polish_settings(parser.parse_args([]), True, is_drivable=False) == usual
    assert polish_settings(parser.parse_args(["--no-polish"]), True, is_drivable=False) is None
    arguments = (
        "--algorithm mopso --algorithm random --population mopso=30 --objective duration "
        "--first-generation random --constraint-handling constraints --seed 7 --evaluations 50 "
        "--replicas 3 --polish --polish-solver ipopt --polish-attempts 3"
    )
    options = parser.parse_args(arguments.split())
    polish, settings = polish_settings(options, True, is_drivable=False), campaign_settings(options)
    assert polish is not None
    assert (polish.solver, polish.attempts) == ("ipopt", 3)
    assert list(settings.algorithms) == ["mopso", "random"]
    assert settings.algorithms["mopso"]["swarm"] == 30
    assert settings.objectives == ("duration",)
    assert settings.constraint_handling == "constraints"
    assert settings.first_generation == "random"
    assert (settings.seed, settings.evaluations, settings.replicas) == (7, 50, 3)


def test_what_is_refused_is_refused_before_anything_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(standing_text(TRANSFER))
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
    with ended_by("folder-in-use", "--resume", "--output"):
        assert run.main(asked) == 2
    with ended_by("another-stage-setting", "'polish'", {"attempts": 1}):
        assert run.main([*asked[:-2], "--polish", "--resume"]) == 2
    cell.write_text(cell.read_text().replace("friction = 0.8", "friction = 0.75"))
    with ended_by("another-workcell", "--overwrite"):
        assert run.main([*asked, "--resume"]) == 2
    with pytest.raises(AssertionError, match="compiles"):
        run.main([*asked, "--overwrite"])
    assert (root / "stages" / "polish.json").exists()


def test_a_recommendation_alone_makes_nothing_else(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "a"
    asked = [CELL, "--output", str(root), "--recommend-only", "--jobs", "1"]
    asked += ["--evaluations", "120", "--no-polish", "--force-limit", "116"]
    assert run.main(asked) == 0
    said = capfd.readouterr()
    assert "Report:" not in said.out
    assert re.search(r"recommendation: \d+ of \d+ steps \[", said.err)
    found = read_recommendation(root)
    assert isinstance(found, StoredRecommendation)
    assert said.out.startswith(answer(found, str(root)).terminal())
    assert found.force <= 116.0 * (1.0 + 2e-3)
    assert [rival.label for rival in found.rivals] == ["hand-made"]
    assert "jerk" in study_text(root, with_paper=False)
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
    assert re.match(r".* \d+\.\d\d s.* \d+\.\d N", again.out)
    assert re.search(r"recommendation: 0 of \d+ steps", again.err)
    with ended_by("no-report"):
        assert report.main([str(root), "--quiet"]) == 2


def test_why_carries_are_not_polished_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = tmp_path / "fork.toml"  # no file of a study, so that it ends here
    cell.write_text(standing_text(ROOT / "studies/workcells/fork.toml"), "utf-8")
    robust = ["--objective", *ROBUST_OBJECTIVES]
    assert run.main([str(cell), "--output", str(tmp_path), *robust]) == 2
    assert "polished: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "started"),
    [
        (["cell.toml", "--quick"], True),
        (["cell.toml", "--executor", "processes"], True),
        (["cell.toml", "--executor", "dask", "--scheduler", "tcp://here:8786"], False),
        (["cell.toml", "--executor=dask"], False),
        (["--help"], False),
        (["cell.toml", "-h"], False),
        (["cell.toml", "--qick"], False),
    ],
)
def test_workers_are_started_for_work_on_this_machine(
    arguments: list[str], started: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[tuple[str, ...]] = []
    monkeypatch.setattr(run, "warm_up", lambda *modules: loaded.append(modules))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.toml").touch()
    with suppress(SystemExit):
        assert run.main(arguments) == 2
    assert loaded == ([run.WORKERS_LOAD] if started else [])
