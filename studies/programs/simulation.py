"""What `studies.simulate` does: a stored trajectory under its controllers, or on pads alone."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import WitnessError
from hybrid_opt.robust.cases import nominal_case, random_cases
from hybrid_opt.robust.force import RobustModel
from hybrid_opt.store.files import AGAIN, storing
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import TimingLimits
from hybrid_opt.timing.analysis import closest_to_reference_timing
from hybrid_opt.timing.solve import time_path
from hybrid_opt.witness.arms import BISECTIONS, HIGH, LOW, ArmOutcome, CellWitness, account_of
from hybrid_opt.witness.box import (
    Shown,
    Threshold,
    Witness,
    drive_of,
    witness_of_case,
    workcell_of_case,
)
from hybrid_opt.witness.reference import (
    Control,
    Reference,
    carry_reference,
    driven_carry,
    with_tracking_error,
)
from hybrid_opt.witness.scene import ArmSettings, SimulationSettings
from studies.report.animation import Film, write_animation
from studies.simulate import PADS
from symbolic.array import Array
from symbolic.records import Workcell


def simulate_arms(
    cell: Cell, carry: Carry, settings: ArmSettings, options: argparse.Namespace
) -> str:
    """The threshold of a carry and random cases, printed; returns the cell as MJCF.

    Raises:
        WitnessError: with --sweep, the box holds at the lower or slips at the upper factor.
    """
    control, leader = options.controller, options.leader - 1
    witness = CellWitness(cell.workcell, settings)
    reference = carry_reference(cell, carry, leader=leader)
    found = account_of(cell, carry, witness, control, leader)
    threshold = found.threshold
    print(f"  {found.problem}" if threshold is None else threshold_text(threshold, settings.slip))
    if options.sweep:
        for factor in (0.5, 2.0):
            step = factor * settings.time_step
            period = max(step, settings.control_period)
            other = replace(settings, time_step=step, control_period=period)
            swept = CellWitness(cell.workcell, other).threshold(
                reference, control, LOW, HIGH, BISECTIONS
            )
            print(f"  with a time step of {step:g} s: {swept.factor:.4f}")
    peak = found.reference.normal_force.max(axis=0)
    print(f"  pressed up to {peak[0]:.2f} / {peak[1]:.2f} N, {found.squeeze}:")
    _tell(found.shown, carry)
    if found.squeeze.uncertainty is not None:
        _cases(cell, found.reference, settings, options)
        rubs_less = CellWitness(
            workcell_of_case(cell.workcell, worst_friction(cell.workcell)), settings
        )
        least = rubs_less.simulate(reference, control)
        word = "hold" if least.holds else "slip"
        print(f"  least forces with the set's worst friction: {word}")
    if options.film:
        _film(cell, found.shown, Path(options.film))
    return witness.text


def _tell(outcome: ArmOutcome, carry: Carry) -> None:
    during = outcome.time >= carry.time[0]
    missing = (outcome.normal_force / outcome.normal_force_reference)[during] - 1.0
    print(
        f"  the box "
        f"{'arrives' if outcome.arrives else 'does NOT arrive'}: slip up to "
        f"{1e3 * outcome.slip.max():.3f} mm, {1e3 * outcome.misses:.2f} mm from its goal; normal "
        f"forces within {100.0 * np.abs(missing).max():.1f} % of their reference, rms "
        f"{100.0 * np.sqrt((missing**2).mean()):.2f} %; joints off by up to "
        f"{1e3 * np.abs(outcome.tracking_error[during]).max():.2f} mrad; torques up to "
        f"{100.0 * outcome.torque_use.max():.0f} % of the largest"
    )


def _cases(
    cell: Cell, pressed: Reference, settings: ArmSettings, options: argparse.Namespace
) -> None:
    """Random cases with tracking errors under the robust force."""
    workcell, rng = cell.workcell, np.random.default_rng(options.seed)
    control: Control = options.controller
    slips = []
    arrived = 0
    for case in random_cases(workcell, workcell.uncertainty, options.runs, rng):
        witness = CellWitness(workcell_of_case(workcell, case), settings, case[8:11])
        told = with_tracking_error(pressed, options.tracking_error, rng)
        outcome = witness.simulate(told, control)
        arrived += outcome.arrives
        slips.append(outcome.slip.max())
    print(
        f"  {arrived} of {len(slips)} random cases arrive (seed {options.seed}, joints off by up "
        f"to {options.tracking_error:g} rad); slip up to {1e3 * max(slips):.3f} mm"
    )


def _film(cell: Cell, outcome: ArmOutcome, path: Path) -> None:
    angles: Array = Rotation.from_matrix(outcome.box_rotation).as_euler("xyz")
    pose = np.concatenate([outcome.box_position, angles], axis=1)
    label = f"simulated, {outcome.factor:g} times the force"
    write_animation(cell.geometry, Film(label, outcome.time, pose, outcome.q), path)
    print(f"  film written to {path}")


PAD_BISECTIONS = 9
"""Of the factors of pads without arms, to about 0.1 %."""

CREEP_FACTOR = 1.05


def simulate_pads(
    cell: Cell, carry: Carry, settings: SimulationSettings, options: argparse.Namespace
) -> None:
    """The threshold of a carry, its creep, and random cases, printed."""
    leader = options.leader - 1
    witness = Witness(cell.workcell, settings)
    drive = drive_of(carry, settings, leader=leader)
    print(threshold_text(witness.threshold(drive, LOW, HIGH, PAD_BISECTIONS), settings.slip))
    creep = witness.simulate(drive, CREEP_FACTOR)
    if creep.holds:
        rate = creep.slip[-1].max() / carry.duration
        print(f"  at {CREEP_FACTOR:g} times the force the box creeps {1e6 * rate:.2f} um/s")
    if options.sweep:
        for factor in (0.5, 2.0):
            other = SimulationSettings(factor * options.time_step, options.contact_time)
            swept = Witness(cell.workcell, other)
            found = swept.threshold(
                drive_of(carry, other, leader=leader), LOW, HIGH, PAD_BISECTIONS
            )
            print(f"  with a time step of {other.time_step:g} s: {found.factor:.4f}")
    if not cell.workcell.uncertainty.is_empty:
        _pad_cases(cell, carry, settings, options)


def threshold_text(threshold: Threshold[Shown], slip: float) -> str:
    """One line: the factors on both sides, and where and when the box slips."""
    slips, holds = threshold.slips, threshold.holds
    return (
        f"  holds from {holds.factor:.4f} times the planned force on, slips at {slips.factor:.4f}: "
        f"at pad {slips.pad + 1}, beginning {slips.begins(slip):.3f} s, beyond "
        f"{1e3 * slip:g} mm at {slips.time[-1]:.3f} s, turned {slips.turn[-1]:.4f} rad"
    )


def worst_friction(workcell: Workcell) -> Array:
    """(15,) the nominal case with the set's worst friction."""
    case = nominal_case(workcell)
    case[0:2] *= 1.0 - workcell.uncertainty.friction
    return case


def _pad_cases(
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
    least = drive_of(carry, settings, leader=leader)
    outcome = witness_of_case(workcell, worst_friction(workcell), settings).simulate(least)
    print(f"  least forces with the set's worst friction: {'hold' if outcome.holds else 'slip'}")


def simulate_file(options: argparse.Namespace) -> int:
    """Drive a trajectory file in the simulator and print what happens; returns the exit code."""
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
