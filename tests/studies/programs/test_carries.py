"""Programs about stored carries: exported, checked, replayed, their robust forces told."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.store.trajectory_file import write_trajectory
from studies import check, export, replay, robust
from symbolic.read.cell import load
from tests.hybrid_opt.job.jobs import rack
from tests.refusals import ended_by
from tests.symbolic.cells import RACK, rack_cell, standing_text

TABLE = """
[uncertainty]
friction = 0.10
mass = 0.05
centre_of_mass = [0.005, 0.005, 0.005]
pad_position = 0.003
disturbance = [0.2, 0.2, 0.2]
"""


def stored(folder: Path, table: str) -> Path:
    text, _ = standing_text().split("[uncertainty]")
    cell = folder / "cell.toml"
    cell.write_text(text + table, encoding="utf-8")
    workcell = load(cell)
    path = folder / "t.json"
    write_trajectory(path, workcell, workcell.task.initial.reshape(-1), {}, {"algorithm": "hand"})
    return path


def test_tells_forces_price_and_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--cases", "200", "--points", "3", "--planned-limit", "80"]
    assert robust.main([str(stored(tmp_path, TABLE)), *arguments]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "below 80 N" in lines[-2]
    planned, sure = (float(line.split()[-2]) for line in lines[-2:])
    assert planned < sure
    lines = lines[:-2]
    sure_forces = lines[3].split()[-4:-1:2]
    priced = [line.split() for line in lines if line.split()[:1] in (["0.00"], ["1.00"])]
    nominal, whole = (np.array(row[1:], dtype=float) for row in priced)
    assert (whole > 1.1 * nominal).all()
    assert priced[1][1:] == sure_forces
    # A job lifts and stops as well, and its forces are smooth.
    assert float(lines[2].split()[-2]) >= float(sure_forces[1])
    assert "200 random cases (seed 1): all " in lines[-1]
    # What is seen to need no more is not looked at closer.
    assert ("at most " in lines[-1]) == ("97.00 %" in lines[-1])


def test_the_force_is_that_of_the_exported_job(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Timed within its force limit and the cell's limits on jerk, and lifted."""
    cell = ho.example("rack").drivable()
    x = cell.initial.copy()
    x[-1] = 60.0
    path = tmp_path / "t.json"
    write_trajectory(path, cell.compiled, x, {}, {"algorithm": "hand"})
    assert robust.main([str(path), "--cases", "10", "--points", "2"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert export.main([str(path), "--target", "data", "--output", str(tmp_path)]) == 0
    (manifest,) = tmp_path.rglob("manifest.json")
    force = json.loads(manifest.read_text("utf-8"))["squeeze"]["force"]
    assert told[2].endswith(f" = {force:.1f} N")


def test_without_uncertainty_a_usual_set_is_taken_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--cases", "10", "--points", "3", "--leader", "2"]
    (tmp_path / "a").mkdir()
    assert robust.main([str(stored(tmp_path, "")), *arguments]) == 0
    without = capsys.readouterr().out
    assert "arm 2 leads" in without
    assert " no [uncertainty]: fri" in without
    assert "inf" not in without
    assert robust.main([str(stored(tmp_path / "a", TABLE)), *arguments]) == 0
    assert "'s [uncertainty]: fri" in capsys.readouterr().out


def test_a_set_that_is_empty_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert robust.main([str(stored(tmp_path, "[uncertainty]\n")), "--cases", "10"]) == 0
    told = capsys.readouterr().out
    assert "'s [uncertainty]: nothing" in told
    assert "random cases" not in told


@pytest.fixture(scope="module")
def of_a_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trajectory where a results folder of a study has it."""
    path = tmp_path_factory.mktemp("r") / "rack" / "selected" / "nsga2" / "02.json"
    path.parent.mkdir(parents=True)
    provenance = {"algorithm": "nsga2", "replica": 2, "row": 17}
    ho.save(rack().carry(rack().initial), path, provenance)
    return path


def test_a_bundle_is_written(
    of_a_study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(of_a_study), "--target", "data", "--step", "0.02", "--output", str(tmp_path)]
    assert export.main(arguments) == 0
    text = capsys.readouterr().out
    for part in ("approach", "set down", "Position control", "warning"):
        assert part in text
    (folder,) = tmp_path.iterdir()
    assert folder.name.startswith("rack-nsga2-r02-p0017-")
    manifest = json.loads((folder / "data" / "manifest.json").read_text())
    assert manifest["trajectory"]["file"] == "02.json"
    assert manifest["trajectory"]["replica"] == 2
    assert export.main([*arguments, "--stiffness", "1e4"]) == 0
    assert " 10000 N/m" in capsys.readouterr().out
    assert export.main([*arguments, "--squeeze", "1.6", "--planned-limit", "60"]) == 0
    assert len(list(tmp_path.iterdir())) == 2
    (folder / "data" / "mine.txt").write_text("mine")
    assert export.main(arguments) == 2
    assert "mine.txt" in capsys.readouterr().err
    assert (folder / "data" / "mine.txt").read_text() == "mine"


def test_drivers_may_come_from_a_file_after_the_study(
    of_a_study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    driver = {"address": "10.0.0.1", "force_control": True, "lag": 0.03, "stiffness": 1e4}
    names = [robot.name for robot in load(RACK).robots]
    listed = "\n".join(f"{key} = {json.dumps(value)}" for key, value in driver.items())
    file = tmp_path / "drivers.toml"
    entries = [f'[[robots]]\nname = "{name}"\n[robots.driver]\n{listed}\n' for name in names]
    file.write_text("\n".join(entries), "utf-8")
    arguments = [str(of_a_study), "--target", "abb-egm", "--output", str(tmp_path / "bundles")]
    with ended_by("no-address"):
        assert export.main(arguments) == 2
    assert export.main([*arguments, "--driver", str(file)]) == 0
    assert re.search(r": cd .*egm", capsys.readouterr().out)
    (config,) = (tmp_path / "bundles").rglob("egm.json")
    assert json.loads(config.read_text())["addresses"] == ["10.0.0.1", "10.0.0.1"]
    file.write_text('[[robots]]\nname = "nobody"\n', "utf-8")
    with ended_by("workcell", file, *names):
        assert export.main([*arguments, "--driver", str(file)]) == 2


@pytest.mark.parametrize(
    ("arguments", "quoted"),
    [
        (["--target", "data", "--step", "0"], "step"),
        (["--target", "data", "--use", "force"], "--planned-limit"),
        (["--target", "data", "--planned-limit", "1"], "timing"),
        (["--target", "data", "--squeeze", "0.5"], "0.5"),
        (["--target", "data", "--stiffness", "0"], "stiffness"),
        (["--target", "data", "--smoothing", "-1"], "smoothing"),
        (["--target", "data", "--smoothing", "nan"], "smoothing"),
        (["--target", "ur-script"], "--any-arm"),
        (["--target", "ros2-control"], "torque"),
        (["--target", "data", "--skew", "0.02", "--stiffness", "50000"], " 20 ms"),
        (["--target", "data", "--skew", "-1"], "skew"),
    ],
)
def test_wrong_exports_are_told_in_one_line(
    of_a_study: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    quoted: str,
) -> None:
    assert export.main([str(of_a_study), "--output", str(tmp_path), *arguments]) == 2
    error = capsys.readouterr().err
    assert quoted in error
    assert len(error.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@cache
def stored_text() -> str:
    cell = rack_cell()
    x = cell.task.initial.reshape(-1)
    figures = CandidateEvaluator(cell).carry(x).figures
    with TemporaryDirectory() as folder:
        path = Path(folder) / "t.json"
        write_trajectory(path, cell, x, figures, {"algorithm": "hand-made", "seed": 1})
        return path.read_text(encoding="utf-8")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "t.json"
    path.write_text(stored_text(), encoding="utf-8")
    return path


def test_it_needs_nothing_but_the_file(file: Path, tmp_path: Path) -> None:
    """In another process and folder, without the shipped workcells in reach of the file."""
    root = Path(__file__).resolve().parents[3]
    run = subprocess.run(
        [sys.executable, "-m", "studies.replay", str(file), "--json"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    assert result["reproduced"] is True
    assert result["digest"] == rack_cell().digest
    assert result["provenance"]["seed"] == 1
    assert all(figure["same"] for figure in result["figures"].values())


@pytest.mark.parametrize(
    "name", ["duration", "peak_normal_force_1", "feasible", "made_up", "start"]
)
def test_what_differs_is_shown(file: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    data = json.loads(file.read_text(encoding="utf-8"))
    if name == "start":
        data["start"][0][0] += 0.01
    else:
        data["figures"][name] = 0.99 * data["figures"].get(name, 0.0) - 1e-3
    file.write_text(json.dumps(data), encoding="utf-8")
    assert replay.main([str(file)]) == 1
    said = capsys.readouterr().out
    assert "NOT reproduced" in said
    marked = [row.split()[0] for row in said.splitlines() if "DIFFERS" in row]
    assert marked == [name] * (name != "start")


def test_timing_report(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(file), "--planned-limit", "60", "--force-curve", "3"]
    assert replay.main(arguments) == 0
    text = capsys.readouterr().out
    for part in ("closest to reference", "force limited", "How far assumptions", "against force"):
        assert part in text
    assert "objective_peak_force_1" in text
    assert "\nreproduced\n" in text
    assert "DIFFERS" not in text
    assert replay.main([*arguments, "--json"]) == 0
    stored_text = json.loads(capsys.readouterr().out)
    limited = stored_text["timing"]["timings"]["force limited"]
    assert limited["status"] == "ok"
    assert max(limited["peak_normal_force"]) <= 60.0 * 1.005
    assert len(stored_text["timing"]["force_curve"]["force"]) == 3


@pytest.mark.parametrize(
    ("program", "arguments", "quoted"),
    [
        (replay, ["t.json", "--force-curve", "1"], " 2"),
        (replay, ["odd.json"], "odd.json"),
        (robust, ["none.json"], "none.json"),
        (check, [str(RACK), "odd.csv"], "odd.csv"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(
    file: Path,
    program: ModuleType,
    arguments: list[str],
    quoted: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What the check finds is tested in tests/hybrid_opt/extras/bundles."""
    monkeypatch.chdir(file.parent)
    Path("odd.json").write_text("{}", encoding="utf-8")
    Path("odd.csv").write_text("time,left_joint_1\n0,0\n", encoding="utf-8")
    assert program.main(arguments) == 2
    *progress, told = capsys.readouterr().err.splitlines()
    assert quoted in told
    assert len(progress) == (program is replay and "t.json" in arguments)
