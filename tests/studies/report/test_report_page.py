"""The page's text: self-contained, safe with hostile names, small, complete."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import hybrid_opt as ho
from hybrid_opt.branches import BranchCompetition, PairResult
from hybrid_opt.campaign.stages import ReadyCell, cells_of, ready_cells
from hybrid_opt.cell import Cell
from hybrid_opt.display.table import NOTHING
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES, PAPER_OBJECTIVES
from hybrid_opt.indicators.metrics import BindingBound
from hybrid_opt.job.plan import JobModel
from hybrid_opt.timing.jerk import driven_timing
from studies.report import PAGE, generate, page_carries, page_data
from studies.report.data import ReportData
from studies.report.generate import report_tables, write_report
from studies.report.page_carries import PageTrajectory, page_trajectory
from studies.report.page_data import page_document
from studies.study import tables
from studies.study.answer import answer
from symbolic.array import Array
from symbolic.contact.elastic import free_shift
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell
from symbolic.records.task import initial_decision
from tests.conftest import Once
from tests.symbolic.cells import RACK

HOSTILE = "</title></script><script>window.broken = 1</script><img src=x onerror=alert(1)>\"'&"
WINNER = PairResult((2, 0), 2, 120, 0.5, 0.4, 0.6)
SECOND = PairResult((1, 1), 1, 80, 0.2, 0.3, 0.7)
SHORT = '<b>&"</script>'
MAX_BYTES = 6_000_000


def test_paths_of_few_waypoints_have_jobs_in_a_cell_of_more() -> None:
    workcell = load(RACK)
    cells = ready_cells(cells_of(collect_cell(workcell), PAPER_OBJECTIVES, driven=False))
    assert cells[-1].cell.workcell.task.n_path > workcell.task.n_path
    x, limits = initial_decision(workcell.task), ho.TimingLimits(reference_speed=True)
    job = page_carries.drawn_job("hand-made", x, limits, cells).job
    assert job is not None
    samples, carried = page_carries.job_samples(job), job.phase("carry")
    path = cells[0].cell.carry(x).pose[:, :3]
    far = np.linalg.norm(samples[:, None, 1:4] - path, axis=2).min(axis=1)
    during = np.abs(samples[:, 0] - carried.begin - carried.duration / 2) <= carried.duration / 2
    # The nearest of the path's samples is at most half a step away.
    assert far[during].max() < 0.6 * np.linalg.norm(np.diff(path, axis=0), axis=1).max()


def with_hostile_names(data: ReportData) -> ReportData:
    """The same report of a cell whose every name is markup."""
    first, second = data.workcell.robots
    robots = (replace(first, name=HOSTILE), replace(second, name=f"{HOSTILE}2"))
    workcell = replace(data.workcell, name=HOSTILE, robots=robots)
    algorithms = tuple(replace(entry, title=SHORT) for entry in data.algorithms)
    initial = replace(data.initial, label=SHORT)
    changed = replace(data, workcell=workcell, algorithms=algorithms, initial=initial)
    return replace(changed, branches=BranchCompetition((WINNER, SECOND), 200, "constant"))


def hostile_page(memoise: Once, data: ReportData) -> Path:
    """The page of such a cell, with few trajectories and pictures of one point."""

    def make(folder: Path) -> None:
        point = BytesIO()
        Image.new("RGB", (1, 1)).save(point, "PNG")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(page_data, "MAX_FRONT", 2)
            patch.setattr(page_data, "MAX_DRIVEN", 2)
            patch.setattr(generate, "files_of", lambda *_: {"png": point.getvalue()})
            write_report(folder, with_hostile_names(data), with_paper=True, pdf=False)

    return memoise("hostile", make) / PAGE


@pytest.fixture(scope="module")
def text(report: Path) -> str:
    return report.read_text("utf-8")


class Elements(HTMLParser):
    """Collects start tags and the content of scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self._script: dict[str, str | None] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._script = dict(attrs) if tag == "script" else None

    def handle_data(self, data: str) -> None:
        if self._script is not None and "type" not in self._script:
            self.scripts.append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag == "script":
            self._script = None


