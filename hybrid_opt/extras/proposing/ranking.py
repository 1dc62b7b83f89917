"""Ranking of proposals by the fastest carries of their classes, each found by a small study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.display.table import Table, number
from hybrid_opt.extras.proposing.proposal import Proposal
from hybrid_opt.front import polish, search
from symbolic.errors import DualArmError


def fastest_carry(cell: Cell, evaluations: int, rng: np.random.Generator) -> Carry:
    """Find the fastest carry of a cell's drivable variant, in which carries are timed from rest to
    rest within all limits, by a small study: one search and one polish.

    Args:
        cell: the cell, drivable or not.
        evaluations: number of candidates of the search.
        rng: generator of all random numbers.

    Raises:
        SettingsError: no feasible carry was found.
    """
    found = search(cell.drivable(), "nsga2", evaluations=evaluations, rng=rng)
    return polish(found, rng=rng).lowest("duration")


def rank_homotopy_classes(
    proposals: Sequence[Proposal],
    evaluations: int,
    rng: np.random.Generator,
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[list[Proposal], Table]:
    """Sort proposals by the duration of the fastest carry that a small study within each proposal's
    bounds finds.

    Args:
        proposals: proposals of different classes.
        evaluations: number of candidates of each search.
        rng: generator of all random numbers.
        tell: function that is called with a text on the current step.

    Returns:
        The proposals, fastest first, and a table of the durations.
    """
    rows = []
    for k, proposal in enumerate(proposals, 1):
        tell(f"study of carry {k} of {len(proposals)}")
        seconds = force = float("inf")
        with TemporaryDirectory() as folder:
            file = Path(folder) / "proposed.toml"
            file.write_text(proposal.text(file.parent), encoding="utf-8")
            try:
                fastest = fastest_carry(Cell.load(file), evaluations, rng)
                seconds, force = fastest.duration, float(fastest.peak_normal_force.max())
            except DualArmError:
                pass  # none that holds: it comes last
        rows.append((seconds, force, proposal))
    rows.sort(key=lambda row: row[0])
    header = ("passes", "start branches", "joints [rad]", "fastest [s]", "force [N]")
    cells = tuple(
        (
            proposal.passes,
            "{} and {}".format(*proposal.found.branches),
            number(proposal.length, 2),
            number(seconds, 2),
            number(force, 1),
        )
        for seconds, force, proposal in rows
    )
    note = f"Each class searched with {evaluations} carries and polished, as robots drive it."
    return [row[2] for row in rows], Table("classes", "Classes of carries", header, cells, note)
