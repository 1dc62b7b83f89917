"""First path, combinations, table and figure of a sweep, for `studies.sweep`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hybrid_opt.campaign.stages import build_study
from hybrid_opt.cell import Cell
from hybrid_opt.display.table import Table, number
from hybrid_opt.extras.sweeping import Sweep, read_sweep, require_keys, sweep
from hybrid_opt.front import polish, search
from hybrid_opt.progress import Progress
from hybrid_opt.recommending.recommendation import recommend
from hybrid_opt.store.files import to_json
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.workers import warm_up
from studies.program import load_workcell
from studies.report.drawing import (
    in_style,
    legend_below,
    new_figure,
    save,
    series,
    shortened,
)
from symbolic.array import Array
from symbolic.errors import SettingsError, WorkcellError

REMARK = 60
"""Largest number of characters of a remark in the terminal."""


def sweep_numbers(options: argparse.Namespace) -> int:
    """Make a sweep, print the results and write them. Return the exit code."""
    if options.jobs != 1:
        warm_up("hybrid_opt.extras.sweeping")  # while this process finds the first path
    cell, over = Cell(load_workcell(options.workcell)).drivable(), dict(options.over)
    try:
        require_keys(cell, over)
    except WorkcellError as error:  # of the drivable cell, whose file is a temporary one
        raise WorkcellError(str(options.workcell), error.problems) from error
    file = Path(options.output) / "sweep.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    shown = not options.quiet
    build_study(cell, Progress(shown), polish=options.path is None)
    if file.exists():
        x: Array = read_sweep(file).x
    elif options.path is not None:
        x = _of_file(cell, Path(options.path))
    else:
        rng = np.random.default_rng(options.seed)
        found = search(cell, evaluations=options.evaluations, rng=rng, progress=shown)
        best = recommend(polish(found, rng=rng, progress=shown))
        x = np.append(best.x[:-1], best.limit)
    fixed = options.path is not None
    done = sweep(cell, x, over, fixed=fixed, file=file, jobs=options.jobs, progress=shown)
    whole = file.with_suffix(".csv")
    whole.write_text(_table(done).csv())
    with in_style():
        save(_figure(done), file.parent, "sweep")
    if options.json:
        print(json.dumps(to_json(done), indent=2))
    else:
        print(_table(done, REMARK).text())
        print(f"whole remarks in {whole}")
    return 0


def _of_file(cell: Cell, path: Path) -> Array:
    """Return the decision vector (n_var,) of a stored carry.

    Args:
        cell: the cell, whose decision variables the carry has to fit.
        path: path of the trajectory file.
    """
    x = read_trajectory(path).x
    n_path = cell.workcell.task.n_path
    if x.shape == (n_path,):
        x = np.append(x, cell.workcell.task.force_limit[1])
    if x.shape != (cell.n_var,):
        raise SettingsError(f"{path} has {len(x)} variables; this cell has {cell.n_var}")
    return x


def _table(done: Sweep, longest: int = sys.maxsize) -> Table:
    """Build the table of a finished sweep `done`, with remarks cut to `longest` characters."""
    rows = [
        (
            *(f"{v:g}" for v in row.values),
            number(row.duration, 3),
            number(row.force, 1),
            shortened(row.remark.removeprefix("- "), longest),
        )
        for row in done.rows
    ]
    header = (*done.over, "duration [s]", "force [N]", "remark")
    return Table("sweep", "The recommended carry of every combination", header, tuple(rows))


def _figure(done: Sweep) -> Figure:
    """Draw the duration and the force of a sweep's carries, in two panels, over the values of the
    last swept key. Each combination of the other keys' values has a line."""
    figure = new_figure(0.45)
    panels = figure.subplots(1, 2)
    *outer, last = done.over
    heads = list(dict.fromkeys(row.values[:-1] for row in done.rows))
    for axes, name, label in zip(
        panels, ("duration", "force"), ("duration [s]", "commanded force [N]"), strict=True
    ):
        for k, head in enumerate(heads):
            own = [row for row in done.rows if row.values[:-1] == head]
            named = ", ".join(f"{key} {v:g}" for key, v in zip(outer, head, strict=True))
            values = [row.values[-1] for row in own], [getattr(row, name) for row in own]
            axes.plot(*values, **series(k).drawn, marker="o", markersize=3, label=named or None)
        axes.set_xlabel(last)
        axes.set_ylabel(label)
    if outer:
        legend_below(figure, panels[0])
    return figure
