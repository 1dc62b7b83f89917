"""A small study of the second cell that the tests of the report share."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.campaign.results import ReplicaFront, read_campaign
from hybrid_opt.indicators.metrics import non_dominated
from hybrid_opt.polishing.records import PolishEffort
from hybrid_opt.progress import Progress
from studies.programs.study import StudySettings, run_study
from studies.report.data import ReportData, Run, gather
from studies.study.simulation import StoredSimulation
from studies.study.summary import PolishedFigures, front_indicators
from symbolic.read.cell import load
from tests.symbolic.cells import ROOT

TRANSFER = ROOT / "studies" / "workcells" / "transfer.toml"


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder of two algorithms, two replicas and 120 evaluations each."""
    root = tmp_path_factory.mktemp("study") / "results"
    settings = CampaignSettings(evaluations=120, replicas=2, seed=3)
    execution, silent = ExecutionSettings(root, jobs=1), Progress(shown=False)
    run_study(load(TRANSFER), settings, execution, silent, StudySettings(report=False))
    return root


@pytest.fixture(scope="session")
def data(study: Path) -> ReportData:
    """What a report of that study shows."""
    return gather(read_campaign(study))


@pytest.fixture(scope="session")
def hybrid_data(data: ReportData) -> ReportData:
    """The same report as after a polish: every run's polished front is the best of all runs."""
    fronts = [run.front for algorithm in data.algorithms for run in algorithm.runs]
    x = np.concatenate([front.x for front in fronts])
    objectives = np.concatenate([front.objectives for front in fronts])
    best = non_dominated(objectives)
    effort = PolishEffort("dense", 1, {}, 1.0, 1.0, 1.0, 1, 0.5, 0.0, 0.0, 0.0)
    indicators = front_indicators(objectives[best], objectives[best], None, None)
    figures = PolishedFigures(**indicators, **vars(effort))

    def polished(run: Run) -> Run:
        of = run.front.algorithm, run.front.replica
        hybrid = ReplicaFront(*of, True, x[best], objectives[best])
        return replace(run, hybrid=hybrid, figures=replace(run.figures, polished=figures))

    algorithms = tuple(
        replace(algorithm, runs=tuple(map(polished, algorithm.runs)), best=data.algorithms[-1].best)
        for algorithm in data.algorithms
    )
    simulations = tuple(simulation(label) for label in (data.initial.label, "recommended"))
    return replace(data, algorithms=algorithms, simulations=simulations)


def simulation(label: str) -> StoredSimulation:
    """What a simulated cell might say of a carry: forces of 50 N, a hundredth off at most."""
    time = np.linspace(0.0, 2.0, 21)
    predicted = np.full((21, 2), 50.0)
    simulated = predicted + np.outer(np.sin(time), [0.5, -0.5])
    return StoredSimulation(
        label=label,
        trajectory="0",
        controller="leader",
        duration=2.0,
        slips=1.0,
        holds=1.004,
        pad=2,
        begins=0.5,
        problem="",
        robust=True,
        factor=1.0,
        arrives=True,
        slip=1e-4,
        misses=2e-4,
        time=time,
        predicted=predicted,
        simulated=simulated,
    )


@pytest.fixture
def own_study(study: Path, tmp_path: Path) -> Path:
    """A copy of the study's folder that a test may change."""
    return Path(shutil.copytree(study, tmp_path / "results"))
