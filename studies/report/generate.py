"""Writes a report into a results folder: figures, tables and the page."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from hybrid_opt.store.files import storing, write_atomically
from hybrid_opt.timing import TimingModel
from hybrid_opt.work.children import in_children
from studies.report.figures import ReportFigure, report_figures
from studies.report.page import render_page
from studies.report.page_data import PageData
from studies.report.records import ReportData
from studies.report.style import save
from studies.report.tables import report_tables

PAGE = "report.html"
FIGURES = "figures"
TABLES = "tables"


def write_report(
    root: Path,
    data: ReportData,
    with_paper: bool,
    done: Callable[[], None] = lambda: None,
    jobs: int = 1,
) -> Path:
    """Write all files of the report; returns the page.

    Args:
        root: the results folder.
        data: from `studies.report.data.gather`.
        with_paper: whether figures that the paper states of its rack stand beside ours.
        done: called after every figure and after the page.
        jobs: processes that draw, 0 for one per core.

    Raises:
        ResultsError: the folder cannot be written.
        ReportError: the page cannot be made.
    """
    folder = root / FIGURES
    with storing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        figures = list(report_figures(data))
        files = in_children([partial(_drawn, figure, folder) for figure in figures], jobs, done)
    pictures = [(path, figure.caption) for path, figure in zip(files, figures, strict=True)]
    tables = report_tables(data, with_paper)
    for table in tables:
        for suffix, text in (
            ("csv", table.csv()),
            ("md", table.markdown()),
            ("tex", table.latex()),
        ):
            write_atomically(root / TABLES / f"{table.name}.{suffix}", text.encode())
    document = PageData(data, TimingModel(data.workcell)).document()
    page = root / PAGE
    write_atomically(page, render_page(data, document, tables, pictures).encode())
    done()
    return page


def _drawn(figure: ReportFigure, folder: Path) -> Path:
    """Draw a figure into its files; returns the PNG."""
    return save(figure.draw(), folder, figure.name)[0]
