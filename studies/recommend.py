"""Another carry of a finished study: `python -m studies.recommend RESULTS --force-limit 52`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from hybrid_opt.campaign import Progress
from hybrid_opt.campaign.results import read_summary
from studies.cli import add_wishes, wish
from studies.program import Parser, add_verbose, carried_out, run_program
from studies.recommendation_stage import recommend_from
from studies.recommendation_text import recommendation_text

PROGRAM = "python -m studies.recommend"


@carried_out(PROGRAM)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    parser = Parser(
        prog=PROGRAM,
        description="Recommend a carry of a study's drivable fronts, and store its trajectory. The "
        "study's own recommendation stays as it is.",
    )
    parser.add_argument("results", type=Path, metavar="RESULTS", help="results folder of a study")
    add_wishes(parser)
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="the trajectory file (default: recommended-WISH.json in RESULTS)",
    )
    parser.add_argument(
        "--quiet", action="store_true", help="no progress on standard error (default: shown)"
    )
    add_verbose(parser)
    options = parser.parse_args(arguments)
    wanted, root = wish(options), options.results
    named = "-".join(f"{name}-{value:g}" for name, value in wanted.given.items()) or "knee"
    path = options.output or root / f"recommended-{named}.json"
    robots = read_summary(root).robots
    found = recommend_from(root, wanted, path, Progress(not options.quiet))
    print(recommendation_text(found, robots, str(root)).terminal())
    return 0


if __name__ == "__main__":
    sys.exit(run_program(main))
