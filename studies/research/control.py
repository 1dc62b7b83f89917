"""Hold a polished study against searches alone that may spend as much, or far more.

The study's own searches are repeated without a polish, with the budget that the most expensive
polish took (its seconds, as candidate evaluations) added, and with 20,000 evaluations. Each
replica's hypervolumes are then compared: search, search and polish, longer search. With
`--reference FILE` (from `studies.research.reference_front`) only the distance to that front is
told.
"""

from __future__ import annotations

from studies.options import INPUT_FILE, add
from studies.program import Parser, Program

LONG_SEARCH = 20_000
"""Evaluations of the far longer search."""


def _add_options(parser: Parser) -> None:
    add(parser, "RESULTS", help="folder of a polished study")
    parser.add_argument(
        "--evaluations",
        nargs="+",
        type=int,
        default=[],
        metavar="N",
        help=f"budgets of the longer searches (default: that of equal time, and {LONG_SEARCH})",
    )
    add(parser, "--jobs")
    parser.add_argument(
        "--reference",
        type=INPUT_FILE,
        metavar="FILE",
        help="tell the distance to this reference front instead of searching (default: none)",
    )
    add(parser, "--json", help="print JSON instead of a table")


main = Program(
    "research.control",
    __doc__,
    _add_options,
    "studies.research.longer_searches.control",
    "interrupted, nothing is lost; the same command continues",
)


if __name__ == "__main__":
    main.start()
