"""Recommend another carry of a study: `dual-arm-carry recommend RESULTS --force-limit 52`.

Times, presses and plans the paths of its drivable fronts anew, for another payload, reference force
or uncertainty where these are given, and stores the trajectory. The study's own recommendation
stays as it is.
"""

from __future__ import annotations

import argparse

from studies.options import OUTPUT_FILE, add, add_wishes, force, number
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "RESULTS")
    add_wishes(parser)
    parser.add_argument(
        "--reference-force",
        type=force,
        metavar="N",
        help="largest normal force of both robots (default: that of the workcell)",
    )
    parser.add_argument(
        "--uncertainty",
        type=_uncertainty,
        metavar="SET",
        help="a factor on every range of the uncertainty, or ranges as friction=0.1,mass=0.02 "
        "(default: the workcell's)",
    )
    add(
        parser,
        "--output",
        type=OUTPUT_FILE,
        metavar="FILE",
        help="the trajectory file (default: recommended-WISH.json in RESULTS)",
    )
    add(parser, "--target", help="target of the printed export command (default: torque)")
    add(parser, "--quiet")


def _uncertainty(text: str) -> float | dict[str, float]:
    """Parse the uncertainty from text: either one factor on all its ranges, such as '1.5', or
    single ranges as 'NAME=VALUE,NAME=VALUE', named as in a workcell file.
    """
    if "=" not in text:
        return number(0.0, 20.0)(text)
    read, found = number(0.0, 1e7), {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        found[name.strip()] = read(value)
    return found


def _run(options: argparse.Namespace) -> int:
    from hybrid_opt.campaign.results import read_campaign
    from hybrid_opt.extras.bundles.targets import require_target
    from hybrid_opt.progress import Progress
    from hybrid_opt.recommending.choice import Wish
    from studies.study.answer import answer
    from studies.study.recommendation import EXPORT_TARGET, recommend_from

    target = options.target or EXPORT_TARGET
    require_target(target)
    root, doubt = options.results, None
    if options.uncertainty is not None:
        known = read_campaign(root).workcell.uncertainty
        doubt = known.changed(options.uncertainty)
    wish = Wish(
        options.duration, options.force_limit, options.payload, options.reference_force, doubt
    )
    found = recommend_from(root, wish, options.output, Progress(not options.quiet), target)
    print(answer(found, str(root)).terminal())
    return 0


def _complete(options: argparse.Namespace) -> None:
    wishes = {"duration": options.duration, "force": options.force_limit}
    wishes |= {"payload": options.payload, "reference-force": options.reference_force}
    parts = [f"{name}-{value:g}" for name, value in wishes.items() if value is not None]
    parts += ["uncertainty"] if options.uncertainty is not None else []
    named = "-".join(parts)
    file = f"recommended-{named or 'least-product'}.json"
    options.output = options.output or options.results / file


main = Program("recommend", __doc__, _add_options, _run, complete=_complete)


if __name__ == "__main__":
    main.start()
