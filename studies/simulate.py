"""A simulator as witness of a stored trajectory: `python -m studies.simulate FILE`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import WitnessError
from hybrid_opt.store.files import AGAIN, storing
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import TimingLimits
from hybrid_opt.timing.analysis import closest_to_reference_timing
from hybrid_opt.timing.solve import time_path
from hybrid_opt.witness.reference import CONTROLS, driven_carry
from hybrid_opt.witness.scene import ArmSettings, SimulationSettings
from studies.options import add_leader, force, number, seed, whole
from studies.program import Parser, program_of, run_program
from studies.simulate_arms import simulate_arms
from studies.simulate_pads import simulate_pads
from symbolic.array import Array

PROGRAM = "python -m studies.simulate"

PADS = "pads"
"""The witness without arms, beside the controllers of those with them."""


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM,
        description="Drive a stored trajectory in MuJoCo, pressed with multiples of the planned "
        "normal forces: the least multiple that holds, when and where the box slips, and random "
        "cases of the workcell's [uncertainty] under its robust forces.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", help="a trajectory file")
    parser.add_argument(
        "--controller",
        choices=(PADS, *CONTROLS),
        default="leader",
        help="of the arms: one leads and the other is force-controlled along the normal (leader), "
        "both are (both), both are springs about the plan (impedance); or no arms, pads on a "
        "carriage that follows the plan exactly (pads)",
    )
    parser.add_argument(
        "--timing",
        choices=("search", "closest", "fastest"),
        default="search",
        help="how it is driven: as what it was searched for (within its force limit, or closest to "
        "the reference speeds where it has none), closest to them, or as fast as can be",
    )
    parser.add_argument("--force-limit", type=force, metavar="N", help="fastest below this force")
    add_leader(parser)
    parser.add_argument(
        "--runs", type=whole(0, 10**6), default=20, help="random cases of the uncertainty"
    )
    parser.add_argument("--seed", type=seed, default=1, help="of the random cases")
    parser.add_argument(
        "--tracking-error",
        type=number(0.0, 1.0),
        default=1e-4,
        metavar="RAD",
        help="amplitude of each joint's error in the random cases, a sinusoid of 0.3 to 1.5 Hz",
    )
    arms = ArmSettings()
    parser.add_argument(
        "--stiffness",
        type=number(1e-3, 1e9),
        default=arms.stiffness,
        metavar="1/RAD",
        help="of each joint over its largest torque",
    )
    parser.add_argument(
        "--time-step",
        type=number(1e-6, 1.0),
        metavar="S",
        help=f"{arms.time_step:g} with arms, {SimulationSettings().time_step:g} without",
    )
    parser.add_argument(
        "--contact-time", type=number(1e-5, 10.0), default=arms.contact_time, metavar="S"
    )
    parser.add_argument(
        "--sweep", action="store_true", help="the threshold at half and twice the time step, too"
    )
    parser.add_argument(
        "--film", metavar="FILE", help="write the simulated motion, .gif or .mp4 (with arms)"
    )
    parser.add_argument(
        "--mjcf", metavar="FILE", help="write the simulated cell as MuJoCo reads it (with arms)"
    )
    return parser


def _run(options: argparse.Namespace) -> int:
    if options.controller == PADS and (options.film or options.mjcf):
        raise WitnessError("films and MJCF files are of cells with arms; give another --controller")
    usual = SimulationSettings() if options.controller == PADS else ArmSettings()
    options.time_step = options.time_step or usual.time_step
    pads = SimulationSettings(options.time_step, options.contact_time)
    stored = read_trajectory(options.file)
    with TemporaryDirectory() as folder:
        cell = stored.open_cell(Path(folder))
        carry = _timed(cell, stored.x, options)
        peak = carry.peak_normal_force
        print(
            f"{cell.workcell.name}: {carry.duration:.2f} s, planned normal forces up to "
            f"{peak[0]:.2f} / {peak[1]:.2f} N; controller {options.controller}, arm "
            f"{options.leader} leads"
        )
        if options.controller == PADS:
            simulate_pads(cell, carry, pads, options)
            return 0
        arms = ArmSettings(
            time_step=options.time_step,
            control_period=max(options.time_step, ArmSettings().control_period),
            contact_time=options.contact_time,
            stiffness=options.stiffness,
        )
        text = simulate_arms(cell, carry, arms, options)
    if options.mjcf:
        path = Path(options.mjcf)
        with storing(path, AGAIN):
            path.write_text(text, encoding="utf-8")
        print(f"  cell written to {path}")
    return 0


def _timed(cell: Cell, x: Array, options: argparse.Namespace) -> Carry:
    model = cell.timing_model
    if options.force_limit is not None:
        timing = time_path(model, x, model.drive_limits(options.force_limit))
    elif options.timing == "fastest":
        timing = time_path(model, x, TimingLimits())
    elif options.timing == "search":
        return driven_carry(cell, x)
    else:
        timing = closest_to_reference_timing(model, x)
    if not timing.ok or timing.carry is None:
        raise WitnessError(f"the trajectory cannot be driven: {timing.reason}")
    return timing.carry


main = program_of(PROGRAM, _parser, _run)


if __name__ == "__main__":
    sys.exit(run_program(main))
