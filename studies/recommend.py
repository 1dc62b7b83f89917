"""Another carry of a finished study: `python -m studies.recommend RESULTS --force-limit 52`.

Recommends a carry of its drivable fronts, and stores its trajectory. The study's own
recommendation stays as it is.
"""

from __future__ import annotations

import argparse

from studies.options import add, add_wishes
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "RESULTS")
    add_wishes(parser)
    add(
        parser,
        "--output",
        metavar="FILE",
        help="the trajectory file (default: recommended-WISH.json in RESULTS)",
    )
    add(parser, "--quiet")


def _run(options: argparse.Namespace) -> int:
    from hybrid_opt.progress import Progress
    from hybrid_opt.recommending.choice import Wish
    from studies.study.recommendation import recommend_from, recommendation_text

    wish, root = Wish(options.duration, options.force_limit, options.payload), options.results
    named = "-".join(f"{name}-{value:g}" for name, value in wish.given.items()) or "least-product"
    path = options.output or root / f"recommended-{named}.json"
    found = recommend_from(root, wish, path, Progress(not options.quiet))
    print(recommendation_text(found, str(root)).terminal())
    return 0


main = Program("recommend", __doc__, _add_options, _run)


if __name__ == "__main__":
    main.start()
