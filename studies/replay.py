"""Re-evaluate a stored trajectory from its file alone: `dual-arm-carry replay FILE`.

Compares its figures with the stored ones, and times it for real robots (studies.export writes it
for them). Exit code 1 where a figure differs.
"""

from __future__ import annotations

from studies.options import add
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "FILE")
    parser.add_argument(
        "--timing", action="store_true", help="report timings that robots can drive, and margins"
    )
    add(
        parser,
        "--planned-limit",
        help="also print the fastest timing within this limit of the planned normal forces [N]",
    )
    parser.add_argument(
        "--force-curve",
        type=int,
        metavar="POINTS",
        help="also print the durations at this number of limits of the planned force",
    )
    add(parser, "--json")


main = Program("replay", __doc__, _add_options, "studies.programs.trajectory.replay_file")


if __name__ == "__main__":
    main.start()
