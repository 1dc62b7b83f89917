"""Run a whole study of a workcell: `python -m studies.run WORKCELL`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from studies.program import add_verbose, carry_out, load_workcell, run_program
from studies.workers import start_workers

PAGE = "report.html"
"""The report in a results folder."""


def main(
    arguments: Sequence[str] | None = None,
    workcell: Path | None = None,
    program: str = "python -m studies.run",
) -> int:
    """Run the program; returns the exit code.

    Args:
        arguments: the command line, None for the process's own.
        workcell: the cell of a program that has one; None to take it from the command line.
        program: its name in messages.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    start_workers(arguments)
    # Imported only now: meanwhile the server of the workers loads much of the same.
    from hybrid_opt.campaign import Progress
    from hybrid_opt.cell import Cell
    from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES, FORCE_PAIRS, PAPER_OBJECTIVES
    from hybrid_opt.polishing.settings import usual_settings
    from hybrid_opt.witness.box import mujoco_module
    from studies.cli import (
        campaign_parser,
        campaign_settings,
        execution_settings,
        polish_settings,
        wish,
    )
    from studies.drivable import is_drivable
    from studies.report.stage import add_report_options, follow_report_options
    from studies.study import StudySettings, run_study

    description = "Search for the least-force carries of a dual-arm workcell."
    output = f"results/{'WORKCELL' if workcell is None else workcell.stem}"
    parser = campaign_parser(program, description, output)
    add_report_options(parser)
    if workcell is None:
        parser.add_argument("workcell", type=Path, metavar="WORKCELL", help="the workcell file")
    add_verbose(parser)
    again = [part for part in arguments if part not in ("--resume", "--overwrite")]
    command = " ".join([program, shlex.join([*again, "--resume"])])

    def work() -> int:
        options = parser.parse_args(arguments)
        if options.simulate:
            mujoco_module()  # told before hours of work
        path: Path = options.workcell if workcell is None else workcell
        cell = load_workcell(path)
        if options.recommend_only:
            drivable = Cell(cell).drivable()  # keeps the file of its workcell
            cell = drivable.workcell
        driven = cell.task.time_law == "optimal"
        settings = campaign_settings(options, DRIVABLE_OBJECTIVES if driven else PAPER_OBJECTIVES)
        alone = is_drivable(cell, settings.objectives)
        polishable = alone or (not driven and settings.objectives in FORCE_PAIRS)
        name = f"{path.stem}-recommended" if options.recommend_only else path.stem
        execution = execution_settings(options, Path("results") / name)
        study = StudySettings(
            polish=polish_settings(options, polishable, usual_settings(cell.task.time_law)),
            drivable=options.drivable,
            drivable_polish=polish_settings(options, True, usual_settings("optimal")),
            wish=wish(options),
            simulate=options.simulate,
            report=options.report and not options.recommend_only,
            recommend_only=options.recommend_only,
            with_paper=bool(workcell),
            pdf=not options.quick,
        )
        print(run_study(cell, settings, execution, Progress(not options.quiet), study))
        print(f"\nResults: {execution.output}")
        if study.report:
            print(f"Report: {execution.output / PAGE}")
        follow_report_options(execution.output, options)
        return 0

    interrupted = f"interrupted, nothing is lost; continue with: {command}"
    return carry_out(program, work, interrupted)


if __name__ == "__main__":
    sys.exit(run_program(main))
