"""Compare the search algorithms on analytic problems with known fronts.

Prints hypervolume and IGD of MOPSO and NSGA-II over several seeds, beside the figures that a
correct implementation of Coello's MOPSO reaches, and the comparison on a ZDT problem whose
optimum lies inside the bounds. Objectives are normalised by ideal and nadir of the true front;
the hypervolume's reference point is (1.1, 1.1); IGD is the mean Euclidean distance.
"""

from __future__ import annotations

from studies.options import add, stated
from studies.program import Parser, Program

BAND_POPULATION = 100
"""Swarm that the figures of a correct MOPSO hold for."""

SHIFTED = "shifted-zdt1"
"""The problem whose optimum lies inside the bounds; it has a budget and a population of its own."""

SHIFTED_POPULATION = 40
SHIFTED_EVALUATIONS = 1000


def _add_options(parser: Parser) -> None:
    parser.add_argument("--seeds", type=int, default=10, help="runs per figure, seeds 0, 1, ...")
    parser.add_argument(
        "--evaluations",
        type=int,
        nargs="+",
        default=[1000, 10_000, 25_000],
        help=f"budgets ({SHIFTED} always has {SHIFTED_EVALUATIONS})",
    )
    parser.add_argument(
        "--population",
        type=int,
        default=BAND_POPULATION,
        help=f"swarm or population, the bands hold for {BAND_POPULATION} "
        f"({SHIFTED} always has {SHIFTED_POPULATION})",
    )
    parser.add_argument(
        "--problems",
        nargs="+",
        default=list(stated("studies.research.analytic.PROBLEMS")),
        metavar="NAME",
        help="which",
    )
    parser.add_argument(
        "--algorithms", nargs="+", default=["mopso", "nsga2"], metavar="NAME", help="which"
    )
    add(parser, "--json", help="print JSON instead of the table")


main = Program("research.algorithms", __doc__, _add_options, "studies.research.analytic.algorithms")


if __name__ == "__main__":
    main.start()
