"""A results folder belongs to one campaign and never takes in anything else."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hybrid_opt.campaign import (
    CampaignFolder,
    CampaignSettings,
    ExecutionSettings,
    Stage,
    open_folder,
    run_stages,
)
from hybrid_opt.errors import ResultsError
from hybrid_opt.progress import Progress
from symbolic.read.cell import load
from tests.hybrid_opt.campaign.fake import RACK
from tests.refusals import refused

SETTINGS = CampaignSettings(evaluations=200, replicas=2)


def begun(root: Path) -> ExecutionSettings:
    """A folder in which a campaign began, to be continued."""
    execution = ExecutionSettings(root, 1, resume=True)
    with open_folder(SETTINGS, execution, load(RACK)):
        return execution


def folder_refused(
    code: str,
    quoted: str,
    execution: ExecutionSettings,
    settings: CampaignSettings = SETTINGS,
    cell: Path = RACK,
) -> None:
    with (
        refused(ResultsError, code, quoted),
        open_folder(settings, execution, load(cell)),
    ):
        pytest.fail("opened")


@pytest.mark.parametrize(
    ("change", "quoted"),
    [
        ({"seed": 2}, "settings.seed: stored 1, now 2"),
        ({"evaluations": 201}, "settings.evaluations: stored 200, now 201"),
        ({"replicas": 3}, "settings.replicas: stored 2, now 3"),
        ({"constraint_handling": "constraints"}, 'stored "penalty", now "constraints"'),
        (
            {"algorithms": {"nsga2": {}, "mopso": {"swarm": 30}}},
            "settings.algorithms.mopso.swarm: stored 40, now 30",
        ),
        ({"objectives": ("duration", "mean_force")}, "settings.objectives: "),
    ],
)
def test_other_settings_are_never_mixed(
    tmp_path: Path, change: dict[str, Any], quoted: str
) -> None:
    folder_refused("other-settings", quoted, begun(tmp_path), replace(SETTINGS, **change))


@pytest.mark.parametrize("key", ["numpy", "sources"])
def test_other_software_is_never_mixed(tmp_path: Path, key: str) -> None:
    execution, path = begun(tmp_path), tmp_path / "configuration.json"
    stored = json.loads(path.read_text())
    stored["environment"][key] = "0.1"
    path.write_text(json.dumps(stored))
    folder_refused("other-settings", f'environment.{key}: stored "0.1"', execution)


def changed_cell(folder: Path) -> Path:
    shutil.copytree(RACK.parents[1] / "robots", folder / "robots")
    path = folder / "cells/cell.toml"
    path.parent.mkdir()
    path.write_text(RACK.read_text().replace("mass = 10.0", "mass = 10.5"))
    return path


def test_other_workcell_is_never_mixed(tmp_path: Path) -> None:
    execution, cell = begun(tmp_path / "a"), changed_cell(tmp_path)
    folder_refused("another-workcell", "--overwrite", execution, cell=cell)


def test_results_are_overwritten_where_that_is_asked_for(tmp_path: Path) -> None:
    root = tmp_path / "a"
    begun(root)
    (root / "stages").mkdir()
    (root / "stages" / "search.json").write_text("{}")
    (root / "front.csv").write_text("")
    execution = ExecutionSettings(root, 1, overwrite=True)
    with open_folder(replace(SETTINGS, seed=7), execution, load(changed_cell(tmp_path))):
        names = sorted(entry.name for entry in root.iterdir())
    assert names == [".lock", "configuration.json", "workcell"]
    assert json.loads((root / "configuration.json").read_text())["settings"]["seed"] == 7


@pytest.mark.parametrize("asked", [{}, {"resume": True}, {"overwrite": True}])
def test_what_is_no_results_folder_is_not_touched(tmp_path: Path, asked: dict[str, Any]) -> None:
    kept = tmp_path / "thesis.tex"
    kept.write_text("kept")
    execution = ExecutionSettings(tmp_path, 1, **asked)
    folder_refused("not-empty", "thesis.tex", execution)
    assert kept.read_text() == "kept"


def test_the_stored_workcell_does_not_follow_the_file(tmp_path: Path) -> None:
    cell = changed_cell(tmp_path)
    execution = ExecutionSettings(tmp_path / "a", 1)
    with open_folder(SETTINGS, execution, load(cell)) as folder:
        cell.unlink()
        assert folder.workcell.payload.mass == 10.5
        assert folder.workcell.source.is_relative_to(tmp_path / "a")
        assert load(folder.workcell.source).digest == folder.workcell.digest


def test_existing_results_are_not_touched_without_resume(tmp_path: Path) -> None:
    execution = replace(begun(tmp_path), resume=False)
    folder_refused("folder-in-use", "--resume", execution)


def test_a_changed_copy_of_the_workcell_is_told_and_a_missing_one_made_again(
    tmp_path: Path,
) -> None:
    execution = begun(tmp_path)
    copy = next((tmp_path / "workcell").rglob("*.toml"))
    copy.write_text(copy.read_text().replace("mass = 10.0", "mass = 9.0"))
    folder_refused("changed-workcell", "--overwrite", execution)
    shutil.rmtree(tmp_path / "workcell")
    with open_folder(SETTINGS, execution, load(RACK)) as folder:
        assert folder.workcell.digest == load(RACK).digest


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
    with pytest.raises(ResultsError, match=r"polish\.json"):
        run(tmp_path, Stage("polish", noting([], "polish")))


def test_a_stage_of_other_settings_is_refused(tmp_path: Path) -> None:
    ran: list[str] = []
    run(tmp_path, Stage("polish", noting(ran, "polish"), {"attempts": 20}))
    with refused(ResultsError, "another-stage-setting", "'polish'", "20", "30"):
        run(tmp_path, Stage("polish", noting(ran, "polish"), {"attempts": 30}))
    assert ran == ["polish"]
