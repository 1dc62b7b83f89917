"""A small study of the second cell that the tests of the report share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings, Progress
from studies.report.data import gather
from studies.report.records import ReportData
from studies.run import StudySettings, run_study
from tests.symbolic.cells import ROOT

TRANSFER = ROOT / "studies" / "workcells" / "transfer.toml"


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder of two algorithms, two replicas and 120 evaluations each."""
    root = tmp_path_factory.mktemp("study") / "results"
    settings = CampaignSettings(evaluations=120, replicas=2, seed=3)
    execution, silent = ExecutionSettings(root, jobs=1), Progress(shown=False)
    run_study(TRANSFER, settings, execution, silent, StudySettings(report=False))
    return root


@pytest.fixture(scope="session")
def data(study: Path) -> ReportData:
    """What a report of that study shows."""
    return gather(study)


@pytest.fixture
def own_study(study: Path, tmp_path: Path) -> Path:
    """A copy of the study's folder that a test may change."""
    return Path(shutil.copytree(study, tmp_path / "results"))
