"""Writes a report into a results folder: pictures, tables and the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hybrid_opt.campaign.results import read_summary
from hybrid_opt.display.table import Table, counted
from hybrid_opt.store.files import write_atomically
from hybrid_opt.work.service import Emit, Executor, SerialExecutor, Service, answer_all
from studies.errors import ReportError
from studies.report.data import ReportData
from studies.report.jobs import phases
from studies.report.page import render_page
from studies.report.page_data import page_document
from studies.report.pictures import ReportPicture, report_pictures
from studies.report.stage import PAGE, PICTURES, TABLES
from studies.report.style import files_of
from studies.study.tables import margins, study_tables, timings

BEGIN = "<!-- measured: begin -->"
END = "<!-- measured: end -->"
"""Between them the tables stand in a Markdown file."""


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
    document = page_document(data, executor)
    page = root / PAGE
    write_atomically(page, render_page(data, document, tables, pictures).encode())
    done()
    return page


def report_tables(data: ReportData, with_paper: bool) -> tuple[Table, ...]:
    """All tables of a report.

    Args:
        with_paper: whether figures that the paper states of its own rack stand beside ours.
    """
    beside = None if data.drivable is None or data.alone else data.drivable.summary
    found = list(study_tables(data.summary, beside, data.jerk, data.simulations, with_paper))
    robots = data.summary.robots
    found.append(timings(data.timings, robots))
    found += [phases(data.jobs, robots)] if data.jobs else []
    if any(timed.margins for _, timed in data.timings):
        found.append(margins(data.timings))
    return tuple(found)


def insert_tables(root: Path, document: Path) -> None:
    """Replace what stands between a Markdown file's markers by the report's Tables 1 and 2.

    Raises:
        ReportError: the file or its markers are missing.
        ResultsError: the folder has no report.
    """
    summary = read_summary(root)
    settings, machine = summary.settings, summary.environment
    tables = [root / TABLES / f"{name}.md" for name in ("table1_quality", "table2_selected")]
    try:
        text = document.read_text("utf-8")
        parts = [table.read_text("utf-8").strip() for table in tables]
    except OSError as error:
        raise ReportError(f"{error.filename}: cannot be read ({error.strerror})") from error
    begin, end = text.find(BEGIN), text.find(END)
    if begin < 0 or end < begin:
        raise ReportError(f"{document}: needs the lines {BEGIN} and {END}")
    head = (
        f"{summary.workcell.name}: {counted(settings.replicas, 'replica')} of "
        f"{settings.evaluations} evaluations, seed {settings.seed}; Python "
        f"{machine['python']}, CasADi {machine['casadi']}, Pinocchio {machine['pin']}, pymoo "
        f"{machine['pymoo']}."
    )
    body = "\n\n".join([BEGIN, head, *parts])
    document.write_text(f"{text[:begin]}{body}\n\n{text[end:]}", "utf-8")


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
