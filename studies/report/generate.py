"""Writes a report into a results folder: pictures, tables and the page.

The page is one self-contained HTML file with data, pictures and libraries. Every text of the
workcell is escaped, data is JSON that no markup can leave, and a content security policy allows
exactly the page's own scripts (by their hashes) and no request at all.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import math
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Any

from PIL import Image

from hybrid_opt.display.scene import embedded_json, plotly_js, scene_js, three_js
from hybrid_opt.display.table import Table, counted, number
from hybrid_opt.robust.squeeze import PADS
from hybrid_opt.store.files import to_json, write_atomically
from hybrid_opt.timing.analysis import TimingDocument, stored_timing
from hybrid_opt.work.service import Executor, LocalExecutor, Service, answer_all, called
from studies.program import ReportError
from studies.report import PAGE, PICTURES, TABLES
from studies.report.data import ReportData
from studies.report.drawing import files_of
from studies.report.page_carries import RECOMMENDED_LABEL, phases
from studies.report.page_data import page_document
from studies.report.pictures import ReportPicture, report_pictures
from studies.study.summary import read_summary
from studies.study.tables import margins, study_tables, timings

BEGIN = "<!-- measured: begin -->"
END = "<!-- measured: end -->"
"""Marks around the tables in a Markdown file."""

COLOURS = 160
"""Colours of a picture on the page; its file's are reduced to them."""


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
    """
    listed = _listed(data)
    service: Service[Any, Any, dict[str, bytes]] = Service(partial(_listed, data), called)
    calls = [partial(_drawn, k, pdf) for k in range(len(listed))]
    drawn = answer_all(executor or LocalExecutor(), service, calls, lambda *_: done())
    pictures = []
    for picture, made in zip(listed, drawn, strict=True):
        for suffix, content in made.items():
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
    timed = [*data.timings, *_driven(data)]
    found.append(timings(timed, robots))
    found += [phases(data.jobs, robots)] if data.jobs else []
    if any(document.margins for _, document in timed):
        found.append(margins(timed))
    return tuple(found)


def _driven(data: ReportData) -> list[tuple[str, TimingDocument]]:
    """The recommended carry's timing, where it has one."""
    job = data.recommended_job
    if job is None or job.timing is None:
        return []
    found = {"as robots drive it": stored_timing(job.timing)}
    return [(RECOMMENDED_LABEL, TimingDocument(math.nan, found, job.margins, None))]


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


def _listed(data: ReportData) -> list[ReportPicture]:
    """All pictures, not yet drawn; a context of work, in any process."""
    return list(report_pictures(data))


def _drawn(index: int, pdf: bool, pictures: list[ReportPicture]) -> dict[str, bytes]:
    """Draw a picture; returns its files by suffix."""
    return files_of(pictures[index].draw(), pdf)


def render_page(
    data: ReportData,
    document: dict[str, Any],
    tables: tuple[Table, ...],
    pictures: list[tuple[Path, str]],
) -> str:
    """The page's text.

    Args:
        data: the report's data.
        document: what the scripts show, from `page_data`.
        tables: shown in this order.
        pictures: PNG file and caption of every figure.
    """
    texts = files("studies.report") / "page"
    boot, own = ((texts / name).read_text("utf-8") for name in ("boot.js", "page.js"))
    scripts = [plotly_js(), three_js(), scene_js(), own]
    shown = ("workcell", "settings", "environment")
    settings = {key: to_json(getattr(data.summary, key)) for key in shown}
    return Template((texts / "page.html").read_text("utf-8")).substitute(
        policy=_policy([boot, *scripts]),
        title=html.escape(data.workcell.name),
        lead=html.escape(_lead(data)),
        recommendation=_recommendation(data),
        facts=_facts(data),
        style=(texts / "page.css").read_text("utf-8"),
        tables="".join(table.html() for table in tables),
        pictures="".join(_picture(path, caption) for path, caption in pictures),
        configuration=html.escape(json.dumps(settings, indent=2, ensure_ascii=False)),
        workcell=html.escape(data.workcell.source.read_text("utf-8")),
        blocks="\n".join(
            [_block(embedded_json(document), " id='report-data'"), *map(_block, scripts)]
        ),
        boot=boot,
    )


