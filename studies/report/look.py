"""Animation, live view and tables of a results folder, for other places than its report."""

from __future__ import annotations

import sys
from pathlib import Path

from hybrid_opt.campaign.results import read_summary
from studies.errors import ReportError
from studies.report.animation import Film, write_animation
from studies.report.data import gather_carries
from studies.report.generate import TABLES
from studies.report.live import LiveView
from studies.study.terminal import counted

BEGIN = "<!-- measured: begin -->"
END = "<!-- measured: end -->"


def animate(root: Path, path: Path) -> None:
    """Write the best selected trajectory of the first algorithm that has one.

    Raises:
        DualArmError: the results, the suffix or a library do not fit.
    """
    geometry, carries = gather_carries(root)
    write_animation(geometry, Film.of(carries[min(1, len(carries) - 1)]), path)


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


def watch(root: Path, port: int) -> None:
    """Show all selected trajectories until Ctrl-C.

    Raises:
        DualArmError: the results are incomplete or viser is missing.
    """
    view = LiveView(*gather_carries(root), port=port)
    address = f"http://{view.server.get_host()}:{view.server.get_port()}"
    print(f"Open {address} in a browser; Ctrl-C ends it.", file=sys.stderr)
    try:
        view.serve()
    except KeyboardInterrupt:
        view.stop()
