"""The shipped rack in a minute or two: hand-made carry, first front, a quick study, its page."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from studies.options import add
from studies.program import Parser, Program, later, run_program

OUTPUT = Path("results/demo")


def _add_options(parser: Parser) -> None:
    add(parser, "--output", metavar="DIR", default=OUTPUT, help="results folder, begun or finished")
    parser.add_argument(
        "--open",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="open the page in a browser, where there is one",
    )


main = Program("demo", __doc__, _add_options, later("studies.programs.demo.show"))


if __name__ == "__main__":
    sys.exit(run_program(main))
