"""The self-contained page: one HTML file with data, pictures and libraries, no network.

Every text of the workcell is escaped, data is JSON that no markup can leave, and a content
security policy allows exactly the page's own scripts (by their hashes) and no request at all.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from hybrid_opt.display.scene import embedded_json, scene_js, three_js
from hybrid_opt.display.table import Table, counted, number
from hybrid_opt.store.json_records import to_json
from studies.errors import ReportError
from studies.report.data import ReportData
from studies.study.recommendation import study_words


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

    Raises:
        ReportError: the installed plotly does not hold the script that the page embeds.
    """
    texts = files("studies.report") / "page"
    own = (texts / "page.js").read_text("utf-8")
    scripts = [plotly_js(), three_js(), scene_js(), own]
    shown = ("workcell", "settings", "environment")
    settings = {key: to_json(getattr(data.summary, key)) for key in shown}
    return Template((texts / "page.html").read_text("utf-8")).substitute(
        policy=_policy(scripts),
        title=html.escape(data.workcell.name),
        lead=html.escape(_lead(data)),
        recommendation=_recommendation(data),
        facts=_facts(data),
        style=(texts / "page.css").read_text("utf-8"),
        tables="".join(table.html() for table in tables),
        pictures="".join(_picture(path, caption) for path, caption in pictures),
        configuration=html.escape(json.dumps(settings, indent=2, ensure_ascii=False)),
        workcell=html.escape(data.workcell.source.read_text("utf-8")),
        data=embedded_json(document),
        scripts="\n".join(f"<script>{_unclosed(script)}</script>" for script in scripts),
    )


def plotly_js() -> str:
    """plotly.js as the plotly package carries it.

    Raises:
        ReportError: the installed plotly has no such file.
    """
    try:
        return (files("plotly") / "package_data" / "plotly.min.js").read_text("utf-8")
    except (OSError, ModuleNotFoundError) as error:
        raise ReportError(f"plotly.js cannot be read ({error}); install plotly anew") from error


def _unclosed(script: str) -> str:
    return script.replace("</script", "<\\/script")


def _policy(scripts: list[str]) -> str:
    """Only these inline scripts; styles and pictures of the page itself; no request."""
    hashes = [
        base64.b64encode(hashlib.sha256(_unclosed(script).encode()).digest()).decode()
        for script in scripts
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
    words = study_words(data.summary, "")
    if words is None:
        return ""
    facts = "".join(
        f"<dt>{html.escape(IN_FOLDER.get(heading, heading))}</dt>"
        f"<dd>{_monospaced(heading, text)}</dd>"
        for heading, text in words.facts
    )
    warnings = "".join(
        f"<p class='warning'>Warning: {html.escape(text)}</p>" for text in words.warnings
    )
    return (
        f"<section class='recommendation'><h2>{html.escape(words.headline)}</h2>"
        f"<dl>{facts}</dl>{warnings}</section>"
    )


def _monospaced(heading: str, text: str) -> str:
    escaped = html.escape(text)
    return f"<code>{escaped}</code>" if heading in IN_FOLDER else escaped


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
    return "".join(
        f"<li><b>{html.escape(value)}</b><span>{html.escape(text)}</span></li>"
        for value, text in facts
    )


def _picture(path: Path, caption: str) -> str:
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    text = html.escape(caption)
    return (
        f'<figure><img loading="lazy" decoding="async" alt="{text}" '
        f'src="data:image/png;base64,{content}"><figcaption>{text}</figcaption></figure>'
    )
