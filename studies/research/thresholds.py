"""Slip thresholds of many carries in the simulator: `python -m studies.research.thresholds`.

The least multiple of the planned normal forces with which the box does not slip in MuJoCo between
pads that press evenly, and when it slips first, for hand-made, searched and random feasible
trajectories of the shipped cells under several frictions. Every carry is stored as it is done; the
same command goes on from there.
"""

from __future__ import annotations

from pathlib import Path

from studies.options import OUTPUT_FILE, WORKCELL_FILE, add, number, require_extra, stated, whole
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    parser.add_argument(
        "cells",
        nargs="*",
        type=WORKCELL_FILE,
        metavar="WORKCELL",
        help="(default: the shipped ones)",
    )
    parser.add_argument(
        "--carries", type=whole(1, 10**6), default=60, help="how many, of all cells in turn"
    )
    add(
        parser,
        "--output",
        type=OUTPUT_FILE,
        default=Path("results/thresholds.json"),
        metavar="FILE",
        help="where they are stored (default: results/thresholds.json)",
    )
    add(parser, "--seed", help="of the random candidates and of the searches")
    layer = stated("hybrid_opt.extras.simulation.scene.ContactSettings.layer")
    parser.add_argument(
        "--layer",
        type=number(1e6, 1e10),
        default=layer,
        metavar="N/m^3",
        help=f"stiffness of the pads' layers (default: {layer:g})",
    )


main = Program(
    "research.thresholds",
    __doc__,
    _add_options,
    "studies.research.slips.thresholds",
    complete=lambda options: require_extra("sim", "a simulation"),
)


if __name__ == "__main__":
    main.start()
