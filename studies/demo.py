"""The shipped rack in minutes: hand-made carry, first front, a quick study, its page."""

from __future__ import annotations

import argparse
import time
import webbrowser
from collections.abc import Iterator
from pathlib import Path

import hybrid_opt as ho
from studies.options import QUICK_EVALUATIONS, add
from studies.program import Parser, Program
from studies.rack import main as rack
from studies.report import PAGE

OUTPUT = Path("results/demo")

SHOWN = 5
"""Number of carries of the first front that the demo prints."""

LARGEST_SLOWDOWN = 2.0
"""Only carries that take at most this multiple of the shortest duration are printed."""

BINDING_USE = 0.99
"""A limit is named as one that holds a carry back if the carry uses more than this share of it."""


def _add_options(parser: Parser) -> None:
    add(parser, "--output", metavar="DIR", default=OUTPUT, help="results folder, begun or finished")
    parser.add_argument(
        "--open",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="open the page in a browser, if there is one",
    )


def show(options: argparse.Namespace) -> int:
    """Print a first result, then run the example cell `rack` as a quick study. Return the exit
    code.

    The study's page is opened in a browser if the options request it.
    """
    began = time.monotonic()
    for part in first_result():
        print(f"{part}\n", flush=True)
    print(
        f"So far {time.monotonic() - began:.0f} s. The rest, a quick study with polish, "
        "recommendation and page, takes one\nto two minutes on two idle cores, longer beside other "
        "work or where its functions are not compiled yet.\n",
        flush=True,
    )
    begun = ["--resume"] if options.output.exists() else []
    code = rack(["--quick", "--output", str(options.output), *begun], options.called)
    page = (options.output / PAGE).resolve()
    if code == 0 and options.open and webbrowser.open(page.as_uri()):
        print(f"Opened in your browser: {page}")
    return code


def first_result(evaluations: int = QUICK_EVALUATIONS, seed: int = 1) -> Iterator[str]:
    """Yield two texts to print on the example cell `rack`: the duration of its hand-made path and
    the limits that the path uses fully, then a table of carries found by a short search and polish.

    Args:
        evaluations: number of candidates of the search.
        seed: seed of the search's random numbers.
    """
    import numpy as np

    from hybrid_opt.campaign.stages import build_study
    from hybrid_opt.display.table import Table
    from hybrid_opt.polishing.settings import quick_settings
    from hybrid_opt.progress import Progress
    from symbolic.array import evenly

    whole = ho.example("rack")
    build_study(whole, Progress())
    cell = whole.drivable()
    by_hand = ho.time_path(cell, cell.initial)
    yield (
        f"{cell.workcell.name}: a box of {cell.workcell.payload.mass:g} kg, from one board to the "
        f"next.\nBy hand: {by_hand.duration:.2f} s at least, and {by_hand.peak_force:.1f} N on a "
        f"pad. It is held back by its {_held(by_hand)}."
    )
    rng = np.random.default_rng(seed)
    front = ho.search(cell, "nsga2", evaluations=evaluations, rng=rng)
    front = ho.polish(front, rng=rng, settings=quick_settings(is_drivable=True), progress=True)
    carries = sorted(front, key=lambda carry: carry.duration)
    carries = [
        carry for carry in carries if carry.duration < LARGEST_SLOWDOWN * carries[0].duration
    ]
    rows = []
    for carry in (carries[k] for k in evenly(len(carries), SHOWN)):
        force = float(carry.peak_normal_force.max())
        same = ho.time_path(cell, cell.initial, ho.TimingLimits(force=force))
        hand = f"{same.duration:.2f}" if same.ok else "-"
        rows.append((f"{force:.1f}", hand, f"{carry.duration:.2f}", _held(same)))
    header = ("force on a pad [N]", "by hand [s]", "found [s]", "by hand held back by")
    title = f"The fastest carries at some forces, of {len(front)} found"
    yield Table("demo", title, header, tuple(rows)).text()


def _held(timing: ho.Timing) -> str:
    """Return the names of the limits that a timed carry uses fully, except friction. If the timing
    failed, return the reason."""
    if not timing.ok:
        return timing.reason
    # The least forces always use the whole friction.
    limits = (name for name in timing.use if name != "friction")
    return ", ".join(name for name in limits if timing.use[name].ratio > BINDING_USE)


main = Program("demo", __doc__, _add_options, "studies.demo.show")


if __name__ == "__main__":
    main.start()
