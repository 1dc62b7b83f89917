"""Holding forces against the simulator: `python -m studies.research.hand_thresholds`.

Draws payloads with cups above, cups at opposite sides, magnets, and fingers at two edges of a
plate, and short carries of them from rest to rest. For each it prints the least holding force with
which nothing slips by 1 mm and no rim lifts in the simulator, over the one that the contact model
`holding-hands` asks for.
"""

from __future__ import annotations

from studies.options import add, number, require_extra, stated, whole
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    parser.add_argument("--carries", type=whole(1, 10**6), default=40, help="how many")
    parser.add_argument(
        "--swings",
        type=number(0.0, 1e6),
        default=stated("studies.research.hand_carries.SWINGS"),
        help="how often payloads swing on their layers in a carry, at least",
    )
    add(parser, "--seed", help="of the carries")


main = Program(
    "research.hand_thresholds",
    __doc__,
    _add_options,
    "studies.research.hand_carries.thresholds",
    complete=lambda options: require_extra("sim", "a simulation"),
)


if __name__ == "__main__":
    main.start()
