"""Generate and compile the functions of a workcell: `dual-arm-carry regenerate WORKCELL`.

The compiled functions are kept in the cache (DUAL_ARM_CACHE, by default in the user's cache
folder).
"""

from __future__ import annotations

import argparse

from studies.options import add, whole
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL", nargs="?", help="workcell file (TOML)")
    parser.add_argument(
        "--clean", action="store_true", help="empty the cache first, or only, without a workcell"
    )
    parser.add_argument(
        "--cache",
        action="store_true",
        help="print the content of the cache, or only that, without a workcell. Beyond 4 GiB, or "
        "the gibibytes in DUAL_ARM_CACHE_LIMIT, the least recently used libraries are removed",
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="compile anew and compare with the interpreted functions on random inputs, outputs "
        "and first derivatives; exit code 1 if they differ",
    )
    parser.add_argument(
        "--study",
        action="store_true",
        help="build all functions of a study of the workcell, its drivable experiment included, "
        "and print the time",
    )
    parser.add_argument(
        "--samples", type=whole(1, 10**6), default=20, help="random inputs per function"
    )
    add(parser, "--seed", default=0, help="seed of the random inputs")
    add(parser, "--json", help="print JSON instead of tables")


def _run(options: argparse.Namespace) -> int:
    if options.workcell is None and not (options.clean or options.cache):
        main.parser(options.called).error("name a workcell file, --cache or --clean")
    from studies.programs.regeneration import regenerate

    return regenerate(options)


main = Program("regenerate", __doc__, _add_options, _run)


if __name__ == "__main__":
    main.start()
