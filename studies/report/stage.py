"""The report as the last stage of a study, and what a user may ask for besides."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from hybrid_opt.campaign import CampaignFolder, Stage, executor_for
from hybrid_opt.progress import Progress
from hybrid_opt.work.service import Executor, LocalExecutor

# Drawing libraries are heavy: they are imported when something is drawn.


def report_stage(with_paper: bool, pdf: bool = True) -> Stage:
    """The stage that writes pictures, tables and the page into the results folder.

    Args:
        with_paper: whether figures that the paper states of its rack stand beside ours.
        pdf: whether pictures are also written as PDF.
    """
    settings = {"with_paper": with_paper, "pdf": pdf}

    def run(folder: CampaignFolder, progress: Progress) -> None:
        _write(folder.root, settings, progress, executor_for(folder.execution))

    return Stage("report", run, settings)


def follow_looks(root: Path, options: argparse.Namespace) -> None:
    """Do what `studies.options.add_looks` lets a user ask for; the live view ends with Ctrl-C.

    Raises:
        DualArmError: the results or an optional library are missing.
    """
    if options.animation:
        from studies.report.looks import animate

        animate(root, options.animation)
    if options.view:
        from studies.report.looks import watch

        watch(root, options.port)


def _write(
    root: Path, settings: Mapping[str, bool], progress: Progress, executor: Executor
) -> None:
    from hybrid_opt.campaign.results import read_campaign
    from studies.report.data import gather
    from studies.report.generate import write_report
    from studies.report.pictures import report_pictures

    results = read_campaign(root)
    data = gather(results, executor)
    count = len(list(report_pictures(data))) + 1
    with progress.stage("report", count, "pictures") as advance:
        write_report(
            root, data, settings["with_paper"], settings["pdf"], lambda: advance(1), executor
        )


def rewrite(root: Path, progress: Progress, pdf: bool = False) -> None:
    """Write the report of a results folder anew, as its study did, with one process per core.

    Args:
        pdf: whether pictures are written as PDF even if the study did not.

    Raises:
        DualArmError: the folder is not complete.
    """
    from hybrid_opt.campaign.settings import STAGES
    from hybrid_opt.store.files import read_json

    marker = root / STAGES / "report.json"
    stored = read_json(marker) if marker.exists() else {}
    settings = stored.get("settings", {}) if isinstance(stored, dict) else {}
    asked = {
        "with_paper": bool(settings.get("with_paper")),
        "pdf": pdf or bool(settings.get("pdf", True)),
    }
    _write(root, asked, progress, LocalExecutor(0))
