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
import inspect
import json
import math
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from string import Template
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.display.scene import PLOTLY, THREE, asset, embedded_json
from hybrid_opt.display.table import Table, counted, number
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import to_json, write_atomically
from hybrid_opt.timing.analysis import TimingDocument, stored_timing
from hybrid_opt.workers import LocalWorkers, Workers
from studies.report import PAGE, PICTURES, TABLES, pictures_carry, pictures_cell, pictures_fronts
from studies.report.data import ReportData, gather
from studies.report.drawing import files_of, in_style, settled
from studies.report.opening import answer_html
from studies.report.page_carries import RECOMMENDED_LABEL, phases
from studies.report.page_data import page_document
from studies.report.pictures_cell import ReachMap
from studies.study.tables import margins, study_tables, timings
from symbolic.contact.registry import contact_model

PICTURE_COLOURS = 160
"""Number of colours to which a picture on the page is reduced; the picture's own file keeps all."""


@dataclass(frozen=True)
class ReportPicture:
    """One picture of the report.

    Attributes:
        name: name of the picture's files, without suffix.
        caption: one or two sentences of plain text.
        make: function that draws the figure; it sets no style.
    """

    name: str
    caption: str
    make: Callable[[], Figure]

    def draw(self) -> Figure:
        """Return the figure, drawn in the common style and with a fixed layout."""
        with in_style():
            return settled(self.make())


def _of(name: str, draw: Callable[..., Figure], *given: Any, caption: str = "") -> ReportPicture:
    """Return a picture of the report that is not drawn yet.

    Args:
        name: name of the picture's files, without suffix.
        draw: function that draws the figure.
        given: arguments of `draw`.
        caption: caption of the picture; '' for the docstring of `draw` without the word 'Draw'.
    """
    text = " ".join((caption or inspect.getdoc(draw) or "").removeprefix("Draw ").split())
    return ReportPicture(name, text[:1].upper() + text[1:], partial(draw, *given))


def report_pictures(data: ReportData) -> Iterator[ReportPicture]:
    """Yield all pictures for which a report has data.

    The pictures of the recommended carry come first, then the paper's pictures in the paper's
    order.
    """
    yield from _first_pictures(data)
    if data.reach is not None:
        yield from _paper_pictures(data, data.reach)


def _first_pictures(data: ReportData) -> Iterator[ReportPicture]:
    sequence, choice = pictures_cell.motion_sequence, data.summary.recommendation
    moments = "at 0, 33, 66 and 100 % of its duration"
    if choice is not None:
        draw = pictures_fronts.duration_against_force
        yield _of("duration_against_force", draw, data, choice)
    if (driven := data.recommended_carry) is not None:
        text = f"The recommended carry {moments}."
        yield _of(f"motion_{driven.label}", sequence, data.geometry, driven, caption=text)
    if choice is not None and choice.price is not None:
        found = choice.price.uncertainty
        text = (
            "The price of robustness: largest normal forces of the recommended carry that hold in "
            f"every case of a multiple of {found.title} ({found})."
        )
        yield _of("robust_price", pictures_carry.robust_price, data, choice.price, caption=text)
    if any(len(found.time) for found in data.simulations):
        yield _of("simulated_forces", pictures_carry.simulated_forces, data)


def _paper_pictures(data: ReportData, reach: ReachMap) -> Iterator[ReportPicture]:
    cell, arm = (data.geometry, reach, data.initial), data.workcell.robots[0].name
    arm = f"Collision shapes of the arm {arm!r}, and the reach of its pad (paper Figure 6)."
    yield _of("fig04_reachable_regions", pictures_cell.reachable_regions, *cell)
    yield _of("fig05_cell", pictures_cell.environment, data.geometry, data.initial)
    yield _of("fig06_arm", pictures_cell.arm_and_reach, *cell, caption=arm)
    if data.solved:
        yield from _search_pictures(data)
    yield _of("infeasibility", pictures_fronts.infeasibility, data)
    yield _of("fig09_normal_forces", pictures_carry.normal_forces, data)
    yield _of("fig10_joint_torques", pictures_carry.joint_torques, data)
    yield _of("fig11_pressure_shift", pictures_carry.pressure_shift, data)
    yield _of("residual_moments", pictures_carry.residual_moments, data)
    yield _of("fig12_payload", pictures_carry.payload, data)
    yield _of("fig13_paths", pictures_cell.paths, data.geometry, data.drawn)
    for algorithm in data.algorithms:
        if algorithm.best is not None:
            text = (
                f"The trajectory selected from {algorithm.best.label}, at 0, 33, 66 and 100 % of "
                "its duration (paper Figures 14 and 15)."
            )
            given = (data.geometry, algorithm.best)
            sequence = pictures_cell.motion_sequence
            yield _of(f"motion_{algorithm.name}", sequence, *given, caption=text)


