"""Forces that hold whatever the case: `python -m studies.robust FILE`."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hybrid_opt.campaign.recommended import set_text
from hybrid_opt.cell import Cell
from hybrid_opt.robust.force import USUAL, RobustModel, allowed_factor
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import TimingLimits, time_path
from studies.options import add_leader, force, seed, whole
from studies.program import Parser, program_of, run_program
from studies.text_table import number, text_table
from symbolic.array import Array
from symbolic.records import Uncertainty

PROGRAM = "python -m studies.robust"

EXIT_DOES_NOT_HOLD = 1

NOT_STATED = "a usual one, because the workcell states no [uncertainty]"


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM,
        description="The least commanded normal forces with which a stored trajectory holds for "
        "every case of its workcell's [uncertainty], or of a usual set without one, their price, "
        "the largest set that the reference forces allow, and random cases. Exit code 1 where one "
        "of them fails.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", help="a trajectory file")
    add_leader(parser)
    parser.add_argument(
        "--cases", type=whole(1, 10**7), default=100_000, help="random cases to check"
    )
    parser.add_argument(
        "--points", type=whole(2, 1000), default=9, help="points of the price curve"
    )
    parser.add_argument(
        "--force-limit",
        type=force,
        metavar="N",
        help="time the path as fast as forces below this allow, planned ones and those that hold "
        "in all cases (arm 1 leads)",
    )
    parser.add_argument("--seed", type=seed, default=1, help="of the random cases")
    return parser


def _run(options: argparse.Namespace) -> int:
    stored = read_trajectory(options.file)
    with TemporaryDirectory() as folder:
        cell = stored.open_cell(Path(folder))
        stated = not cell.workcell.uncertainty.is_empty
        uncertainty = cell.workcell.uncertainty if stated else USUAL
        carry = cell.carry(stored.x)
        limit = options.force_limit
        timed = [] if limit is None else _timed(cell, stored.x, limit, uncertainty)
    model, leader = RobustModel(cell.workcell), options.leader - 1
    reference = cell.workcell.task.reference_force
    held = model.robust_force(carry, uncertainty, leader)
    factors = np.linspace(0.0, 2.0, options.points)
    factors = factors[factors < allowed_factor(cell.workcell, uncertainty)]
    price = model.price(carry, factors, leader, uncertainty)
    largest = model.largest_factor(carry, reference, leader, uncertainty)
    check = model.check(carry, held, options.cases, np.random.default_rng(options.seed), threads=0)
    named = "the workcell's [uncertainty]" if stated else NOT_STATED
    print(f"{cell.workcell.name}: arm {options.leader} leads, the other's force is commanded")
    print(f"  the set is {named}: {set_text(uncertainty)}")
    print(f"  least peak forces, nothing uncertain {_both(held.nominal.max(axis=0))} N")
    print(f"  peak forces that hold in all cases   {_both(held.peak)} N")
    print(f"  reference forces                     {_both(reference)} N")
    multiple = f"{largest:.3f} times" if np.isfinite(largest) else "any multiple of"
    print(f"  they allow {multiple} the set")
    rows = [("times the set", "peak force 1 [N]", "peak force 2 [N]")]
    rows += [
        (number(factor, 2), number(peak[0], 2), number(peak[1], 2))
        for factor, peak in zip(factors, price, strict=True)
    ]
    print(f"\n{text_table(rows, left=())}")
    verdict = "all hold" if check.holds else f"{check.failing} FAIL"
    print(
        f"\n  {check.cases} random cases (seed {options.seed}): {verdict}; the hardest needs "
        f"{100.0 * check.closest:.2f} % of the commanded force"
    )
    for text in timed:
        print(f"  {text}")
    return 0 if check.holds else EXIT_DOES_NOT_HOLD


def _timed(cell: Cell, x: Array, limit: float, uncertainty: Uncertainty) -> list[str]:
    """How fast the path is within a force limit [N] on planned forces and on robust ones."""
    if cell.workcell.uncertainty.is_empty:
        cell = Cell(replace(cell.workcell, uncertainty=uncertainty))
    found = []
    for text, robust in (("planned forces", False), ("forces that hold in all cases", True)):
        timing = time_path(cell.timing_model, x, TimingLimits(force=limit, robust=robust))
        told = f"{timing.duration:.3f} s" if timing.ok else timing.reason
        found.append(f"{text} below {limit:g} N: {told}")
    return found


def _both(values: Array) -> str:
    return " / ".join(f"{value:.2f}" for value in values)


main = program_of(PROGRAM, _parser, _run)


if __name__ == "__main__":
    sys.exit(run_program(main))
