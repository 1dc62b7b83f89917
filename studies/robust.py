"""Forces that hold in every case: `dual-arm-carry robust FILE`.

Prints the commanded force of a stored trajectory, timed as in its job, that holds in every case of
its workcell's [uncertainty], or of the usual set without one: its contributions, the price of
robustness, the largest set that the reference forces allow, and a check in random cases. Exit code
1 if one of them fails.
"""

from __future__ import annotations

from studies.options import add, whole
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "FILE")
    add(parser, "--leader")
    parser.add_argument(
        "--cases", type=whole(1, 10**7), default=100_000, help="random cases to check"
    )
    parser.add_argument(
        "--points", type=whole(2, 1000), default=9, help="points of the price curve"
    )
    add(
        parser,
        "--planned-limit",
        help="also print the fastest timings within this limit [N] of planned forces, and of "
        "forces that hold in all cases (arm 1 leads)",
    )
    add(parser, "--seed", help="seed of the random cases")


main = Program("robust", __doc__, _add_options, "studies.programs.trajectory.robust_forces")


if __name__ == "__main__":
    main.start()
