"""Writes a report into a results folder: pictures, tables and the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hybrid_opt.store.files import write_atomically
from hybrid_opt.work.service import Emit, Executor, SerialExecutor, Service, answer_all
from studies.report.page import render_page
from studies.report.page_data import PageData
from studies.report.pictures import ReportPicture, report_pictures
from studies.report.records import ReportData
from studies.report.style import files_of
from studies.report.tables import report_tables

PAGE = "report.html"
PICTURES = "figures"
TABLES = "tables"


def write_report(
    root: Path,
    data: ReportData,
    with_paper: bool,
    pdf: bool = True,
    done: Callable[[], None] = lambda: None,
    executor: Executor | None = None,
) -> Path:
    """Write all files of the report; returns the page.

    Args:
        root: the results folder.
        data: from `studies.report.data.gather`.
        with_paper: whether figures that the paper states of its rack stand beside ours.
        pdf: whether pictures are also written as PDF, which takes as long as to draw them.
        done: called after every picture and after the page.
        executor: who draws, None for this process.

    Raises:
        ResultsError: the folder cannot be written.
        ReportError: the page cannot be made.
    """
    listed = list(report_pictures(data))
    service = Service(DrawingBoard(data, pdf), _drawn)
    drawn = answer_all(executor or SerialExecutor(), service, range(len(listed)), done)
    pictures = []
    for picture, files in zip(listed, drawn, strict=True):
        for suffix, content in files.items():
            write_atomically(root / PICTURES / f"{picture.name}.{suffix}", content)
        pictures.append((root / PICTURES / f"{picture.name}.png", picture.caption))
    tables = report_tables(data, with_paper)
    for table in tables:
        for suffix, text in (
            ("csv", table.csv()),
            ("md", table.markdown()),
            ("tex", table.latex()),
        ):
            write_atomically(root / TABLES / f"{table.name}.{suffix}", text.encode())
    document = PageData(data).document(executor)
    page = root / PAGE
    write_atomically(page, render_page(data, document, tables, pictures).encode())
    done()
    return page


@dataclass(frozen=True)
class DrawingBoard:
    """Makes the pictures of a report, in any process.

    Attributes:
        data: what they show.
        pdf: whether also as PDF.
    """

    data: ReportData
    pdf: bool

    def __call__(self) -> tuple[list[ReportPicture], bool]:
        """All pictures, not yet drawn, and whether they are wanted as PDF."""
        return list(report_pictures(self.data)), self.pdf


def _drawn(board: tuple[list[ReportPicture], bool], index: int, emit: Emit) -> dict[str, bytes]:
    """Draw a picture; returns its files by suffix."""
    pictures, pdf = board
    return files_of(pictures[index].draw(), pdf)
