"""Compare two campaigns: `dual-arm-carry compare RUN_A RUN_B`.

Prints, per algorithm that both ran, medians and quartiles of every figure over the replicas, an
exact Mann-Whitney test with its effect size, and what differs between the two configurations;
where both have them, also of the polished fronts and of the drivable experiments. Indicators that
depend on a reference front are computed anew against the union of both.
"""

from __future__ import annotations

from studies.options import RESULTS_FOLDER, add
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    parser.add_argument("run_a", type=RESULTS_FOLDER, metavar="RUN_A", help="a results folder")
    parser.add_argument(
        "run_b", type=RESULTS_FOLDER, metavar="RUN_B", help="another results folder"
    )
    add(parser, "--json")


main = Program("compare", __doc__, _add_options, "studies.programs.comparison.compare_folders")


if __name__ == "__main__":
    main.start()
