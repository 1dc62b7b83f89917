"""A simulator as witness of a stored trajectory: `python -m studies.simulate FILE`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import WitnessError
from hybrid_opt.robust.cases import random_cases, worst_cases
from hybrid_opt.robust.force import RobustModel
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import TimingLimits
from hybrid_opt.timing.analysis import closest_to_reference_timing
from hybrid_opt.timing.solve import time_path
from hybrid_opt.witness.cases import witness_of_case
from hybrid_opt.witness.drive import drive_of
from hybrid_opt.witness.outcome import Outcome, Threshold
from hybrid_opt.witness.scene import SimulationSettings
from hybrid_opt.witness.simulate import Witness
from studies.program import carried_out, run_program
from symbolic.array import Array

PROGRAM = "python -m studies.simulate"

LOW, HIGH, BISECTIONS = 0.9, 1.5, 9
"""Factors between which a threshold is looked for, to about 0.1 %."""

CREEP_FACTOR = 1.05


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Drive the box of a stored trajectory between two pads in MuJoCo, pressed "
        "with multiples of the planned normal force: the least multiple that holds, when and "
        "where the box slips, and random cases of the workcell's [uncertainty] under its robust "
        "force.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", help="a trajectory file")
    parser.add_argument(
        "--timing", choices=("closest", "fastest"), default="closest", help="how it is driven"
    )
    parser.add_argument("--force-limit", type=float, metavar="N", help="fastest below this force")
    parser.add_argument(
        "--leader", type=int, choices=(1, 2), default=1, help="the arm that keeps its place"
    )
    parser.add_argument("--runs", type=int, default=20, help="random cases of the uncertainty")
    parser.add_argument("--seed", type=int, default=1, help="of the random cases")
    default = SimulationSettings()
    parser.add_argument("--time-step", type=float, default=default.time_step, metavar="S")
    parser.add_argument("--contact-time", type=float, default=default.contact_time, metavar="S")
    parser.add_argument(
        "--sweep", action="store_true", help="the threshold at half and twice the time step, too"
    )
    return parser


@carried_out(PROGRAM)
def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate one trajectory; returns the exit code."""
    return _run(_parser().parse_args(arguments))


def _run(options: argparse.Namespace) -> int:
    settings = SimulationSettings(options.time_step, options.contact_time)
    stored = read_trajectory(options.file)
    with TemporaryDirectory() as folder:
        cell = Cell(stored.unpack(Path(folder)))
        carry = _timed(cell, stored.x, options)
    leader = options.leader - 1
    peak = carry.peak_normal_force
    print(
        f"{cell.workcell.name}: {carry.duration:.2f} s, planned normal forces up to "
        f"{peak[0]:.2f} / {peak[1]:.2f} N; arm {options.leader} leads, the other's force is pressed"
    )
    witness = Witness(cell.workcell, settings)
    drive = drive_of(carry, settings, leader=leader)
    _tell(witness.threshold(drive, LOW, HIGH, BISECTIONS), settings)
    creep = witness.simulate(drive, CREEP_FACTOR)
    if creep.holds:
        rate = creep.slip[-1].max() / carry.duration
        print(f"  at {CREEP_FACTOR:g} times the force the box creeps {1e6 * rate:.2f} um/s")
    if options.sweep:
        for factor in (0.5, 2.0):
            other = SimulationSettings(factor * options.time_step, options.contact_time)
            swept = Witness(cell.workcell, other)
            found = swept.threshold(drive_of(carry, other, leader=leader), LOW, HIGH, BISECTIONS)
            print(f"  with a time step of {other.time_step:g} s: {found.factor:.4f}")
    ranges = cell.workcell.uncertainty
    if max(ranges.friction, ranges.mass, *ranges.centre_of_mass, *ranges.disturbance) > 0.0:
        _cases(cell, carry, settings, options)
    return 0


def _timed(cell: Cell, x: Array, options: argparse.Namespace) -> Carry:
    model = cell.timing_model
    if options.force_limit is not None:
        timing = time_path(model, x, TimingLimits(force=options.force_limit))
    elif options.timing == "fastest":
        timing = time_path(model, x, TimingLimits())
    else:
        timing = closest_to_reference_timing(model, x)
    if not timing.ok or timing.carry is None:
        raise WitnessError(f"the trajectory cannot be driven: {timing.reason}")
    return timing.carry


def _tell(threshold: Threshold[Outcome], settings: SimulationSettings) -> None:
    slips, holds = threshold.slips, threshold.holds
    print(
        f"  holds from {holds.factor:.4f} times the planned force on, slips at {slips.factor:.4f}: "
        f"at pad {slips.pad + 1}, beginning {slips.begins(settings.slip):.3f} s, beyond "
        f"{1e3 * settings.slip:g} mm at {slips.time[-1]:.3f} s, turned {slips.turn[-1]:.4f} rad"
    )


def _cases(
    cell: Cell, carry: Carry, settings: SimulationSettings, options: argparse.Namespace
) -> None:
    """Random cases under the robust force, and the set's worst friction under the least force."""
    workcell, leader = cell.workcell, options.leader - 1
    force = RobustModel(workcell).robust_force(carry, leader=leader)
    drive = drive_of(carry, settings, force.commanded, leader)
    cases = random_cases(
        workcell, workcell.uncertainty, options.runs, np.random.default_rng(options.seed)
    )
    held = sum(witness_of_case(workcell, case, settings).simulate(drive).holds for case in cases)
    print(
        f"  robust forces up to {force.peak[0]:.2f} / {force.peak[1]:.2f} N: {held} of "
        f"{len(cases)} random cases hold (seed {options.seed})"
    )
    worst = worst_cases(workcell, workcell.uncertainty)[0]
    worst[2:4] = [contact.patch_radius for contact in workcell.contacts]
    worst[4:8] = [workcell.payload.mass, *workcell.payload.centre_of_mass]
    worst[8:] = 0.0
    least = drive_of(carry, settings, leader=leader)
    outcome = witness_of_case(workcell, worst, settings).simulate(least)
    print(f"  least forces with the set's worst friction: {'hold' if outcome.holds else 'slip'}")


if __name__ == "__main__":
    sys.exit(run_program(main))
