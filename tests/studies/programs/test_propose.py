from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.proposing.problem import completed
from studies.program import BAD_INPUT
from studies.propose import main

PROBLEM = Path("studies/problems/past-a-post.toml")


def test_the_problem_file_is_not_overwritten(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(PROBLEM), "--output", str(PROBLEM)]) == BAD_INPUT
    assert "is the problem file" in capsys.readouterr().err


def test_a_missing_folder_is_told_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(PROBLEM), "--output", str(tmp_path / "none" / "cell.toml")]) == BAD_INPUT
    assert "is no folder" in capsys.readouterr().err


def test_what_is_in_the_way_is_told_and_nothing_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The box stands in the post."""
    data = tomllib.loads(PROBLEM.read_text(encoding="utf-8"))
    data["task"]["goal"] = [0.05, 0.0, 0.35, 0.0, 0.0, 0.0]
    path = tmp_path / "cell.toml"
    path.write_text(completed("", data, {}), encoding="utf-8")
    assert main([str(path), "--quiet"]) == BAD_INPUT
    told = capsys.readouterr()
    assert "payload meets post at the goal" in told.err
    assert told.out == ""
    assert [entry.name for entry in tmp_path.iterdir()] == ["cell.toml"]


@pytest.mark.slow
def test_pads_go_where_the_carry_that_was_found_costs_less(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "cell.toml"
    given = [str(PROBLEM), "--output", str(file), "--quiet", "--grips=-0.03:0.02,-0.02:0.02"]
    assert main(given) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert "certified" in first
    before, after = (float(part.split(" N s")[0].split()[-1]) for part in last.split("in place of"))
    assert before <= after, "the product was larger where the pads were"
    cell = Cell.load(file)
    assert cell.evaluator.certified(cell.evaluate(cell.initial)).feasible.all()
    one, two = (contact.T_box_pad[:3, 3] for contact in cell.workcell.contacts)
    np.testing.assert_allclose(one[[0, 2]], two[[0, 2]], atol=1e-9)
    assert -0.03 <= one[2] <= 0.02
    assert abs(one[0]) <= 0.02


@pytest.mark.parametrize("ranges", ["0.02:0.01", "0.01", "0:1,0:1,0:1", "a:b"])
def test_wrong_ranges_are_refused(ranges: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([str(PROBLEM), f"--grips={ranges}"])
    assert "--grips" in capsys.readouterr().err
