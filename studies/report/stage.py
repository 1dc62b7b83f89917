"""The report as the last stage of a study, and what a user may ask for besides."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from hybrid_opt.campaign import CampaignFolder, Stage, executor_for
from hybrid_opt.progress import Progress
from hybrid_opt.work.service import Executor

# Drawing libraries are heavy: they are imported when something is drawn.


def report_stage(with_paper: bool, pdf: bool = True) -> Stage:
    """The stage that writes pictures, tables and the page into the results folder.

    Args:
        with_paper: whether figures that the paper states of its rack stand beside ours.
        pdf: whether pictures are also written as PDF.
    """
    settings = {"with_paper": with_paper, "pdf": pdf}

    def run(folder: CampaignFolder, progress: Progress) -> None:
        write(folder.root, settings, progress, executor_for(folder.execution))

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


def write(root: Path, settings: Mapping[str, bool], progress: Progress, executor: Executor) -> None:
    """Write the report of a results folder.

    Args:
        settings: those of `report_stage`.

    Raises:
        DualArmError: the folder is not complete.
    """
    from hybrid_opt.campaign.results import read_campaign
    from studies.report.data import gather
    from studies.report.generate import write_report

    data = gather(read_campaign(root), executor)
    write_report(root, data, **settings, progress=progress, executor=executor)
