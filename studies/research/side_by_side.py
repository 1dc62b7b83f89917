"""Cells side by side: what a candidate and a drivable search cost with primitives and with meshes.

The compiled evaluations of all cells take turns, so that a ratio holds on a busy machine.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.display.table import number, text_table
from hybrid_opt.front import search
from studies.research.turns import POPULATION, Evaluate, interleaved, progress
from symbolic.array import Array
from symbolic.geometry.pieces import Hull

SPREAD = 0.02
"""Standard deviation of candidates near the hand-made path, as a share of the width of the
bounds."""

EVALUATIONS = 400
"""Number of evaluations of a drivable search."""


def compare(
    cells: Sequence[Cell], batches: int, repeats: int, seed: int = 0
) -> list[dict[str, Any]]:
    """Measure the compiled evaluation of several cells in turns, collisions included.

    Times are the thread's own times.

    Args:
        cells: the cells.
        batches: number of batches near the hand-made path, and of random ones, per cell.
        repeats: number of rounds with each batch.
        seed: seed of candidates and searches.

    Returns:
        For each cell, by name: the numbers of bodies, pieces, hulls and pairs; mean times per
        candidate over the rounds, `near_ms` and `random_ms` [ms]; the core-seconds of a drivable
        search, `search_s`; and the ratios of these times to those of the first cell: `near` and
        `random`, means over the rounds, and `search`.
    """
    rows: list[dict[str, Any]] = [_contents(cell) for cell in cells]
    for what in ("near", "random"):
        progress(f"{batches * repeats} rounds of {what} candidates")
        rng = np.random.default_rng(seed)
        ways: dict[str, Evaluate] = {str(k): cell.evaluate for k, cell in enumerate(cells)}
        x = {str(k): _candidates(cell, what, batches, rng) for k, cell in enumerate(cells)}
        times = interleaved(ways, x, repeats)
        for k, row in enumerate(rows):
            row[f"{what}_ms"] = float(1e3 * np.mean(times[str(k)]) / POPULATION)
            row[what] = float(np.mean(times[str(k)] / times["0"]))
    for cell, row in zip(cells, rows, strict=True):
        progress(f"{row['cell']}: a drivable search")
        row["search_s"] = _search_seconds(cell, seed)
        row["search"] = row["search_s"] / rows[0]["search_s"]
    return rows


def _contents(cell: Cell) -> dict[str, Any]:
    pieces = [piece for body in cell.geometry.bodies for piece in body.pieces]
    return {
        "cell": cell.workcell.name,
        "bodies": len(cell.geometry.bodies),
        "pieces": len(pieces),
        "hulls": sum(isinstance(piece.shape, Hull) for piece in pieces),
        "pairs": len(cell.geometry.active),
    }


def _candidates(cell: Cell, what: str, batches: int, rng: np.random.Generator) -> Array:
    """Draw decision vectors (batches, population, n_var) of a cell.

    Args:
        cell: the cell.
        what: 'near' for candidates near the hand-made trajectory, 'random' for uniform ones.
        batches: number of batches.
        rng: source of the random numbers.
    """
    size = (batches, POPULATION, cell.n_var)
    if what == "random":
        return rng.uniform(cell.lower, cell.upper, size)
    steps = SPREAD * (cell.upper - cell.lower) * rng.standard_normal(size)
    return np.clip(cell.initial + steps, cell.lower, cell.upper)


def _search_seconds(cell: Cell, seed: int) -> float:
    """Measure the core-seconds of a search for drivable carries, with functions compiled before.

    Args:
        cell: the cell.
        seed: seed of the search.
    """
    drivable = cell.drivable()
    drivable.evaluate(drivable.initial)
    start = time.process_time()
    search(drivable, "nsga2", evaluations=EVALUATIONS, rng=np.random.default_rng(seed))
    return time.process_time() - start


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the results of `compare` as text."""
    counts = ("bodies", "pieces", "hulls", "pairs")
    costs = (("near_ms", "near"), ("random_ms", "random"), ("search_s", "search"))
    head = ("cell", *counts, "near, ms", "over", "random, ms", "over", "search, core-s", "over")
    lines: list[Sequence[str]] = [head]
    for row in rows:
        figures = [
            text for cost, ratio in costs for text in (number(row[cost], 3), number(row[ratio], 2))
        ]
        lines.append((row["cell"], *(str(row[count]) for count in counts), *figures))
    return (
        "a candidate near the hand-made path, a random one, a drivable search of "
        f"{EVALUATIONS}; each over the first cell's\n{text_table(lines)}"
    )
