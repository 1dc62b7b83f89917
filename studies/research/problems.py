"""First carries for the problems that ship, and what comes of them.

Seventeen problems of two UR5, UR10, Panda, xArm7, iiwa or IRB 120, or of an RB-Y1: flat, over a
wall, past a post, into and off a shelf, out of a bin, turned, pitched, turned over, a rod between
poles or cones, from the ground onto a table. Each is proposed from nothing with every seed; with
--recommend a drivable search, a polish and a recommendation follow, which compile.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from studies.options import INPUT_FILE, add, stated, whole
from studies.program import FAULT, Parser, Program

if TYPE_CHECKING:
    import hybrid_opt as ho


@dataclass(frozen=True)
class ProblemAttempt:
    """Result of one proposal for a problem file.

    Attributes:
        problem, seed: name of the problem, and seed of the random numbers.
        problem_met: reason why there is no carry, '' if there is one.
        certified: core-seconds to the first certified carry, without imports.
        seconds: core-seconds of the whole proposal.
        length: length of the joint path, all joints together [rad].
        passes: obstacles that the carry passes, and on which side.
        duration: duration of the recommended carry [s].
        force: larger commanded force of both arms [N].
        allowed: True if `force` is within the reference force in every case of the uncertainty.
    """

    problem: str
    seed: int
    problem_met: str = ""
    certified: float | None = None
    seconds: float | None = None
    length: float | None = None
    passes: str = ""
    duration: float | None = None
    force: float | None = None
    allowed: bool | None = None


def shipped_problems() -> list[Path]:
    """Return the paths of all problem files in `studies/problems`."""
    return sorted(Path(str(files("studies"))).joinpath("problems").glob("*.toml"))


def attempt(path: Path, seed: int, seconds: float, evaluations: int) -> ProblemAttempt:
    """Propose a carry for a problem file, then search for a recommended carry unless `evaluations`
    is 0.

    Args:
        path: path of the problem file.
        seed: seed of proposal and search.
        seconds: time limit of the proposal [s].
        evaluations: budget of the search.
    """
    import numpy as np

    import hybrid_opt as ho

    try:
        found = ho.propose(
            path,
            rng=np.random.default_rng(seed),
            settings=ho.ProposeSettings(seconds=seconds),
        )
    except ho.DualArmError as error:
        return ProblemAttempt(path.stem, seed, str(error).removeprefix(f"{path}: "))
    known = ProblemAttempt(
        path.stem, seed, "", found.certified, found.seconds, found.length, found.passes
    )
    if not evaluations:
        return known
    best = _recommended(found, seed, evaluations)
    return ProblemAttempt(
        **asdict(known)
        | {
            "duration": best.duration,
            "force": float(best.commanded.max()),
            "allowed": best.fits,
        }
    )


def _recommended(found: ho.Proposal, seed: int, evaluations: int) -> ho.Recommendation:
    from tempfile import TemporaryDirectory

    import numpy as np

    import hybrid_opt as ho

    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cell.toml"
        path.write_text(found.text(path.parent), encoding="utf-8")
        cell = ho.Cell.load(path).drivable()
        front = ho.polish(ho.search(cell, "nsga2", evaluations=evaluations, rng=rng), rng=rng)
        return ho.recommend(front)


def _lines(tried: list[ProblemAttempt]) -> Iterator[str]:
    from hybrid_opt.display.table import number, text_table

    head = ("problem", "seed", "certified [s]", "all [s]", "way [rad]", "lasts [s]", "N", "")
    rows: list[tuple[str, ...]] = [head]
    for one in tried:
        figures = (one.certified, one.seconds, one.length, one.duration, one.force)
        # The reason's first line; with --json the whole.
        note = one.problem_met.partition("\n")[0] or one.passes
        if one.allowed is False:
            note += ", beyond the reference force"
        rows.append((one.problem, str(one.seed), *map(number, figures), note))
    yield text_table(rows, left=(0, len(head) - 1))
    certified = [one.certified for one in tried if one.certified is not None]
    yield f"{len(certified)} of {len(tried)} found" + (
        f"; first carry after {median(certified):.1f} s of work in the median" if certified else ""
    )


def _add_options(parser: Parser) -> None:
    parser.add_argument(
        "problems",
        nargs="*",
        metavar="PROBLEM",
        type=INPUT_FILE,
        help="problem files (default: those that ship)",
    )
    parser.add_argument(
        "--seeds", type=whole(1, 1000), default=3, metavar="N", help="seeds 1 to N of each"
    )
    add(
        parser,
        "--time",
        default=stated("hybrid_opt.extras.proposing.proposal.ProposeSettings.seconds"),
        help="seconds of work for each proposal",
    )
    parser.add_argument(
        "--recommend",
        type=whole(10, 10**6),
        default=0,
        metavar="N",
        help="search N drivable carries around each proposal, polish, and recommend one",
    )
    add(parser, "--json")


def _run(options: argparse.Namespace) -> int:
    paths = [Path(path) for path in options.problems] or shipped_problems()
    from hybrid_opt.progress import progress_bar

    tried = []
    with progress_bar(True, "proposals", len(paths) * options.seeds) as advance:
        for path in paths:
            for seed in range(1, options.seeds + 1):
                tried.append(attempt(path, seed, options.time, options.recommend))
                advance(1)
    if options.json:
        print(json.dumps([asdict(one) for one in tried], indent=1))
    else:
        print("\n".join(_lines(tried)))
    return FAULT if any(one.problem_met for one in tried) else 0


main = Program("research.problems", __doc__, _add_options, _run)


if __name__ == "__main__":
    main.start()
