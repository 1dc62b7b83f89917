"""Generation, compilation and check of a workcell's functions, for `studies.regenerate`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from codegen.build import FunctionReport, build
from codegen.cache import Cache, largest_size
from codegen.interpreted import Agreement, compare
from hybrid_opt.compiled_cell import EVALUATOR_LANES, EVALUATORS, SCREENING, CompiledCell
from hybrid_opt.display.table import text_table
from studies.program import FAULT, ProgramResult, load_workcell, print_findings
from symbolic.records import Workcell

if TYPE_CHECKING:
    import casadi as ca


def regenerate(options: argparse.Namespace) -> int:
    """Generate the code of a cell's functions, compile it, and check it against the interpreted
    expressions, as far as the options request. Return the exit code.
    """
    cache, found = Cache(), list[Agreement]()
    print_findings(_regenerated(cache, options, found), options.json)
    return 0 if all(comparison.agrees for comparison in found) else FAULT


def _regenerated(
    cache: Cache, options: argparse.Namespace, found: list[Agreement]
) -> Iterator[ProgramResult]:
    """Clean the cache, compile the functions of a workcell or of a whole study, and report the
    cache's size, as far as the options request. Yield one result per action.

    The workcell is read and its expressions are made before `--clean` removes anything.

    Args:
        cache: cache of compiled functions.
        options: parsed command line.
        found: list to which comparisons of compiled with interpreted functions are added.
    """
    largest = largest_size()
    cell = (
        None if options.workcell is None else CompiledCell(load_workcell(options.workcell), cache)
    )
    sets = [] if cell is None or (options.study and not options.clean) else _function_sets(cell)
    yield ProgramResult({"cache": str(cache.folder)})
    if options.clean:
        removed = cache.clean()
        said = f"{removed} libraries removed from {cache.folder}"
        yield ProgramResult({"removed": removed}, (said,))
    if cell is not None and options.study:
        seconds = _build_study(cell.workcell)
        said = f"what a study needs is in {cache.folder}, after {seconds:.1f} s"
        yield ProgramResult({"seconds": seconds}, (said,))
    elif cell is not None:
        yield from _built(cell, sets, cache, options, found)
    if options.cache:
        usage = cache.usage()
        said = (
            f"{cache.folder} holds {usage.libraries} libraries in {usage.files} files, "
            f"{usage.size / 2**30:.2f} of {largest / 2**30:g} GiB"
        )
        yield ProgramResult({"usage": usage}, (said,))


FunctionSets: TypeAlias = "list[tuple[Mapping[str, ca.Function], str]]"
"""Functions by name, with the key of their set."""


def _function_sets(cell: CompiledCell) -> FunctionSets:
    """Build the CasADi functions of the evaluator in sets. Each set has its functions by name, and
    its key in the cache."""
    from symbolic.functions import arm_functions

    symbols = cell.symbols
    return [
        (arm_functions(symbols), cell.key(EVALUATORS, bodies=False)),
        (symbols.screening, cell.key(SCREENING)),
    ]


def _build_study(workcell: Workcell) -> float:
    """Build everything that a study compiles. Return the time that it took [s]."""
    from hybrid_opt.campaign.stages import build_study
    from hybrid_opt.cell import Cell
    from hybrid_opt.progress import Progress

    begin = time.perf_counter()
    build_study(Cell(workcell), Progress())
    return time.perf_counter() - begin


def _built(
    cell: CompiledCell,
    sets: FunctionSets,
    cache: Cache,
    options: argparse.Namespace,
    found: list[Agreement],
) -> Iterator[ProgramResult]:
    """Compile the functions of the evaluator, and compare them with their interpreted expressions.

    Args:
        cell: the cell.
        sets: function sets to compile.
        cache: cache that keeps the libraries.
        options: parsed command line.
        found: list to which the comparisons are added.
    """
    from symbolic.parameters import GROUPS

    task = cell.workcell.task
    how = {"rebuild": options.check, "lanes": EVALUATOR_LANES}
    builds = [build(functions, cache, key=key, **how) for functions, key in sets]
    reports = [report for each in builds for report in each.reports]
    yield ProgramResult({"functions": reports}, (_report_table(reports),))
    if not options.check:
        return
    bounds = {"x": (task.lower, task.upper)}
    # The cell's own parameters are not drawn.
    bounds |= {name: (cell.vector(name),) * 2 for name in GROUPS}
    rng = np.random.default_rng(options.seed)
    found += [
        compare(function, each.functions[name], bounds, rng, options.samples, cache)
        for (functions, _), each in zip(sets, builds, strict=True)
        for name, function in functions.items()
    ]
    checks = [asdict(comparison) | {"agrees": comparison.agrees} for comparison in found]
    yield ProgramResult({"check": checks}, ("", _check_table(found)))


def _report_table(reports: Sequence[FunctionReport]) -> str:
    rows = [("function", "operations", "C size", "compile time", "from cache")]
    rows += [
        (
            report.name,
            f"{report.operations:,}",
            f"{report.c_bytes / 1000.0:,.1f} kB",
            f"{report.compile_seconds:.2f} s (-O{report.level})",
            "yes" if report.from_cache else "no",
        )
        for report in reports
    ]
    return text_table(rows)


def _check_table(comparisons: Sequence[Agreement]) -> str:
    rows = [("function", "inputs", "outputs", "derivatives", "agrees")]
    rows += [
        (
            c.name,
            str(c.samples),
            f"{c.outputs:.1e}",
            f"{c.derivatives:.1e}",
            "yes" if c.agrees else f"NO: {c.worst_output}",
        )
        for c in comparisons
    ]
    return text_table(rows)
