"""`studies.simulate` without arms: pads on a carriage that follows the plan exactly."""

from __future__ import annotations

import argparse

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.robust.cases import nominal_case, random_cases
from hybrid_opt.robust.force import RobustModel
from hybrid_opt.witness.box import Shown, Threshold, Witness, drive_of, witness_of_case
from hybrid_opt.witness.scene import SimulationSettings
from symbolic.array import Array
from symbolic.records import Workcell

LOW, HIGH, BISECTIONS = 0.9, 1.5, 9
"""Factors between which a threshold is looked for, to about 0.1 %."""

CREEP_FACTOR = 1.05


def simulate_pads(
    cell: Cell, carry: Carry, settings: SimulationSettings, options: argparse.Namespace
) -> None:
    """The threshold of a carry, its creep, and random cases, printed."""
    leader = options.leader - 1
    witness = Witness(cell.workcell, settings)
    drive = drive_of(carry, settings, leader=leader)
    print(threshold_text(witness.threshold(drive, LOW, HIGH, BISECTIONS), settings.slip))
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
    if not cell.workcell.uncertainty.is_empty:
        _cases(cell, carry, settings, options)


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
    least = drive_of(carry, settings, leader=leader)
    outcome = witness_of_case(workcell, worst_friction(workcell), settings).simulate(least)
    print(f"  least forces with the set's worst friction: {'hold' if outcome.holds else 'slip'}")
