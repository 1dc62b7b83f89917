"""Another carry of a finished study: `python -m studies.recommend RESULTS --force-limit 52`.

Recommends a carry of its drivable fronts, and stores its trajectory. The study's own
recommendation stays as it is.
"""

from __future__ import annotations

import argparse

from studies.options import OUTPUT_FILE, add, add_wishes
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "RESULTS")
    add_wishes(parser)
    add(
        parser,
        "--output",
        type=OUTPUT_FILE,
        metavar="FILE",
        help="the trajectory file (default: recommended-WISH.json in RESULTS)",
    )
    add(parser, "--quiet")


def _run(options: argparse.Namespace) -> int:
    from hybrid_opt.progress import Progress
    from hybrid_opt.recommending.choice import Wish
    from studies.study.recommendation import recommend_from, recommendation_text

    wish, root = Wish(options.duration, options.force_limit, options.payload), options.results
    found = recommend_from(root, wish, options.output, Progress(not options.quiet))
    print(recommendation_text(found, str(root)).terminal())
    return 0


def _complete(options: argparse.Namespace) -> None:
    wishes = {"duration": options.duration, "force": options.force_limit}
    wishes["payload"] = options.payload
    named = "-".join(f"{name}-{value:g}" for name, value in wishes.items() if value is not None)
    file = f"recommended-{named or 'least-product'}.json"
    options.output = options.output or options.results / file


main = Program("recommend", __doc__, _add_options, _run, complete=_complete)


if __name__ == "__main__":
    main.start()