def _search_pictures(data: ReportData) -> Iterator[ReportPicture]:
    objectives = len(data.objective_titles)
    if objectives >= 2:
        yield _of("fig07_fronts", pictures_fronts.fronts, data)
    yield _of("fig08_best_so_far", pictures_fronts.histories, data)
    if objectives == 2:
        yield _of("attainment", pictures_fronts.attainment, data)
    yield _of("indicators", pictures_fronts.indicators, data)
    if data.has_hybrid and objectives >= 2:
        yield _of("polish", pictures_fronts.polish, data)


def make_report(
    root: Path, settings: Mapping[str, bool], progress: Progress, workers: Workers
) -> None:
    """Write the report of a finished study into its results folder.

    Args:
        root: the results folder.
        settings: booleans under three names: `with_paper` and `pdf`, the arguments of
            `write_report`; and `paper`, True to draw the paper's pictures.
        progress: display of the progress.
        workers: processes that draw.

    Raises:
        DualArmError: the folder is not complete, or cannot be written.
    """
    own = {name: value for name, value in settings.items() if name != "paper"}
    data = gather(read_campaign(root), workers, settings["paper"])
    write_report(root, data, **own, progress=progress, workers=workers)


def write_report(
    root: Path,
    data: ReportData,
    with_paper: bool,
    pdf: bool = True,
    progress: Progress | None = None,
    workers: Workers | None = None,
) -> None:
    """Write all files of the report into a results folder: pictures, tables and the page.

    Args:
        root: the results folder.
        data: what the report shows.
        with_paper: True to add rows to tables with the values that the paper states for its own
            rack.
        pdf: True to write pictures as PDF too, which takes as long as drawing them.
        progress: display of the progress; None for none.
        workers: processes that draw; None for this process.

    Raises:
        ResultsError: the folder cannot be written.
    """
    pictures = _listed(data)
    draw = partial(_drawn, pickle.dumps(data), pdf)
    progress = progress or Progress(shown=False)
    with progress.stage("report", len(pictures) + 1, "pictures") as advance:
        drawn = (workers or LocalWorkers()).map(draw, range(len(pictures)), lambda *_: advance(1))
        for picture, made in zip(pictures, drawn, strict=True):
            for suffix, content in made.items():
                write_atomically(root / PICTURES / f"{picture.name}.{suffix}", content)
        tables = report_tables(data, with_paper)
        for table in tables:
            texts = {"csv": table.csv(), "md": table.markdown(), "tex": table.latex()}
            for suffix, text in texts.items():
                write_atomically(root / TABLES / f"{table.name}.{suffix}", text.encode())
        shown = zip(pictures, drawn, strict=True)
        page = render_page(
            data,
            page_document(data, workers, data.reach is not None),
            tables,
            [_picture(made["png"], picture.caption) for picture, made in shown],
        )
        write_atomically(root / PAGE, page.encode())
        advance(1)


FIRST_TABLES = ("time_against_force", "robust_price", "simulation", "phases")
"""Names of the tables about the recommended carry, which the page shows before those of the paper's
experiment."""


def report_tables(data: ReportData, with_paper: bool) -> tuple[Table, ...]:
    """Return all tables of a report: `study_tables`, and the tables of timings, job phases and
    margins.

    Args:
        data: what the report shows.
        with_paper: True to add rows with the paper's values.
    """
    beside = None if data.drivable is None or data.alone else data.drivable.summary
    found = list(study_tables(data.summary, beside, data.jerk, data.simulations, with_paper))
    robots = data.summary.robots
    timed, job = list(data.timings), data.job(RECOMMENDED_LABEL)
    if job is not None and job.timing is not None and job.timing.carry is not None:
        driven = {"as robots drive it": stored_timing(job.timing)}
        timed.append((job.label, TimingDocument(math.nan, driven, job.margins, None)))
    found.append(timings(timed, robots))
    found += [phases(data.jobs, robots)] if data.jobs else []
    if any(document.margins for _, document in timed):
        found.append(margins(timed))
    return tuple(found)


