"""What `studies.regenerate` does: a workcell's functions as C, compiled, kept and checked."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from codegen.build import Build, FunctionReport, build
from codegen.cache import Cache, Usage, largest_size
from codegen.interpreted import Agreement, compare
from hybrid_opt.display.table import text_table

DISAGREES = 1


def regenerate(options: argparse.Namespace) -> int:
    """Do what the options ask for, and print it; returns the exit code."""
    cache = Cache()
    removed = cache.clean() if options.clean else None
    built: Build | None = None
    comparisons: list[Agreement] = []
    seconds: float | None = None
    if options.study and options.workcell is not None:
        from hybrid_opt.building import build_study
        from hybrid_opt.cell import Cell
        from hybrid_opt.progress import Progress

        begin = time.perf_counter()
        build_study(Cell.load(options.workcell), Progress())
        seconds = time.perf_counter() - begin
    elif options.workcell is not None:
        from hybrid_opt.compiled_cell import EVALUATOR_LANES, EVALUATORS, SCREENING, CompiledCell
        from symbolic.functions import arm_functions
        from symbolic.numbers import GROUPS
        from symbolic.read.cell import load

        workcell = load(options.workcell)
        cell = CompiledCell(workcell, cache)
        how = {"rebuild": options.check, "lanes": EVALUATOR_LANES}
        sets = [
            (arm_functions(cell.symbols), cell.key(EVALUATORS, bodies=False)),
            (cell.symbols.screening, cell.key(SCREENING)),
        ]
        builds = [build(functions, cache, key=key, **how) for functions, key in sets]
        made = {name: function for functions, _ in sets for name, function in functions.items()}
        built = Build(
            {name: function for each in builds for name, function in each.functions.items()},
            tuple(report for each in builds for report in each.reports),
            {name: key for each in builds for name, key in each.keys.items()},
        )
        if options.check:
            bounds = {"x": (workcell.task.lower, workcell.task.upper)}
            # The cell's own numbers, whatever is drawn.
            bounds |= {name: (cell.vector(name),) * 2 for name in GROUPS}
            rng = np.random.default_rng(options.seed)
            comparisons = [
                compare(function, built.functions[name], bounds, rng, options.samples, cache)
                for name, function in made.items()
            ]
    usage = cache.usage() if options.cache else None
    if options.json:
        _print_json(cache, removed, built, comparisons, seconds, usage)
    else:
        _print_tables(cache, removed, built, comparisons)
        if seconds is not None:
            print(f"what a study needs is in {cache.folder}, after {seconds:.1f} s")
        if usage is not None:
            print(
                f"{cache.folder} holds {usage.libraries} libraries in {usage.files} files, "
                f"{usage.size / 2**30:.2f} of {largest_size() / 2**30:g} GiB"
            )
    return 0 if all(comparison.agrees for comparison in comparisons) else DISAGREES


def _print_json(
    cache: Cache,
    removed: int | None,
    built: Build | None,
    comparisons: Sequence[Agreement],
    seconds: float | None,
    usage: Usage | None,
) -> None:
    result: dict[str, object] = {"cache": str(cache.folder)}
    if usage is not None:
        result["usage"] = asdict(usage)
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
