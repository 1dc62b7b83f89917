"""The report's tables: figures of the summary."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.display.table import NOTHING, Table
from hybrid_opt.indicators.metrics import BindingBound
from studies.errors import ReportError
from studies.report.data import ReportData
from studies.report.generate import BEGIN, END, insert_tables, report_tables
from studies.study import tables


def named(tables: tuple[Table, ...], name: str) -> Table:
    return next(table for table in tables if table.name == name)


def test_table_1_repeats_the_summary(data: ReportData, study: Path) -> None:
    table = named(report_tables(data, with_paper=False), "table1_quality")
    summary = json.loads((study / "summary.json").read_text())
    assert [row[0] for row in table.rows] == ["NSGA-II", "MOPSO"]
    for row, name in zip(table.rows, ("nsga2", "mopso"), strict=True):
        statistics = summary["algorithms"][name]["statistics"]
        share = statistics["feasible_share"]
        assert row[2] == f"{100 * share['mean']:.1f} ± {100 * share['std']:.1f}"
        volume = [entry["hypervolume"] for entry in summary["algorithms"][name]["replicas"]]
        assert row[4] == f"{np.mean(volume):.4f} ± {np.std(volume, ddof=1):.4f}"


def test_table_2_shows_the_selected_trajectories(data: ReportData, study: Path) -> None:
    table = named(report_tables(data, with_paper=False), "table2_selected")
    summary = json.loads((study / "summary.json").read_text())
    rows = {row[0]: row for row in table.rows}
    for title, name in (("NSGA-II", "nsga2"), ("MOPSO", "mopso")):
        entry = summary["algorithms"][name]
        chosen = entry["replicas"][entry["representative"]]["selected"]
        expected = [*chosen["minimum_normal_force"], *chosen["peak_normal_force"]]
        assert rows[title][1:5] == tuple(f"{force:.2f}" for force in expected)
        assert rows[title][7] == f"{chosen['payload_limit']:.2f}"
    # A level box at rest needs m g / (2 mu) of each pad.
    assert rows["level payload at rest"][1] == f"{8.0 * 9.81 / 1.6:.2f}"


def test_the_papers_figures_are_those_that_it_states(data: ReportData) -> None:
    with_paper, without = (report_tables(data, with_paper=flag) for flag in (True, False))
    quality = {row[0]: row for row in named(with_paper, "table1_quality").rows}
    assert quality["NSGA-II, paper"][1:] == ("694", "69.4", *[NOTHING] * 4)
    assert quality["MOPSO, paper"][1:] == ("296", "29.6", *[NOTHING] * 4)
    chosen = {row[0]: row for row in named(with_paper, "table2_selected").rows}
    assert chosen["NSGA-II, paper"][7] == "16.71"
    assert chosen["MOPSO, paper"][7] == "16.06"
    assert not any("paper" in row[0] for table in without for row in table.rows)


def test_words_begin_at_the_left_and_figures_end_at_the_right(data: ReportData) -> None:
    timing = named(report_tables(data, with_paper=False), "timing")
    assert timing.words == (True, *[False] * 6, True, True)
    assert tables.bounds(data.summary.bounds).words[1]


def test_the_bounds_that_matter_are_listed(data: ReportData) -> None:
    def bound(k: int) -> BindingBound:
        return BindingBound(f"waypoint {k}", "upper", 0.1, k)

    many = replace(data.summary.bounds, solutions=40, binding=tuple(map(bound, range(1, 21))))
    rows = tables.bounds(many).rows
    assert [row[3] for row in rows[:2]] == ["20 of 40", "19 of 40"]
    assert len(rows) == tables.MOST_BOUNDS + 1
    assert rows[-1] == ("search", "and 12 further bounds", NOTHING, "at most 12 of 40")


def test_every_row_fits_its_header(data: ReportData) -> None:
    for table in report_tables(data, with_paper=True):
        assert all(len(row) == len(table.header) for row in table.rows)
        assert len(table.rows) > 0


def test_an_algorithm_without_a_feasible_candidate_is_told(data: ReportData) -> None:
    failed = replace(data.summary.algorithms["nsga2"], representative=None)
    algorithms = {**data.summary.algorithms, "nsga2": failed}
    table = tables.selected(replace(data.summary, algorithms=algorithms), with_paper=False)
    rows = [row[0] for row in table.rows]
    assert rows[:3] == ["hand-made", "NSGA-II: no feasible candidate", "MOPSO"]


def test_tables_are_put_between_the_markers_of_a_document(
    data: ReportData, own_study: Path, tmp_path: Path
) -> None:
    document = tmp_path / "page.md"
    document.write_text(f"before\n{BEGIN}\nformer tables\n{END}\nafter\n")
    folder = own_study / "tables"
    folder.mkdir(exist_ok=True)
    for table in report_tables(data, with_paper=True):
        (folder / f"{table.name}.md").write_text(table.markdown())
    insert_tables(own_study, document)
    text = document.read_text()
    assert text.startswith(f"before\n{BEGIN}\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "former tables" not in text
    assert "| NSGA-II, paper | 694 | 69.4 |" in text
    insert_tables(own_study, document)
    assert document.read_text() == text


def test_a_document_without_markers_is_refused(own_study: Path, tmp_path: Path) -> None:
    (own_study / "tables").mkdir(exist_ok=True)
    for name in ("table1_quality", "table2_selected"):
        (own_study / "tables" / f"{name}.md").write_text("x")
    document = tmp_path / "page.md"
    document.write_text("no markers")
    with pytest.raises(ReportError, match="measured: begin"):
        insert_tables(own_study, document)
