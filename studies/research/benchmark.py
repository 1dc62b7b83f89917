"""Cost of one candidate: compiled, interpreted and written plainly.

`python -m studies.research.benchmark [WORKCELL]` measures milliseconds per candidate on one core,
in the thread's own processor time, so that waiting for a busy machine does not count. The three
ways take turns, the compiled one with batches of a search's size, and a ratio is the median over
the rounds of the ratio within a round. The plain way is the reference that the tests hold the
evaluator to (`studies.research.plain`). With collisions the same is measured on candidates of a
search (`studies.research.turns`). `--study` tells instead where the time of a study goes
(`studies.research.costs`). `--beside CELL ...` compares the compiled way of several cells, as of
primitives and of meshes (`studies.research.side_by_side`).

The cost against the number of samples and of free waypoints is measured on cells derived from the
given one: same start, goal and robots, the free waypoints spread along the hand-made trajectory.
"""

from __future__ import annotations

from studies.options import WORKCELL_FILE, add, whole
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL", nargs="?", help="workcell file (default: the rack cell)")
    parser.add_argument("--candidates", type=whole(1, 10**6), default=10, help="random candidates")
    parser.add_argument(
        "--repeats", type=whole(1, 10**6), default=3, help="rounds with each candidate"
    )
    add(parser, "--seed", default=0, help="of the candidates")
    add(parser, "--json", help="print JSON instead of tables")
    parser.add_argument(
        "--study", action="store_true", help="core-seconds by part of search, polish and timing"
    )
    parser.add_argument(
        "--beside",
        metavar="CELL",
        nargs="+",
        type=WORKCELL_FILE,
        default=[],
        help="workcell files to compare it with",
    )


main = Program("research.benchmark", __doc__, _add_options, "studies.research.costs.benchmark_cell")


if __name__ == "__main__":
    main.start()
