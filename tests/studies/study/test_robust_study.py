"""A study whose limits are about robust forces: from search and polish to what is run and shown."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.campaign.settings import UNION
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import ROBUST_DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.progress import Progress
from hybrid_opt.recommending.recommendation import level_force
from hybrid_opt.robust.force import robust_model
from hybrid_opt.store.trajectory_file import read_trajectory, replay
from hybrid_opt.timing.jerk import driven_timing
from studies.programs.study import StudySettings, run_study
from studies.report.data import ReportData, gather
from studies.report.generate import report_tables
from studies.report.page_data import page_document
from studies.report.pictures_fronts import duration_against_force
from studies.study.recommendation import FRONT, StoredRecommendation
from studies.study.summary import read_summary
from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, drivable_files, unpack_cell
from symbolic.records import Workcell
from tests.symbolic.read.samples import RACK

pytestmark = pytest.mark.slow  # a whole study of one cell more

FRICTION, MASS = 0.08, 0.05
MORE = (1.0 + MASS) / (1.0 - FRICTION)
"""What such a set asks for at rest, over the planned force."""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Results folder of the rack, one replica, and what is printed."""
    folder = tmp_path_factory.mktemp("robust")
    driven = unpack_cell(drivable_files(collect_cell(load(RACK))), folder / "cell").source
    text, _ = driven.read_text().split("[uncertainty]")
    driven.write_text(f"{text}[uncertainty]\nfriction = {FRICTION}\nmass = {MASS}\n")
    settings = CampaignSettings(
        algorithms={"nsga2": {}},
        objectives=ROBUST_DRIVABLE_OBJECTIVES,
        evaluations=120,
        replicas=1,
        seed=3,
    )
    short = PolishSettings(
        attempts=2, drivable=DrivableSettings(first_rounds=2, rounds=2, members=2)
    )
    execution, silent = ExecutionSettings(folder / "results", jobs=1), Progress(shown=False)
    wanted = StudySettings(polish=short, report=False)
    told = run_study(load(driven), settings, execution, silent, wanted)
    return folder / "results", told


@pytest.fixture(scope="module")
def data(study: tuple[Path, str]) -> ReportData:
    """What a report of it shows."""
    return gather(read_campaign(study[0]))


def recommended(root: Path) -> StoredRecommendation:
    found = read_summary(root).recommendation
    assert found is not None
    return found


def robust_peak(workcell: Workcell, carry: Carry) -> Array:
    return robust_model(workcell).robust_force(carry).peak


def test_one_experiment_is_searched_and_polished(study: tuple[Path, str]) -> None:
    root, _ = study
    results = read_campaign(root)
    assert results.objectives == ROBUST_DRIVABLE_OBJECTIVES
    assert not (root / "drivable").exists()
    front = results.polished(UNION)
    assert front is not None
    assert front.polished is not None
    assert front.polished.polished.any()
    reference = results.workcell.task.reference_force
    for k in range(0, len(front.x), max(1, len(front.x) // 3)):
        carry, force = results.cell.carry(front.x[k]), front.objectives[k, 1]
        most = (robust_peak(results.workcell, carry) / reference).max()
        # The carry is sampled at the task's samples, the objective is of the whole path, and forces
        # of pads that press evenly have sharp peaks.
        assert 0.97 * force < most <= force * (1.0 + 5e-3)
        assert most > 1.05 * (carry.peak_normal_force / reference).max()


def test_what_is_recommended_holds_in_every_case_within_its_limit(
    study: tuple[Path, str], tmp_path: Path
) -> None:
    root, printed = study
    found = recommended(root)
    stored = read_trajectory(root / found.file)
    assert stored.objectives == ROBUST_DRIVABLE_OBJECTIVES
    cell = stored.open_cell(tmp_path / "cell")
    carry = driven_timing(cell.timing_model, stored.x).carry
    assert carry is not None
    assert replay(stored, stored.open_cell(tmp_path)).reproduced
    assert found.robust_force is not None
    peak = robust_peak(cell.workcell, carry)
    np.testing.assert_allclose(found.robust_force, peak, rtol=1e-6)
    # Limits on jerk, and others, may leave any share of it.
    assert peak.max() <= found.force_limit * (1.0 + 5e-3)
    # A job's carry takes whole ticks.
    assert carry.duration == pytest.approx(found.duration, abs=0.01)
    assert peak.max() > 1.1 * max(found.peak_force)
    # Of the arm that is commanded; smoothing adds to that, nothing takes away.
    assert found.squeeze[1] >= peak[1] * (1.0 - 1e-6)
    assert "[uncertainty]" in found.squeeze_reason
    assert f" {found.force:.1f} N" in printed
    assert [part.name for part in found.parts] == ["least force", "friction", "mass"]


def test_the_table_begins_above_what_holds_still_in_every_case(study: tuple[Path, str]) -> None:
    root, _ = study
    results, table = read_campaign(root), recommended(root).durations
    level = level_force(results.workcell, results.cell.force_kind)
    assert level == pytest.approx(MORE * 49.05, rel=1e-4)
    assert min(table.forces) > level
    labels = [row.label for row in table.rows]
    assert labels == ["hand-made", "recommended", FRONT]
    hand_made, recommended_path, front = (np.array(row.durations) for row in table.rows)
    assert (front <= recommended_path * (1.0 + 1e-9)).all()
    assert (front <= hand_made * (1.0 + 1e-9)).all(), "it is among them"


def test_the_report_shows_robust_forces(data: ReportData) -> None:
    choice = data.summary.recommendation
    assert choice is not None
    axes = duration_against_force(data, choice).axes[0]
    assert re.search(r"commanded .*\[N\]", axes.get_xlabel())
    lines = {str(line.get_label()): np.asarray(line.get_xdata()) for line in axes.get_lines()}
    # Paths, front and what is recommended lie above what holds still.
    assert len(lines) >= 5
    assert min(values.min() for values in lines.values()) >= MORE * 49.05 * (1.0 - 1e-4)
    assert "time_against_force" in {table.name for table in report_tables(data, False)}
    page = page_document(data)
    (view,) = page["views"]
    named = {each["name"]: each for each in view["data"]}
    assert re.search(r"robust .*\[N\]", view["layout"]["xaxis"]["title"]["text"])
    group = named["Recommended"]
    assert choice.robust_force is not None
    assert group["x"][0] == pytest.approx(max(choice.robust_force), rel=5e-3)
    assert group["y"][0] == pytest.approx(choice.duration, abs=0.01)
    # Points of the fronts are driven as the search found them.
    assert data.drivable is not None
    _, front, _ = next(data.drivable.fronts())
    cell = Cell(data.drivable.workcell, data.objectives)
    for k in (0, len(front.x) - 1):
        point = page["trajectories"][named[front.title]["customdata"][k]]
        duration = cell.carry(front.x[k]).duration
        assert point["motions"][0]["duration"] == pytest.approx(duration, rel=1e-4)
        assert point["force"] <= 1.005 * front.x[k][-1]
