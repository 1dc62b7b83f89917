"""Redundant joints as variables against the same joints locked at constant positions.

Every replica searches once with the redundant joints free, and once for each of a grid of constant
positions within their bounds, with the same number of evaluations each.
"""

from __future__ import annotations

from studies.options import add, whole
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    for name, value, meaning in (
        ("locks", 16, "constant positions, at least"),
        ("replicas", 10, "independent comparisons"),
        ("evaluations", 1000, "of every search"),
    ):
        parser.add_argument(
            f"--{name}", type=whole(1, 10**9), default=value, metavar="N", help=meaning
        )
    add(parser, "--seed", help="of their randomness")
    add(parser, "--json")


main = Program(
    "research.redundancy", __doc__, _add_options, "studies.research.locked_joints.redundancy"
)


if __name__ == "__main__":
    main.start()