def test_the_page_is_small_and_loads_nothing_from_elsewhere(report: Path, text: str) -> None:
    assert report.stat().st_size < MAX_BYTES
    for tag, attributes in Elements(text).tags:
        for name in ("src", "href", "srcset", "data", "action"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:image/png;base64,"), (tag, name)


def test_the_policy_allows_exactly_the_pages_scripts(text: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)
    assert policy is not None
    assert "default-src 'none'" in policy[1]
    assert "unsafe-eval" not in policy[1]
    (boot,) = Elements(text).scripts
    blocks = re.findall(r"<script type='application/gzip'>([^<]+)</script>", text)
    scripts = [boot.encode(), *(gzip.decompress(base64.b64decode(block)) for block in blocks)]
    hashes = [base64.b64encode(hashlib.sha256(s).digest()).decode() for s in scripts]
    allowed = re.findall(r"'sha256-([^']+)'", policy[1])
    assert allowed == hashes
    assert len(scripts) == 5


def test_hostile_names_stay_text(memoise: Once, data: ReportData, text: str) -> None:
    hostile = hostile_page(memoise, data).read_text("utf-8")
    assert HOSTILE not in hostile
    assert html.escape(HOSTILE) in hostile
    competition = str(with_hostile_names(data).branches)
    assert html.escape(competition[1:]) in hostile
    assert "branches" not in text
    clean, found = Elements(text), Elements(hostile)
    assert found.scripts == clean.scripts
    count = [sum(tag == "img" for tag, _ in elements.tags) for elements in (clean, found)]
    assert count[0] == count[1]


@pytest.fixture(scope="module")
def document(text: str) -> dict[str, Any]:
    """What the scripts of the study's page show."""
    (block,) = re.findall(r"id='report-data'>([^<]+)<", text)
    found: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(block)))
    return found


def samples(motion: dict[str, Any]) -> Array:
    """(k, 23) samples of a motion of two arms of six joints."""
    return np.frombuffer(base64.b64decode(motion["data"]), "<f4").reshape(-1, 23)


def points(view: dict[str, Any]) -> list[dict[str, Any]]:
    """The traces of a picture whose points show trajectories."""
    return [trace for trace in view["data"] if "customdata" in trace]


def test_data_of_the_page_are_the_trajectories(data: ReportData, document: dict[str, Any]) -> None:
    front = data.algorithms[0].shown.front
    view = document["views"][1]
    group = points(view)[0]
    assert len(group["customdata"]) == len(front)
    np.testing.assert_allclose(group["x"], front.objectives[:, 0])
    first = document["trajectories"][group["customdata"][0]]
    np.testing.assert_allclose(first["objectives"], front.objectives[0], rtol=1e-12)
    shown = samples(first["motions"][-1])
    # The objectives are the peaks over the reference forces, and the page keeps the peaks.
    peaks = shown[:, 19:21].max(axis=0) / data.workcell.task.reference_force
    np.testing.assert_allclose(peaks, front.objectives[0], rtol=1e-6)
    np.testing.assert_allclose(shown[0, 1:7], data.workcell.task.waypoints[0].lower, atol=1e-6)
    assert np.all(np.diff(shown[:, 0]) > 0.0)
    assert len(shown) <= 70
    best = data.solved[0].best
    assert best is not None
    name = f"{best.label}, replica {front.replica}: least force: "
    assert sum(one["label"].startswith(name) for one in document["trajectories"]) == 1


