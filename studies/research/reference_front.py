"""Compute the reference front of a workcell: polished from many starts, then filled.

Random feasible candidates, each the start of its own polish, find the regions; the union of what
they lead to is polished once more as one front. The result is the best front that is known, not a
proven one. `tests/hybrid_opt/polishing/rack_reference_front.csv` was made with

    python -m studies.research.reference_front studies/workcells/rack.toml --output FILE
"""

from __future__ import annotations

from studies.options import OUTPUT_FILE, add, whole
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    add(
        parser,
        "--output",
        type=OUTPUT_FILE,
        required=True,
        metavar="FILE",
        help="the CSV file to write",
    )
    parser.add_argument("--starts", type=whole(1, 10**4), default=24, help="random starts")
    parser.add_argument(
        "--attempts", type=whole(0, 10**5), default=60, help="attempts of the final polish"
    )
    add(parser, "--seed", help="of the random starts")
    add(parser, "--jobs")


main = Program(
    "research.reference_front", __doc__, _add_options, "studies.research.best_front.reference_front"
)


if __name__ == "__main__":
    main.start()