def _listed(data: ReportData) -> list[ReportPicture]:
    """Return all pictures of a report, not yet drawn."""
    return list(report_pictures(data))


def _drawn(data: bytes, pdf: bool, index: int) -> dict[str, bytes]:
    """Draw one picture of a report. Return the contents of its files by suffix.

    Args:
        data: data of the report, pickled.
        pdf: True for a PDF beside the PNG.
        index: index of the picture among those of `report_pictures`.
    """
    return files_of(_unpickled(data)[index].draw(), pdf)


@lru_cache(maxsize=1)
def _unpickled(data: bytes) -> list[ReportPicture]:
    return _listed(pickle.loads(data))


def render_page(
    data: ReportData, document: dict[str, Any], tables: Sequence[Table], pictures: Sequence[str]
) -> str:
    """Return the text of the report's HTML page.

    Args:
        data: what the report shows.
        document: JSON values for the page's scripts, from `page_data.page_document`.
        tables: all tables of the report.
        pictures: pictures as HTML, in the order of `report_pictures`.
    """
    texts = files("studies.report") / "page"
    boot, own = ((texts / name).read_text("utf-8") for name in ("boot.js", "page.js"))
    scripts = [asset(PLOTLY), asset(THREE), asset("scene.js"), own]
    shown = ("workcell", "settings", "environment")
    settings = {key: to_json(getattr(data.summary, key)) for key in shown}
    first = sum(1 for _ in _first_pictures(data))
    return Template((texts / "page.html").read_text("utf-8")).substitute(
        policy=_policy([boot, *scripts]),
        title=html.escape(data.workcell.name),
        lead=html.escape(_lead(data)),
        answer=answer_html(data),
        style=(texts / "page.css").read_text("utf-8"),
        first_tables=_tables(tables, of_paper=False),
        first_pictures="".join(pictures[:first]),
        paper=_paper_text(data),
        facts=_facts(data),
        tables=_tables(tables, of_paper=True),
        pictures="".join(pictures[first:]),
        configuration=html.escape(json.dumps(settings, indent=2, ensure_ascii=False)),
        workcell=html.escape(data.workcell.source.read_text("utf-8")),
        blocks="\n".join(
            [_block(embedded_json(document), " id='report-data'"), *map(_block, scripts)]
        ),
        boot=boot,
    )


def _tables(tables: Sequence[Table], of_paper: bool) -> str:
    chosen = (table for table in tables if (table.name not in FIRST_TABLES) == of_paper)
    return "".join(table.html() for table in chosen)


def _paper_text(data: ReportData) -> str:
    """Return a paragraph of HTML that says where the paper's pictures are, or which command draws
    them."""
    if data.reach is not None:
        return (
            "<p>The same pictures lie beside this page in the folder <code>figures</code>: as PNG "
            "and, but for a quick study, PDF.</p>"
        )
    command = "dual-arm-carry report . --paper"
    return (
        "<p>The paper's pictures, and the carries of its search on this page: "
        f"<code>{command}</code> in the folder of this page.</p>"
    )


def _block(text: str, attributes: str = "") -> str:
    """Return an HTML script element with a compressed text, which `boot.js` of the page unpacks.
    Equal texts give equal elements.

    Args:
        text: the text.
        attributes: further attributes of the element.
    """
    content = base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
    return f"<script type='application/gzip'{attributes}>{content}</script>"


def _policy(scripts: list[str]) -> str:
    """Return a content security policy that allows exactly these inline scripts, inline styles and
    embedded pictures, and no network requests."""
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
    """Return one sentence per experiment on the kind of contact that its forces assume."""
    said = f"The forces of this experiment are of {contact_model(data.workcell).assumption}."
    if data.drivable is None:
        return said
    return f"{said} What robots drive is of {contact_model(data.drivable.workcell).assumption}."


def _picture(png: bytes, caption: str) -> str:
    with Image.open(BytesIO(png)) as whole:
        small, made = whole.convert("RGB").quantize(PICTURE_COLOURS), BytesIO()
    small.save(made, "PNG", optimize=True)
    content = base64.b64encode(made.getvalue()).decode("ascii")
    text = html.escape(caption)
    return (
        f'<figure><img loading="lazy" decoding="async" alt="{text}" '
        f'width="{small.width}" height="{small.height}" '
        f'src="data:image/png;base64,{content}"><figcaption>{text}</figcaption></figure>'
    )