def test_points_of_fronts_are_what_jobs_drive_and_press(
    data: ReportData, document: dict[str, Any], text: str
) -> None:
    """Timed within limits on jerk and pressed as their jobs are, planned here one by one."""
    assert data.drivable is not None
    cell = Cell(data.drivable.workcell, DRIVABLE_OBJECTIVES)
    allowed = cell.workcell.task.reference_force.max()
    view = document["views"][0]
    assert view["layout"]["shapes"][0]["x0"] == allowed
    numbers = [k for group in points(view) for k in group["customdata"]]
    assert len(numbers) == len(set(numbers)), "one marker a point"
    model, shown = JobModel(cell.compiled, cell.timing_model), document["trajectories"]
    group = next(g for g in points(view) if g["name"] == data.drivable.solved[0].title)
    assert group["x"] == sorted(group["x"])
    for k in (0, len(group["customdata"]) - 1):
        found = shown[group["customdata"][k]]
        x = np.array(found["decision"])
        job = model.plan(driven_timing(cell.timing_model, x))
        assert (group["x"][k], group["y"][k]) == (found["commanded"], found["duration"])
        # A job's carry takes whole ticks.
        assert found["duration"] == pytest.approx(job.phase("carry").duration, abs=0.01)
        assert found["commanded"] == pytest.approx(job.squeeze.force, rel=2e-3)
        assert found["planned"] < found["commanded"]
        assert found["beyond"] == (found["commanded"] > 1.001 * allowed)
        assert ("reference force" in found["label"]) == found["beyond"]
        assert "export" in found["jobProblem"]
    # The front that is drawn has the star on it, as its job drives it.
    choice = data.summary.recommendation
    assert choice is not None
    (star,) = (g for g in points(view) if g["name"] == "Recommended")
    assert star["x"][0] == pytest.approx(choice.force, abs=1e-3)
    assert star["y"][0] == pytest.approx(choice.duration, abs=1e-5)
    front = next(trace for trace in view["data"] if trace["name"] == "front")
    assert (star["x"][0], star["y"][0]) in zip(front["x"], front["y"], strict=True)
    assert np.all(np.diff(front["x"]) > 0.0)
    assert np.all(np.diff(front["y"]) < 0.0)
    assert [job.label for job in data.jobs] == ["recommended", "hand-made"]
    assert not any(job.problem for job in data.jobs)


def test_what_is_commanded_is_never_less_than_what_is_needed(document: dict[str, Any]) -> None:
    whole = document["trajectories"][document["first"]]["motions"][1]
    assert "whole job" in whole["name"]
    table = samples(whole)
    assert np.all(np.diff(table[:, 0]) > 0.0)
    commanded, every, described = table[:, 20], table[:, 21], table[:, 22]
    held = np.isfinite(every)
    assert 0 < held.sum() < len(table), "the box stands before and after"
    assert (commanded[held] >= every[held] * (1.0 - 1e-5)).all()
    assert (every[held] >= described[held] * (1.0 - 1e-5)).all()
    assert commanded.max() == pytest.approx(whole["peaks"][1], abs=1e-3)


def test_without_the_papers_pictures_the_page_has_the_recommended_carry_alone(
    data: ReportData, tmp_path: Path
) -> None:
    brief = replace(data, reach=None)
    names = [picture.name for picture in generate.report_pictures(brief)]
    assert names == ["duration_against_force", "motion_recommended", "robust_price"]
    document = page_document(brief, paper=False)
    assert [group["label"] for group in document["lists"]][-1] == "Hand-made"
    assert len(document["views"]) == 1
    page = generate.render_page(brief, document, report_tables(brief, False), [""] * len(names))
    assert "dual-arm-carry report . --paper" in page
    assert "Table 1. " in page


def test_points_are_named_by_what_was_minimised(data: ReportData) -> None:
    cell = Cell(data.workcell, ("mean_force", "friction_use"))
    ready = ReadyCell(cell, JobModel(cell.compiled, cell.timing_model))
    shown = PageTrajectory("NSGA-II, replica 1", data.initial.x)
    trajectory = page_trajectory((ready,), shown)
    mean, friction = trajectory["objectives"]
    assert trajectory["label"] == (
        f"NSGA-II, replica 1: mean force {mean:.4f}, friction use {friction:.4f}"
    )


def test_the_page_begins_with_the_recommended_carry(
    data: ReportData, document: dict[str, Any], text: str
) -> None:
    found = data.summary.recommendation
    assert found is not None
    first = document["trajectories"][document["first"]]
    assert first["label"].startswith("Recommended")
    # A job's carry takes whole ticks.
    assert first["motions"][0]["duration"] == pytest.approx(found.duration, abs=0.01)
    assert f" {found.force:.1f} N" in first["label"]
    opening = answer(found, "")
    for fact in (*opening.facts, *opening.commands, *opening.details):
        assert html.escape(fact.text) in text
    assert html.escape(opening.headline) in text


