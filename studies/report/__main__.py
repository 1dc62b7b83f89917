"""Write a study's report anew, animate its trajectory, or watch it.

`python -m studies.report RESULTS` needs nothing but the results folder of a study.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from hybrid_opt.campaign import Progress
from hybrid_opt.work.processes import warm_up
from studies.program import Parser, add_verbose, carried_out, run_program
from studies.report.stage import add_report_options, follow_report_options, rewrite

PROGRAM = "python -m studies.report"


@carried_out(PROGRAM)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    parser = Parser(prog=PROGRAM, description=__doc__)
    parser.add_argument("results", type=Path, metavar="RESULTS", help="results folder of a study")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.add_argument(
        "--into",
        type=Path,
        metavar="FILE",
        help="put Tables 1 and 2 between the markers of this Markdown file (default: none)",
    )
    parser.add_argument(
        "--pdf",
        action="store_true",
        help="write pictures as PDF, too (default: as the study did, all but a --quick one)",
    )
    add_report_options(parser)
    add_verbose(parser)
    options = parser.parse_args(arguments)
    if options.into:
        from studies.report.look import insert_tables

        insert_tables(options.results, options.into)
    elif options.animation or options.view:
        follow_report_options(options.results, options)
    else:
        warm_up("studies.report.generate")
        rewrite(options.results, Progress(not options.quiet), options.pdf)
        print(f"Report: {options.results / 'report.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(run_program(main))
