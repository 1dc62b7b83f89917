"""A cell in the browser, to be changed by hand: `dual-arm-carry live WORKCELL`.

Start, goal, bodies around, bases and pads can be dragged; mass, friction and force limit have
fields. What is changed is judged at once; a button searches for a better carry from the one on the
screen. The result can be saved as a workcell and exported. Only this machine can open the page.
"""

from __future__ import annotations

import argparse
import sys
import threading

import hybrid_opt as ho
from studies.options import add, require_extra, whole
from studies.program import Parser, Program, load_workcell


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    parser.add_argument(
        "--port",
        type=whole(1, 65535),
        default=8080,
        help="port of the page; another free one is taken if it is in use",
    )


def serve(options: argparse.Namespace) -> int:
    """Serve a page on which a cell can be changed, until Ctrl-C. Return the exit code.

    The page first shows the hand-made path. Its force limit is chosen such that the commanded
    forces stay within the reference forces, if any force limit does that.

    Raises:
        DualArmError: the cell has no drivable form, or the package viser is not installed.
    """
    from hybrid_opt.campaign.stages import build_study
    from hybrid_opt.progress import Progress
    from hybrid_opt.recommending.choice import gentle_start

    workcell = load_workcell(options.workcell)
    cell = ho.Cell(workcell)
    drivable = cell.drivable()
    build_study(drivable, Progress(), polish=False)
    page = ho.live(cell, port=options.port, x=gentle_start(drivable))
    print(f"Open {page.url} in a browser; Ctrl-C ends it.", file=sys.stderr)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        page.close()
    return 0


main = Program(
    "live",
    __doc__,
    _add_options,
    "studies.live.serve",
    complete=lambda options: require_extra("live", "the live view"),
)


if __name__ == "__main__":
    main.start()
