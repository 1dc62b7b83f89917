"""`studies.simulate` with arms: a whole cell under its controllers."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.robust.cases import random_cases
from hybrid_opt.witness.arms import BISECTIONS, HIGH, LOW, ArmOutcome, CellWitness, account_of
from hybrid_opt.witness.box import workcell_of_case
from hybrid_opt.witness.reference import Control, Reference, carry_reference, with_tracking_error
from hybrid_opt.witness.scene import ArmSettings
from studies.report.animation import Film, write_animation
from studies.simulate_pads import threshold_text, worst_friction
from symbolic.array import Array


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
