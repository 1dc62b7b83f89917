"""Stages run once, in order, and again where something before them did."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from hybrid_opt.campaign import (
    CampaignFolder,
    CampaignSettings,
    ExecutionSettings,
    Progress,
    Stage,
    open_folder,
    run_stages,
)
from hybrid_opt.errors import ResultsError
from symbolic.read.cell import load
from tests.hybrid_opt.campaign.fake import RACK


def run(root: Path, *stages: Stage) -> None:
    execution = ExecutionSettings(root, 1, resume=True)
    with open_folder(CampaignSettings(), execution, load(RACK)) as folder:
        run_stages(folder, stages, Progress(shown=False))


def noting(ran: list[str], name: str) -> Callable[[CampaignFolder, Progress], None]:
    return lambda folder, progress: ran.append(name)


def test_done_stages_are_left_alone(tmp_path: Path) -> None:
    ran: list[str] = []
    stages = [Stage(name, noting(ran, name)) for name in ("search", "polish", "report")]
    run(tmp_path, *stages[:2])
    assert ran == ["search", "polish"]
    run(tmp_path, *stages)
    assert ran == ["search", "polish", "report"]
    (tmp_path / "stages/polish.json").unlink()
    run(tmp_path, *stages)
    assert ran == ["search", "polish", "report", "polish", "report"]


def test_a_stage_whose_files_are_damaged_runs_again(tmp_path: Path) -> None:
    ran: list[str] = []
    file = tmp_path / "kept"
    stages = [
        Stage("search", noting(ran, "search"), whole=lambda folder: file.exists()),
        Stage("polish", noting(ran, "polish")),
    ]
    run(tmp_path, *stages)
    file.touch()
    run(tmp_path, *stages)
    assert ran == ["search", "polish"]
    file.unlink()
    run(tmp_path, *stages)
    assert ran == ["search", "polish"] * 2


def test_an_interrupted_stage_runs_again_and_its_time_adds_up(tmp_path: Path) -> None:
    ran: list[str] = []

    def interrupted(folder: CampaignFolder, progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, Stage("search", noting(ran, "search")), Stage("polish", interrupted))
    marker = tmp_path / "stages/polish.json"
    begun = json.loads(marker.read_text())
    assert begun["status"] == "running"
    run(tmp_path, Stage("search", noting(ran, "again")), Stage("polish", noting(ran, "polish")))
    assert ran == ["search", "polish"]
    done = json.loads(marker.read_text())
    assert done["status"] == "done"
    assert done["seconds"] > begun["seconds"] > 0.0


def test_what_follows_an_interrupted_stage_runs_again(tmp_path: Path) -> None:
    ran: list[str] = []
    stages = [Stage(name, noting(ran, name)) for name in ("search", "report")]
    run(tmp_path, *stages)
    (tmp_path / "stages/search.json").unlink()

    def interrupted(folder: CampaignFolder, progress: Progress) -> None:
        # Should the process die right here, the report must not look done.
        assert json.loads((tmp_path / "stages/report.json").read_text())["status"] == "outdated"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, Stage("search", interrupted), stages[1])
    run(tmp_path, *stages)
    assert ran == ["search", "report", "search", "report"]


@pytest.mark.parametrize("content", ["[]", "{}", "nonsense"])
def test_a_damaged_marker_is_told(tmp_path: Path, content: str) -> None:
    run(tmp_path, Stage("polish", noting([], "polish")))
    (tmp_path / "stages/polish.json").write_text(content)
    with pytest.raises(ResultsError, match=r"polish.json: damaged"):
        run(tmp_path, Stage("polish", noting([], "polish")))


def test_a_stage_of_other_settings_is_refused(tmp_path: Path) -> None:
    ran: list[str] = []
    run(tmp_path, Stage("polish", noting(ran, "polish"), {"attempts": 20}))
    with pytest.raises(ResultsError, match=r"'polish' was run with .*20.*, now asked for is .*30"):
        run(tmp_path, Stage("polish", noting(ran, "polish"), {"attempts": 30}))
    assert ran == ["polish"]
