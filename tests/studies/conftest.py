"""A small study of the second cell that tests share."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.evaluate.objectives import non_dominated
from hybrid_opt.polishing.front import PolishedFront, PolishEffort
from studies.report import PAGE
from studies.report.data import ReportData, ReportRun, gather
from studies.study.simulation import StoredSimulation
from studies.study.summary import PolishedFigures, front_indicators
from tests.conftest import Once
from tests.symbolic.cells import ROOT

TRANSFER = ROOT / "studies" / "workcells" / "transfer.toml"

SMALL = ["--evaluations", "120", "--replicas", "2", "--seed", "3", "--jobs", "1", "--no-polish"]
SMALL += ["--paper"]
"""Options of the study."""

PRINTED = "printed.txt"


@pytest.fixture(scope="session")
def program_run(memoise: Once) -> tuple[Path, str]:
    """A small study by the program itself: its results folder and what it printed."""

    def run(folder: Path) -> None:
        folder.mkdir()
        command = [sys.executable, "-m", "studies.run", str(TRANSFER), *SMALL, "--output"]
        done = subprocess.run(
            [*command, str(folder / "results")], cwd=ROOT, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert "240 of 480" in done.stderr or "480 of 480" in done.stderr
        assert "left]" in done.stderr
        (folder / PRINTED).write_text(done.stdout, "utf-8")

    folder = memoise("study", run)
    return folder / "results", (folder / PRINTED).read_text("utf-8")


@pytest.fixture(scope="session")
def study(program_run: tuple[Path, str]) -> Path:
    """Results folder of two algorithms, two replicas and 120 evaluations each."""
    return program_run[0]


@pytest.fixture(scope="session")
def report(study: Path) -> Path:
    """The page of that study's report."""
    return study / PAGE


@pytest.fixture(scope="session")
def data(study: Path, memoise: Once) -> ReportData:
    """What a report of that study shows."""

    def make(folder: Path) -> None:
        folder.mkdir()
        (folder / "data").write_bytes(pickle.dumps(gather(read_campaign(study))))

    found: ReportData = pickle.loads((memoise("data", make) / "data").read_bytes())
    return found


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

    def polished(run: ReportRun) -> ReportRun:
        n = int(best.sum())
        rows, made = np.arange(n), np.ones(n, dtype=bool)
        done = PolishedFront(x[best], objectives[best], rows, made, (), 1.0, 1.0, "dense")
        hybrid = run.front.after(done)
        return replace(run, hybrid=hybrid, figures=replace(run.figures, polished=figures))

    chosen = data.algorithms[-1].best
    assert chosen is not None
    algorithms = tuple(
        replace(
            algorithm,
            runs=tuple(map(polished, algorithm.runs)),
            best=replace(chosen, look=algorithm.look),
        )
        for algorithm in data.algorithms
    )
    simulations = tuple(simulation(label) for label in (data.initial.label, "recommended"))
    return replace(data, algorithms=algorithms, simulations=simulations)


def simulation(label: str) -> StoredSimulation:
    """What a simulated cell might say of a carry: forces of 50 N, a hundredth off at most."""
    time = np.linspace(0.0, 2.0, 21)
    predicted = np.full((21, 2), 50.0)
    simulated = predicted + np.outer(np.sin(time), [0.5, -0.5])
    carry = StoredSimulation(
        label, "0", "leader", "", 2.0, slips=1.0, holds=1.004, pad=2, begins=0.5
    )
    carry = replace(carry, time=time, predicted=predicted, simulated=simulated)
    return replace(carry, robust=True, arrives=True, slip=1e-4, misses=2e-4)


@pytest.fixture
def own_study(study: Path, tmp_path: Path) -> Path:
    """A copy of the study's folder that a test may change."""
    return Path(shutil.copytree(study, tmp_path / "results"))
