"""Generate and compile the functions of a workcell: `python -m studies.regenerate WORKCELL`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from codegen.build import Build, FunctionReport, build
from codegen.cache import Cache
from codegen.interpreted import Agreement, compare
from studies.program import Parser, add_verbose, program_of, run_program
from studies.text_table import text_table

PROGRAM = "python -m studies.regenerate"

DISAGREES = 1


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM,
        description="Generate the functions of a workcell as C, compile them and keep them in the "
        "cache (DUAL_ARM_CACHE, by default in the user's cache folder).",
    )
    parser.add_argument("workcell", nargs="?", type=Path, help="workcell file (TOML)")
    parser.add_argument(
        "--clean", action="store_true", help="empty the cache first; alone, only that"
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="compile anew and compare with the interpreted functions on random inputs, outputs "
        "and first derivatives; exit code 1 where they differ",
    )
    parser.add_argument(
        "--study",
        action="store_true",
        help="build everything that a study of the workcell compiles beforehand, its drivable "
        "experiment included, and say how long that took",
    )
    parser.add_argument(
        "--samples", type=int, default=20, help="random inputs per function (default: 20)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random inputs (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    add_verbose(parser)
    return parser


def _run(options: argparse.Namespace) -> int:
    if options.workcell is None and not options.clean:
        _parser().error("name a workcell file, or --clean")
    if options.samples < 1:
        _parser().error(f"--samples is {options.samples}; give 1 or more")
    if options.seed < 0:
        _parser().error(f"--seed is {options.seed}; give 0 or more")
    cache = Cache()
    removed = cache.clean() if options.clean else None
    built: Build | None = None
    comparisons: list[Agreement] = []
    seconds: float | None = None
    if options.study and options.workcell is not None:
        from hybrid_opt.building import build_study
        from hybrid_opt.campaign.progress import Progress
        from hybrid_opt.cell import Cell

        begin = time.perf_counter()
        build_study(Cell.load(options.workcell), Progress())
        seconds = time.perf_counter() - begin
    elif options.workcell is not None:
        from hybrid_opt.compiled_cell import EVALUATOR_LANES, EVALUATORS, CompiledCell
        from symbolic.functions import cell_functions
        from symbolic.read.cell import load

        workcell = load(options.workcell)
        cell = CompiledCell(workcell, cache)
        made = cell_functions(cell.model)
        key = cell.key(EVALUATORS)
        built = build(made, cache, key=key, rebuild=options.check, lanes=EVALUATOR_LANES)
        if options.check:
            bounds = {"x": (workcell.task.lower, workcell.task.upper)}
            rng = np.random.default_rng(options.seed)
            comparisons = [
                compare(function, built.functions[name], bounds, rng, options.samples, cache)
                for name, function in made.items()
            ]
    if options.json:
        _print_json(cache, removed, built, comparisons, seconds)
    else:
        _print_tables(cache, removed, built, comparisons)
        if seconds is not None:
            print(f"what a study needs is in {cache.folder}, after {seconds:.1f} s")
    return 0 if all(comparison.agrees for comparison in comparisons) else DISAGREES


def _print_json(
    cache: Cache,
    removed: int | None,
    built: Build | None,
    comparisons: Sequence[Agreement],
    seconds: float | None,
) -> None:
    result: dict[str, object] = {"cache": str(cache.folder)}
    if removed is not None:
        result["removed"] = removed
    if built is not None:
        result["functions"] = [asdict(report) for report in built.reports]
    if seconds is not None:
        result["seconds"] = seconds
    if comparisons:
        result["check"] = [
            asdict(comparison) | {"agrees": comparison.agrees} for comparison in comparisons
        ]
    print(json.dumps(result, indent=2))


def _print_tables(
    cache: Cache, removed: int | None, built: Build | None, comparisons: Sequence[Agreement]
) -> None:
    if removed is not None:
        print(f"{removed} libraries removed from {cache.folder}")
    if built is not None:
        print(text_table([_HEADINGS, *[_row(report) for report in built.reports]]))
    if comparisons:
        print()
        rows = [
            (
                c.name,
                str(c.samples),
                f"{c.outputs:.1e}",
                f"{c.derivatives:.1e}",
                "yes" if c.agrees else f"NO: {c.worst_output}",
            )
            for c in comparisons
        ]
        print(text_table([("function", "inputs", "outputs", "derivatives", "agrees"), *rows]))


_HEADINGS = ("function", "operations", "C size", "compile time", "from cache")


def _row(report: FunctionReport) -> tuple[str, ...]:
    return (
        report.name,
        f"{report.operations:,}",
        f"{report.c_bytes / 1000.0:,.1f} kB",
        f"{report.compile_seconds:.2f} s (-O{report.level})",
        "yes" if report.from_cache else "no",
    )


main = program_of(PROGRAM, _parser, _run)


if __name__ == "__main__":
    sys.exit(run_program(main))
