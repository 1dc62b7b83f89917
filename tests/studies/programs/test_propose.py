from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

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
