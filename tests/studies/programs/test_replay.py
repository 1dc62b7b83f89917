"""`python -m studies.replay`: figures come out again from the file alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.store.trajectory_file import write_trajectory
from studies.replay import main
from tests.symbolic.cells import rack_cell


@cache
def document() -> str:
    cell = rack_cell()
    x = cell.task.initial.reshape(-1)
    figures = CandidateEvaluator(cell).carry(x).figures
    with TemporaryDirectory() as folder:
        path = Path(folder) / "t.json"
        write_trajectory(path, cell, x, figures, {"algorithm": "hand-made", "seed": 1})
        return path.read_text(encoding="utf-8")


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "t.json"
    path.write_text(document(), encoding="utf-8")
    return path


def test_figures_are_reproduced(stored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(stored)]) == 0
    out = capsys.readouterr().out
    assert "reproduced" in out
    assert "DIFFERS" not in out
    assert "objective_peak_force_1" in out


def test_it_needs_nothing_but_the_file(stored: Path, tmp_path: Path) -> None:
    """In another process and folder, without the shipped workcells in reach of the file."""
    root = Path(__file__).resolve().parents[3]
    run = subprocess.run(
        [sys.executable, "-m", "studies.replay", str(stored), "--json"],
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
    ("name", "change"), [("duration", 1e-3), ("peak_normal_force_1", -1e-2), ("feasible", -2.0)]
)
def test_differences_are_shown_with_both_values(
    stored: Path, capsys: pytest.CaptureFixture[str], name: str, change: float
) -> None:
    data = json.loads(stored.read_text(encoding="utf-8"))
    data["figures"][name] += change
    stored.write_text(json.dumps(data), encoding="utf-8")
    assert main([str(stored)]) == 1
    (line,) = (row for row in capsys.readouterr().out.splitlines() if "DIFFERS" in row)
    assert name in line


def test_unknown_figures_and_other_postures_are_differences(
    stored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = json.loads(stored.read_text(encoding="utf-8"))
    data["figures"]["made_up"] = 1.0
    stored.write_text(json.dumps(data), encoding="utf-8")
    assert main([str(stored)]) == 1
    del data["figures"]["made_up"]
    data["start"][0][0] += 0.01
    stored.write_text(json.dumps(data), encoding="utf-8")
    assert main([str(stored)]) == 1
    assert "NOT reproduced" in capsys.readouterr().out


def test_timing_report(stored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(stored), "--force-limit", "60", "--force-curve", "3"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    for part in (
        "closest to reference",
        "force limited",
        "How far assumptions",
        "Duration against force",
    ):
        assert part in text
    assert main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    limited = document["timing"]["timings"]["force limited"]
    assert limited["status"] == "ok"
    assert max(limited["peak_normal_force"]) <= 60.0 * 1.005
    assert len(document["timing"]["force_curve"]["force"]) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--force-curve", "1"], "at least 2"),
    ],
)
def test_bad_options_are_told(
    stored: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main([str(stored), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_a_bad_file_gives_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "odd.json"
    path.write_text("{}", encoding="utf-8")
    assert main([str(path)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
