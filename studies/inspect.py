"""Look at a workcell before a study: what it is, what is feasible in it, what it can win.

Prints the cell's facts, the postures at the start, the static bound, the verdicts on the
hand-made trajectory and on the straight line, the feasibility of random candidates by
constraint, with the pairs, joints and robots that are in the way most, and the number of collision
pairs (--pairs lists them with the reasons for those left out); with --polish the bounds that a
short polish ends on; draws the cell, both arms' reach and the first collision of trajectories that
fail; with --view writes a page that shows the hand-made one at any sample.

With --reach it finds only where both arms can hold the box at once, also for a problem file, which
may lack start and goal: draws it from above at some heights, and prints the best place, or else the
least change of bases or tools with which there is one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from studies.options import add, number, whole
from studies.program import Parser, Program
from symbolic.errors import SettingsError


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL", help="the workcell file; with --reach also a problem file")
    reach = parser.add_argument_group("where both arms can hold the box")
    reach.add_argument(
        "--reach",
        action="store_true",
        help="only find and draw the places at which both arms can hold the box",
    )
    reach.add_argument(
        "--heights",
        metavar="Z,Z",
        help="heights of the centre of the box [m], such as 0.3,0.5 (default: six that hold)",
    )
    reach.add_argument(
        "--step",
        type=number(0.01, 1.0),
        metavar="M",
        help="distance between places [m] (default: 0.02 to 0.2, at most 1000 places)",
    )
    reach.add_argument(
        "--yaws",
        type=whole(1, 36),
        metavar="N",
        help="directions of the box, evenly over half a turn, or over a whole one for hands, "
        "and if the file places the pads (default: 4)",
    )
    parser.add_argument(
        "--candidates",
        type=whole(1, 10**7),
        default=250,
        metavar="N",
        help="random candidates to evaluate",
    )
    add(parser, "--seed", help="seed of these candidates")
    add(
        parser,
        "--output",
        metavar="DIR",
        help="folder for pictures and view (default: inspect/NAME of the workcell file)",
    )
    parser.add_argument(
        "--polish",
        action="store_true",
        help="polish the hand-made trajectory briefly, to find active bounds",
    )
    parser.add_argument(
        "--view",
        action="store_true",
        help="write a page that plays the hand-made trajectory, from its first failure",
    )
    parser.add_argument("--no-pictures", action="store_true", help="draw nothing")
    parser.add_argument("--pairs", action="store_true", help="list every pair of bodies")
    add(parser, "--json")


def _heights(text: str | None) -> tuple[float, ...]:
    """Parse heights [m] from a text such as '0.5,0.8'; () for None.

    Raises:
        SettingsError: the text is no list of numbers.
    """
    try:
        return tuple(float(part) for part in (text or "").split(",") if text)
    except ValueError as error:
        raise SettingsError(
            f"--heights: found {text!a}; allowed are numbers with commas between [m]"
        ) from error


def _complete(options: argparse.Namespace) -> None:
    options.heights = _heights(options.heights)
    options.output = options.output or Path("inspect") / options.workcell.stem
    others = ("polish", "view", "pairs") if options.reach else ("heights", "step", "yaws")
    for name in others:
        if getattr(options, name):
            relation = "does not go with" if options.reach else "needs"
            raise SettingsError(f"--{name} {relation} --reach")


main = Program(
    "inspect",
    __doc__,
    _add_options,
    "studies.programs.inspection.inspect",
    complete=_complete,
)


if __name__ == "__main__":
    main.start()