def test_tables_of_carries_have_the_recommended_one(data: ReportData) -> None:
    tables = {table.name: table for table in report_tables(data, with_paper=False)}
    found = data.summary.recommendation
    assert found is not None
    margins = tables["margins"]
    assert margins.header[-1] == "recommended"
    rooms = [row for row in margins.rows if row[0].startswith("room left for the pressure of")]
    assert len(rooms) == 2
    assert all(row[0].endswith(" [mm]") for row in rooms)
    patch = data.workcell.contacts[0]
    assert [float(row[1]) for row in rooms] == [pytest.approx(1e3 * free_shift(patch))] * 2
    # No pad lifts off; a carry that turns the payload shifts the pressure, others need not.
    left = np.array([[float(entry.split()[0]) for entry in row[1:]] for row in rooms])
    assert (left > 0.0).all()
    assert (left <= left[:, :1]).all()
    assert (left < left[:, :1]).any()
    for name in ("table2_selected", "time_against_force", "jerk", "timing", "phases"):
        assert any(row[0].startswith("recommended") for row in tables[name].rows), name
    (row,) = (row for row in tables["jerk"].rows if row[0] == "recommended")
    assert row[1:4] == ("1", f"{found.without_jerk:.3f}", f"{found.duration:.3f}")
    assert found.without_jerk < found.duration


def test_the_first_look_is_not_squashed(document: dict[str, Any], data: ReportData) -> None:
    for view in document["views"]:
        for first, whole in zip(view["first"], view["whole"], strict=True):
            assert whole[0] <= first[1]
            assert first[1] - first[0] <= whole[1] - whole[0] + 1e-9
    # All the searches' fronts are in sight.
    (low, high), _ = document["views"][1]["first"]
    for algorithm in data.solved:
        inside = algorithm.shown.front.objectives[:, 0]
        assert low <= inside.min() <= inside.max() <= high


def test_polished_fronts_stand_beside_the_searchs(
    hybrid_data: ReportData, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = {"label": "", "commanded": 1.0, "duration": 1.0, "beyond": False}
    monkeypatch.setattr(page_data, "page_trajectory", lambda *_: named)
    groups = points(page_document(hybrid_data)["views"][1])
    assert [group["name"] for group in groups] == [
        f"{title}{stage}" for title in ("NSGA-II", "MOPSO") for stage in ("", ", polished")
    ]
    hybrid = hybrid_data.algorithms[0].shown.hybrid
    assert hybrid is not None
    assert len(groups[1]["customdata"]) == len(hybrid)


def test_every_file_of_the_report_is_written(data: ReportData, report: Path, text: str) -> None:
    drawn, folder = report.parent / "figures", report.parent / "tables"
    pictures = {path.stem for path in drawn.glob("*.png")}
    assert pictures == {path.stem for path in drawn.glob("*.pdf")}
    assert text.count("<figure>") == len(pictures)
    found = {table.name: table for table in report_tables(data, with_paper=False)}
    suffixes = ("csv", "md", "tex")
    assert {path.name for path in folder.iterdir()} == {
        f"{name}.{suffix}" for name in found for suffix in suffixes
    }
    assert set(found) >= {"table1_quality", "robust_price", "bounds", "margins"}
    for table in found.values():
        assert table.rows
        assert all(len(row) == len(table.header) for row in table.rows)


def test_the_bounds_that_matter_are_listed(data: ReportData) -> None:
    def bound(k: int) -> BindingBound:
        return BindingBound(f"waypoint {k}", "upper", 0.1, k)

    many = replace(data.summary.bounds, solutions=40, binding=tuple(map(bound, range(1, 21))))
    rows = tables.bounds(many).rows
    assert [row[3] for row in rows[:2]] == ["20 of 40", "19 of 40"]
    assert len(rows) == tables.MOST_BOUNDS + 1
    assert rows[-1][::2] == ("search", NOTHING)
    assert " 12 " in rows[-1][1]
    assert rows[-1][3].endswith(" 12 of 40")
