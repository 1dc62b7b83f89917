"""Propose a complete workcell: from robots, payload, start, goal and environment to a first carry.

The problem file is a workcell file in which `task.initial`, `[[task.waypoints]]`,
`[[task.redundant]]`, the pads' `spin` and the robots' `start_branch` are missing. The proposed file
is the same text, completed: a carry that the evaluator certifies, and bounds around it that a
search can start with.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable

from studies.options import OUTPUT_FILE, add, number, require_extra, stated, whole
from studies.program import Parser, Program
from symbolic.errors import SettingsError


def _ranges(text: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Parse the ranges [m] within which the pads may be moved, upwards and along their faces, from
    'LOW:HIGH,LOW:HIGH'. The second range is (0, 0) if the text has only one.

    Raises:
        argparse.ArgumentTypeError: there are more than two ranges, or a range is reversed.
    """
    read, found = number(-1.0, 1.0), []
    for part in text.split(","):
        low, _, high = part.partition(":")
        found.append((read(low), read(high)))
    up, along = [*found, (0.0, 0.0)][:2]
    if len(found) > 2 or up[0] > up[1] or along[0] > along[1]:
        raise argparse.ArgumentTypeError(
            f"found {text!r}; allowed is LOW:HIGH or LOW:HIGH,LOW:HIGH [m]"
        )
    return up, along


def _add_options(parser: Parser) -> None:
    add(parser, "PROBLEM")
    add(
        parser,
        "--output",
        type=OUTPUT_FILE,
        metavar="FILE",
        help="the workcell file (default: NAME-proposed.toml beside the problem file)",
    )
    parser.add_argument(
        "--bases",
        action="store_true",
        help="also propose the robots' bases, at the heights of the file",
    )
    add(
        parser,
        "--classes",
        help="propose up to N carries that pass obstacles on different sides, or hold the box in "
        "other postures; the first goes into the workcell file, the others into files whose names "
        "end in -2 and so on",
    )
    parser.add_argument(
        "--study",
        type=whole(100, 10**6),
        metavar="N",
        help="search N drivable carries around each of them, polish, and put the class of the "
        "fastest first (default: that with the shortest joint path); compiles, and takes time "
        "besides --time",
    )
    parser.add_argument(
        "--grips",
        type=_ranges,
        metavar="LOW:HIGH,LOW:HIGH",
        help="move the pads within these ranges upwards and along their faces [m], for the best "
        "grip of the proposed carry; compiles, and takes time besides --time; write "
        "--grips=-0.04:0.01",
    )
    add(
        parser,
        "--time",
        default=stated("hybrid_opt.extras.proposing.proposal.ProposeSettings.seconds"),
        help="time limit in seconds, start included",
    )
    add(parser, "--target")
    add(parser, "--seed")
    add(parser, "--quiet")


def _run(options: argparse.Namespace) -> int:
    import numpy as np

    import hybrid_opt as ho
    from hybrid_opt.extras.bundles.targets import missing_text
    from hybrid_opt.extras.proposing.problem import read_problem
    from hybrid_opt.extras.proposing.proposal import worked
    from hybrid_opt.robust.budget import budget_text
    from hybrid_opt.store.files import AGAIN, write_atomically

    problem, output = options.problem, options.output
    if options.target is not None:
        print(missing_text(options.target, read_problem(problem).workcell({})), flush=True)
    own = sys.argv[-len(options.arguments) :] == options.arguments
    begun = 0.0 if own else worked()  # of a process of its own imports count
    tell = (lambda text: None) if options.quiet else _teller(lambda: worked() - begun)
    proposals = ho.propose_classes(
        problem,
        rng=np.random.default_rng(options.seed),
        settings=ho.ProposeSettings(
            seconds=options.time,
            bases=options.bases,
            classes=options.classes,
            used=worked() - begun,
        ),
        tell=tell,
    )
    if options.study is not None:
        from hybrid_opt.extras.proposing.ranking import rank_homotopy_classes

        rng = np.random.default_rng(options.seed)
        proposals, table = rank_homotopy_classes(proposals, options.study, rng, tell)
        print(table.text())
    for k, proposal in enumerate(proposals, 1):
        name = output if k == 1 else output.with_stem(f"{output.stem}-{k}")
        write_atomically(name, proposal.text(name.parent).encode(), AGAIN)
        print(f"{name}: {proposal}")
    if not ho.grip_budget(proposals[0].found.workcell).fits:
        print(f"WARNING: {budget_text(proposals[0].found.workcell)}")
    if options.grips is not None:
        grip = ho.propose_grip(ho.Cell.load(output), *options.grips)
        assert grip.cell.workcell.text is not None, "it was read from a file"
        write_atomically(output, grip.cell.workcell.text, AGAIN)
        print(f"{output}: {grip}")
    print(f"next: {_next_command(options)}")
    return 0


def _next_command(options: argparse.Namespace) -> str:
    """Return the shell command that makes a quick study of the proposed cell."""
    target = [] if options.target is None else ["--target", options.target]
    words = ["dual-arm-carry", "run", str(options.output), "--quick", *target]
    return shlex.join(words)


def _teller(worked: Callable[[], float]) -> Callable[[str], None]:
    """Return a function that prints a text with the seconds worked so far, unless the last text was
    the same.

    Args:
        worked: function that returns the seconds worked so far.
    """
    last = [""]

    def tell(text: str) -> None:
        if text != last[0]:
            print(f"{worked():6.1f} s  {text}", file=sys.stderr, flush=True)
            last[0] = text

    return tell


def _complete(options: argparse.Namespace) -> None:
    problem = options.problem
    options.output = options.output or problem.with_name(f"{problem.stem}-proposed.toml")
    if options.output.resolve() == problem.resolve():
        raise SettingsError(f"{options.output} is the problem file; name another one by --output")
    require_extra("propose", "a proposal")


main = Program(
    "propose", __doc__, _add_options, _run, "interrupted; nothing was written", _complete
)


if __name__ == "__main__":
    main.start()
