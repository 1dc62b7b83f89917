"""Slip thresholds of many carries in the simulator: `python -m studies.research.thresholds`.

The least multiple of the planned normal forces with which the box does not slip in MuJoCo, and
where it slips first, for hand-made, given and random feasible trajectories of both cells under
several timings and frictions.
"""

from __future__ import annotations

import sys

from studies.options import add, whole
from studies.program import Parser, Program, later, run_program


def _add_options(parser: Parser) -> None:
    parser.add_argument("files", nargs="*", metavar="FILE", help="trajectory files, e.g. polished")
    parser.add_argument(
        "--carries", type=whole(1, 10**6), default=40, help="how many, in turn of all kinds"
    )
    parser.add_argument(
        "--skip", type=whole(0, 10**6), default=0, help="how many of these are done already"
    )
    parser.add_argument(
        "--pads",
        choices=("driven", "rigid"),
        default="driven",
        help="pads that tilt, driven by the planned moments; or pads that only keep their place",
    )
    add(parser, "--seed", help="of the random candidates")


main = Program(
    "research.thresholds", __doc__, _add_options, later("studies.research.slips.thresholds")
)


if __name__ == "__main__":
    sys.exit(run_program(main))