def _block(text: str, attributes: str = "") -> str:
    """A compressed text that `boot.js` unpacks; the time of its making is left out."""
    content = base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
    return f"<script type='application/gzip'{attributes}>{content}</script>"


def _policy(scripts: list[str]) -> str:
    """Only these inline scripts; styles and pictures of the page itself; no request."""
    hashes = [
        base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts
    ]
    allowed = " ".join(f"'sha256-{value}'" for value in hashes)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def _lead(data: ReportData) -> str:
    payload, task = data.workcell.payload, data.workcell.task
    settings = data.summary.settings
    names = ", ".join(algorithm.title for algorithm in data.algorithms)
    branches = "" if data.branches is None else str(data.branches)
    chosen = f" {branches[0].upper()}{branches[1:]}." if branches else ""
    return (
        f"Two arms carry a box of {payload.mass:g} kg along {len(task.waypoints)} poses, "
        f"{len(task.free_indices)} of them free. {names}: "
        f"{counted(settings.replicas, 'replica')} of {settings.evaluations} evaluations each, "
        f"seed {settings.seed}.{chosen}"
    )


IN_FOLDER = {"file": "file, beside this page", "export": "export, from this folder"}
"""Headings of what names files, and how the page calls them, which moves with its folder."""


def _recommendation(data: ReportData) -> str:
    """The words that the terminal opens with, too."""
    words = data.summary.words("")
    if words is None:
        return ""
    told = [(heading, html.escape(text)) for heading, text in words.facts]
    facts = "".join(
        f"<dt>{html.escape(IN_FOLDER.get(heading, heading))}</dt>"
        f"<dd>{f'<code>{text}</code>' if heading in IN_FOLDER else text}</dd>"
        for heading, text in told
    )
    warnings = "".join(
        f"<p class='warning'>Warning: {html.escape(text)}</p>" for text in words.warnings
    )
    return (
        f"<section class='recommendation'><h2>{html.escape(words.headline)}</h2>"
        f"<dl>{facts}</dl>{warnings}</section>"
    )


def _facts(data: ReportData) -> str:
    facts = []
    still = data.summary.static_hold
    for algorithm in data.algorithms:
        if algorithm.best is None:
            facts.append(("none feasible", algorithm.title))
            continue
        peak = float(algorithm.best.timed.normal_force.max(axis=0).mean())
        rest = sum(still.normal_force) / 2.0
        facts.append(
            (f"{100.0 * (peak / rest - 1.0):z.2f} %", f"above the force at rest, {algorithm.title}")
        )
        limit = algorithm.best.sensitivity.payload_limit
        facts.append((f"{limit:.2f} kg", f"payload at the limit, {algorithm.title}"))
    facts.append((f"{number(still.payload_limit)} kg", "payload at the limit, at rest"))
    listed = "".join(
        f"<li><b>{html.escape(value)}</b><span>{html.escape(text)}</span></li>"
        for value, text in facts
    )
    return f'<ul class="facts">{listed}</ul><p>{html.escape(_assumed(data))}</p>'


def _assumed(data: ReportData) -> str:
    """Which pads the forces of both experiments are of."""
    said = f"The forces of this experiment are of {PADS[data.workcell.task.allocation]}."
    if data.drivable is None:
        return said
    return f"{said} What robots drive is of {PADS[data.drivable.workcell.task.allocation]}."


def _picture(path: Path, caption: str) -> str:
    with Image.open(path) as whole:
        small, made = whole.convert("RGB").quantize(COLOURS), BytesIO()
    small.save(made, "PNG", optimize=True)
    content = base64.b64encode(made.getvalue()).decode("ascii")
    text = html.escape(caption)
    return (
        f'<figure><img loading="lazy" decoding="async" alt="{text}" '
        f'width="{small.width}" height="{small.height}" '
        f'src="data:image/png;base64,{content}"><figcaption>{text}</figcaption></figure>'
    )
