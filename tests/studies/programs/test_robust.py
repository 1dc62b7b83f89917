"""`python -m studies.robust`: forces for a stored trajectory's uncertainty."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.store.trajectory_file import write_trajectory
from studies import export
from studies.robust import main
from symbolic.read.cell import load
from tests.symbolic.cells import RACK

TABLE = """
[uncertainty]
friction = 0.10
mass = 0.05
centre_of_mass = [0.005, 0.005, 0.005]
pad_position = 0.003
disturbance = [0.2, 0.2, 0.2]
"""


def stored(folder: Path, table: str) -> Path:
    text, _ = RACK.read_text(encoding="utf-8").split("[uncertainty]")
    text = text.replace("../robots", str(RACK.parents[1] / "robots"))
    cell = folder / "cell.toml"
    cell.write_text(text + table, encoding="utf-8")
    workcell = load(cell)
    path = folder / "t.json"
    write_trajectory(path, workcell, workcell.task.initial.reshape(-1), {}, {"algorithm": "hand"})
    return path


def test_tells_forces_price_and_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(
            [str(stored(tmp_path, TABLE)), "--cases", "200", "--points", "3", "--force-limit", "66"]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert "below 66 N" in lines[-2]
    planned, sure = (float(line.split()[-2]) for line in lines[-2:])
    assert planned < sure
    lines = lines[:-2]
    robust = lines[3].split()[-4:-1:2]
    priced = [line.split() for line in lines if line.split()[:1] in (["0.00"], ["1.00"])]
    nominal, whole = (np.array(row[1:], dtype=float) for row in priced)
    assert (whole > 1.1 * nominal).all()
    assert priced[1][1:] == robust
    # A job lifts and stops as well, and its forces are smooth.
    assert float(lines[2].split()[-2]) >= float(robust[1])
    assert "200 random cases (seed 1): all hold" in lines[-1]
    # What is seen to need no more is not looked at closer.
    assert ("needs at most " in lines[-1]) == ("97.00 %" in lines[-1])


def test_the_force_is_that_of_the_exported_job(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Timed within its force limit and the cell's limits on jerk, and lifted."""
    cell = ho.example("rack").drivable()
    x = cell.initial
    x[-1] = 60.0
    path = tmp_path / "t.json"
    write_trajectory(path, cell.compiled, x, {}, {"algorithm": "hand"})
    assert main([str(path), "--cases", "10", "--points", "2"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert export.main([str(path), "--target", "json", "--output", str(tmp_path)]) == 0
    (manifest,) = tmp_path.rglob("manifest.json")
    force = json.loads(manifest.read_text("utf-8"))["squeeze"]["force"]
    assert told[2].startswith("  commanded of the whole job: ")
    assert told[2].endswith(f" = {force:.1f} N")


def test_without_uncertainty_a_usual_set_is_taken_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--cases", "10", "--points", "3", "--leader", "2"]
    (tmp_path / "a").mkdir()
    assert main([str(stored(tmp_path, "")), *arguments]) == 0
    without = capsys.readouterr().out
    assert "arm 2 leads" in without
    assert "the set is the usual one, because the workcell states no [uncertainty]: fri" in without
    assert "inf" not in without
    assert main([str(stored(tmp_path / "a", TABLE)), *arguments]) == 0
    assert "the set is the workcell's [uncertainty]: fri" in capsys.readouterr().out


def test_a_set_that_is_empty_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(stored(tmp_path, "[uncertainty]\n")), "--cases", "10"]) == 0
    told = capsys.readouterr().out
    assert "the set is the workcell's [uncertainty]: nothing" in told
    assert "nothing to check" in told
    assert "all hold" not in told
    assert "times the set" not in told


def test_a_file_that_is_none_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none.json")]) == 2
    assert "none.json" in capsys.readouterr().err
