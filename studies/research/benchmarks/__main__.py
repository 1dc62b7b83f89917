"""Other people's benchmarks beside what they published: `python -m studies.research.benchmarks`.

Their files are read from a folder, nothing of theirs comes with this project; without `--folder` it
says how to get them. Every task becomes a problem file, whose first carry is proposed and measured.
With `--study` a small drivable study follows, for the fastest carry whose squeeze holds, and a
search for the shortest one. All of it takes minutes, most of them for compiling.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from studies.options import INPUT_FOLDER, OUTPUT_FOLDER, add, stated, whole
from studies.program import Parser, Program
from symbolic.errors import SettingsError


def _add_options(parser: Parser) -> None:
    parser.add_argument(
        "name", metavar="NAME", nargs="?", default="", help="the benchmark (default: all)"
    )
    parser.add_argument(
        "--folder", metavar="FOLDER", type=INPUT_FOLDER, help="with the files of others, as it says"
    )
    parser.add_argument(
        "--output",
        metavar="FOLDER",
        type=OUTPUT_FOLDER,
        default=Path("results/benchmarks"),
        help="for problem files and proposed workcells",
    )
    add(
        parser,
        "--time",
        default=stated("hybrid_opt.extras.proposing.proposal.ProposeSettings.seconds"),
        help="seconds that a proposal may work",
    )
    add(
        parser,
        "--classes",
        help="number of classes of carries to look for; the carry whose joints move least is taken",
    )
    parser.add_argument(
        "--sample",
        type=whole(1, 600),
        default=10,
        metavar="N",
        help="scenes of each kind that are drawn for Baxter (default: 10)",
    )
    parser.add_argument(
        "--study",
        action="store_true",
        help="also look for the fastest and the shortest carry of every task",
    )
    add(parser, "--seed", help="of its randomness")


def _run(options: argparse.Namespace) -> int:
    import numpy as np

    from hybrid_opt.extras.proposing.proposal import ProposeSettings
    from studies.research.benchmarks import baxter, machines, shelves, slot
    from studies.research.benchmarks.measuring import measured, table

    known = {
        "shelves": shelves.SHELVES_SOURCE,
        "slot": slot.SLOT_SOURCE,
        "machines": machines.MACHINES_SOURCE,
        "baxter": baxter.source(options.sample, options.seed),
    }
    if options.name not in ("", *known):
        text = f"no benchmark {options.name!r}; there are {', '.join(known)}"
        raise SettingsError(text, code="unknown-name")
    chosen = {name: known[name] for name in known if options.name in ("", name)}
    if options.folder is None:
        for name, source in chosen.items():
            print(f"{name}: get its files, then name FOLDER by --folder\n{source.how}")
        return 0
    settings = ProposeSettings(seconds=options.time, classes=options.classes, remedies=False)
    for source in chosen.values():
        given = source.benchmark(options.folder)
        found = [
            measured(given, task, options.output, settings, options.seed, options.study)
            for task in given.tasks
        ]
        print(table(given, found, np.random.default_rng(options.seed)).text())
    return 0


main = Program("research.benchmarks", __doc__, _add_options, _run)


if __name__ == "__main__":
    main.start()
