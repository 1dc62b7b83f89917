"""Write a study's report anew, animate its trajectory, or watch it.

`dual-arm-carry report RESULTS` needs nothing but the results folder of a study.
"""

from __future__ import annotations

import argparse

from studies.options import add, add_looks
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "RESULTS", "--quiet")
    add(parser, "--paper")
    parser.add_argument(
        "--pdf",
        action="store_true",
        help="also write pictures as PDF (default: as the study did, all but a --quick one)",
    )
    add_looks(parser)


def _run(options: argparse.Namespace) -> int:
    from hybrid_opt.campaign.settings import STAGES
    from hybrid_opt.progress import Progress
    from hybrid_opt.store.files import read_json
    from hybrid_opt.workers import LocalWorkers, warm_up

    if options.animation or options.view:
        from studies.report.looks import follow_looks

        follow_looks(options.results, options)
    else:
        warm_up("studies.report.generate")
        from studies.report.generate import make_report

        marker = options.results / STAGES / "report.json"
        stored = read_json(marker) if marker.exists() else {}
        made = stored.get("settings", {}) if isinstance(stored, dict) else {}
        pdf = options.pdf or bool(made.get("pdf", True))
        paper = options.paper or bool(made.get("paper"))
        settings = {"with_paper": bool(made.get("with_paper")), "pdf": pdf, "paper": paper}
        with LocalWorkers(0) as workers:
            make_report(options.results, settings, Progress(not options.quiet), workers)
        print(f"Report: {options.results / 'report.html'}")
    return 0


main = Program("report", __doc__, _add_options, _run)


if __name__ == "__main__":
    main.start()
