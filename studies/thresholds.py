"""Slip thresholds of many carries in the simulator: `python -m studies.thresholds`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.timing import TimingLimits
from hybrid_opt.timing.solve import time_path
from hybrid_opt.witness.drive import drive_of
from hybrid_opt.witness.scene import SimulationSettings
from hybrid_opt.witness.simulate import Witness
from studies.cli import Parser
from studies.options import seed, whole
from studies.program import program_of, run_program
from symbolic.array import Array
from symbolic.workcell.decision import initial_decision

PROGRAM = "python -m studies.thresholds"

CELLS = ("rack", "transfer")
FRICTIONS = (1.0, 0.6, 0.3)
TIMINGS = {
    "closest": TimingLimits(reference_speed=True),
    "55 N": TimingLimits(force=55.0),
    "fastest": TimingLimits(),
}
DRAWN = 400
"""Random candidates among which feasible ones are looked for at a time."""

LOW, HIGH, BISECTIONS = 0.95, 1.2, 5


@dataclass(frozen=True)
class Case:
    """One carry to simulate: where it comes from, and the friction that it is pressed for."""

    cell: str
    candidate: str
    timing: str
    friction: float
    carry: Carry


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM,
        description="The least multiple of the planned normal forces with which the box does not "
        "slip in MuJoCo, for hand-made and random feasible trajectories of both cells under "
        "several timings and frictions.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--carries", type=whole(1, 10**6), default=40, help="how many, in turn of all kinds"
    )
    parser.add_argument("--seed", type=seed, default=1, help="of the random candidates")
    return parser


def _run(options: argparse.Namespace) -> int:
    settings = SimulationSettings()
    found: list[float] = []
    rng = np.random.default_rng(options.seed)
    print("cell      candidate   timing   friction  force [N]  threshold  begins [s]")
    for case in _cases(rng):
        if len(found) >= options.carries:
            break
        witness = Witness(case.carry.workcell, settings)
        threshold = witness.threshold(drive_of(case.carry, settings), LOW, HIGH, BISECTIONS)
        found.append(threshold.factor)
        print(
            f"{case.cell:9} {case.candidate:11} {case.timing:8} {case.friction:8.2f}  "
            f"{case.carry.peak_normal_force.max():9.2f}  {threshold.factor:9.4f}  "
            f"{threshold.slips.begins(settings.slip):10.3f}",
            flush=True,
        )
    away = np.abs(np.array(found) - 1.0)
    print(
        f"{len(found)} carries: median {np.median(found):.4f}, from {min(found):.4f} to "
        f"{max(found):.4f}; {int((away <= 0.03).sum())} within 3 % of 1"
    )
    return 0


def _cases(rng: np.random.Generator) -> Iterator[Case]:
    """Endless: a hand-made trajectory of each cell, then random ones, one timing and friction each
    in turn."""
    folder = Path(__file__).parent / "workcells"
    cells = {name: Cell.load(folder / f"{name}.toml") for name in CELLS}
    turn = 0
    while True:
        for name, cell in cells.items():
            label, candidates = "hand-made", initial_decision(cell.workcell.task)[None]
            if turn:
                label, candidates = "random", _feasible(cell, rng)
            for x in candidates:
                for timing, limits in TIMINGS.items():
                    timed = time_path(cell.timing_model, x, limits)
                    if not timed.ok or timed.carry is None:
                        continue
                    for friction in FRICTIONS:
                        yield Case(
                            name, label, timing, friction, _pressed(cell, timed.carry, friction)
                        )
        turn += 1


def _feasible(cell: Cell, rng: np.random.Generator) -> Array:
    """(1, n_var) a feasible candidate drawn evenly from the bounds."""
    while True:
        x = rng.uniform(cell.lower, cell.upper, (DRAWN, cell.n_var))
        feasible = np.flatnonzero(cell.evaluate(x).feasible)
        if len(feasible):
            return x[feasible[:1]]


def _pressed(cell: Cell, carry: Carry, friction: float) -> Carry:
    """The carry in a cell of another friction, with the forces planned for it."""
    workcell = cell.workcell
    first, second = (replace(contact, friction=friction) for contact in workcell.contacts)
    load = cell.timing_model.uncertain_load(
        carry, np.full(2, friction), workcell.payload.centre_of_mass
    )
    return replace(
        carry,
        workcell=replace(workcell, contacts=(first, second)),
        normal_force=load["normal_force"],
    )


main = program_of(PROGRAM, _parser, _run)


if __name__ == "__main__":
    sys.exit(run_program(main))
