"""What other numbers do to a carry: `dual-arm-carry sweep WORKCELL --over KEY=FIRST:LAST:STEP`.

For every combination of the values the duration of the recommended carry and the force to press
with: a table, a figure, and `sweep.json`, which is continued where it exists. KEY is a path of the
workcell file, such as payload.mass or contacts.friction.
"""

from __future__ import annotations

import argparse
import math

from studies.options import TRAJECTORY_FILE, add, number, whole
from studies.program import Parser, Program

MOST_VALUES = 1000


def _over(text: str) -> tuple[str, tuple[float, ...]]:
    """Parse a key of the workcell file and the values that it takes in a sweep.

    The form is 'KEY=FIRST:LAST:STEP' with both ends included, or 'KEY=VALUE,VALUE'.

    Raises:
        argparse.ArgumentTypeError: the text has another form, or more than `MOST_VALUES` values.
    """
    key, _, given = text.partition("=")
    read = number(-1e9, 1e9)
    parts = [read(part) for part in given.replace(",", ":").split(":")] if key and given else []
    if "," in given or len(parts) == 1:
        return key, tuple(parts)
    if len(parts) == 3 and parts[2] > 0.0 and parts[0] <= parts[1]:
        steps = math.floor((parts[1] - parts[0]) / parts[2] + 1e-9)
        if steps < MOST_VALUES:
            return key, tuple(round(parts[0] + k * parts[2], 12) for k in range(steps + 1))
    raise argparse.ArgumentTypeError(
        f"found {text!r}; allowed is KEY=FIRST:LAST:STEP of at most {MOST_VALUES} values, or "
        "KEY=VALUE,VALUE,..."
    )


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    parser.add_argument(
        "--over",
        type=_over,
        action="append",
        required=True,
        metavar="KEY=FIRST:LAST:STEP",
        help="a key and its values, or KEY=VALUE,VALUE,...; several make a grid",
    )
    parser.add_argument(
        "--path",
        type=TRAJECTORY_FILE,
        metavar="FILE",
        help="keep the path of this trajectory file throughout (default: the recommended path of "
        "the cell, polished in every changed cell)",
    )
    parser.add_argument(
        "--evaluations",
        type=whole(1, 10**6),
        default=1000,
        help="evaluations of the search for the first path",
    )
    add(parser, "--output", default="results/sweep", metavar="DIR", help="folder of the results")
    add(parser, "--jobs", "--seed", "--json", "--quiet")


main = Program("sweep", __doc__, _add_options, "studies.programs.sweeping.sweep_numbers")


if __name__ == "__main__":
    main.start()
