"""The page's text: self-contained, safe with hostile names, small, complete."""

from __future__ import annotations

import base64
import hashlib
import html
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.timing import TimingModel
from studies.report.generate import write_report
from studies.report.page_data import PageData
from studies.report.records import ReportData

HOSTILE = "</title></script><script>window.broken = 1</script><img src=x onerror=alert(1)>\"'&"
SHORT = '<b>&"</script>'
MAX_BYTES = 15_000_000


def with_hostile_names(data: ReportData) -> ReportData:
    """The same report of a cell whose every name is markup."""
    first, second = data.workcell.robots
    robots = (replace(first, name=HOSTILE), replace(second, name=f"{HOSTILE}2"))
    workcell = replace(data.workcell, name=HOSTILE, robots=robots)
    algorithms = tuple(replace(entry, title=SHORT) for entry in data.algorithms)
    initial = replace(data.initial, label=SHORT)
    return replace(data, workcell=workcell, algorithms=algorithms, initial=initial)


@pytest.fixture(scope="module")
def report(data: ReportData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(
        tmp_path_factory.mktemp("report"), data, Cell(data.workcell), with_paper=True
    )


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


def test_the_page_is_small_enough(report: Path) -> None:
    assert report.stat().st_size < MAX_BYTES


def test_nothing_is_loaded_from_elsewhere(text: str) -> None:
    for tag, attributes in Elements(text).tags:
        for name in ("src", "href", "srcset", "data", "action"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:image/png;base64,"), (tag, name)


def test_the_policy_allows_exactly_the_pages_scripts(text: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', text)
    assert policy is not None
    assert "default-src 'none'" in policy[1]
    assert "unsafe-eval" not in policy[1]
    scripts = Elements(text).scripts
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    allowed = re.findall(r"'sha256-([^']+)'", policy[1])
    assert allowed == hashes
    assert len(scripts) == 4


def test_hostile_names_stay_text(data: ReportData, tmp_path: Path, text: str) -> None:
    hostile = write_report(
        tmp_path, with_hostile_names(data), Cell(data.workcell), with_paper=False
    ).read_text("utf-8")
    assert HOSTILE not in hostile
    assert html.escape(HOSTILE) in hostile
    clean, found = Elements(text), Elements(hostile)
    assert found.scripts == clean.scripts
    count = [sum(tag == "img" for tag, _ in elements.tags) for elements in (clean, found)]
    assert count[0] == count[1]


def test_data_of_the_page_are_the_trajectories(data: ReportData) -> None:
    document = PageData(data, TimingModel(data.workcell)).document()
    front = data.algorithms[0].shown.front
    group = document["groups"][0]
    assert len(group["members"]) == len(front)
    first = document["trajectories"][group["members"][0]]
    np.testing.assert_allclose(first["objectives"], front.objectives[0], rtol=1e-12)
    samples = np.frombuffer(base64.b64decode(first["data"]), "<f4").reshape(-1, 23)
    # The objectives are the peaks over the reference forces, and the page keeps the peaks.
    peaks = samples[:, 19:21].max(axis=0) / data.workcell.task.reference_force
    np.testing.assert_allclose(peaks, front.objectives[0], rtol=1e-6)
    start = data.workcell.task.waypoints[0].lower
    np.testing.assert_allclose(samples[0, 1:7], start, atol=1e-6)
    assert np.all(np.diff(samples[:, 0]) > 0.0)
    assert len(samples) <= 70


def test_polished_fronts_stand_beside_the_searchs(hybrid_data: ReportData) -> None:
    document = PageData(hybrid_data, TimingModel(hybrid_data.workcell)).document()
    labels = [group["label"] for group in document["groups"]]
    assert labels == [
        f"{title}: {stage}" for title in ("NSGA-II", "MOPSO") for stage in ("search", "polished")
    ]
    hybrid = hybrid_data.algorithms[0].shown.hybrid
    assert hybrid is not None
    assert len(document["groups"][1]["members"]) == len(hybrid)


def test_every_file_of_the_report_is_written(report: Path, text: str) -> None:
    figures = {path.stem for path in (report.parent / "figures").glob("*.png")}
    assert figures == {path.stem for path in (report.parent / "figures").glob("*.pdf")}
    assert text.count("<figure>") == len(figures)
    tables = sorted(path.name for path in (report.parent / "tables").iterdir())
    for name in ("table1_quality", "table2_selected", "timing", "margins"):
        assert [f"{name}.{suffix}" for suffix in ("csv", "md", "tex")] == [
            entry for entry in tables if entry.startswith(f"{name}.")
        ]
