"""One carry in the simulated cell: from which force on it holds, and how it presses."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import WitnessError
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, chosen_squeeze, extra_force
from hybrid_opt.timing.analysis import closest_to_reference_timing
from hybrid_opt.timing.solve import time_path
from hybrid_opt.witness.arms import ArmOutcome, CellWitness
from hybrid_opt.witness.controller import Control
from hybrid_opt.witness.outcome import Threshold
from hybrid_opt.witness.reference import Reference, carry_reference
from symbolic.array import Array

LOW, HIGH, BISECTIONS = 0.9, 1.5, 8
"""Factors between which a threshold is looked for, to about 0.2 %."""


@dataclass(frozen=True, eq=False)
class Pressed:
    """How a carry is pressed where it has to arrive.

    Attributes:
        reference: what the cell is told.
        squeeze: how its forces came about.
    """

    reference: Reference
    squeeze: Squeeze


@dataclass(frozen=True, eq=False)
class Account:
    """Simulations of one carry.

    Attributes:
        threshold: the least multiple of the planned forces that holds; None where there is none
            between `LOW` and `HIGH`.
        problem: why there is none, '' where there is.
        pressed: how it was pressed in the run that is shown.
        shown: that run.
    """

    threshold: Threshold[ArmOutcome] | None
    problem: str
    pressed: Pressed
    shown: ArmOutcome


def account_of(
    cell: Cell, carry: Carry, witness: CellWitness, control: Control = "leader", leader: int = 0
) -> Account:
    """Simulate a carry at its threshold, and as it would be pressed.

    Args:
        carry: from rest to rest.
        witness: of the cell.
        leader: index of the arm that keeps its place.

    Raises:
        SettingsError: the carry does not start and end at rest.
    """
    reference = carry_reference(cell, carry, leader=leader)
    threshold, problem = None, ""
    try:
        threshold = witness.threshold(reference, control, LOW, HIGH, BISECTIONS)
    except WitnessError as error:
        problem = str(error)
    pressed = pressed_reference(cell, carry, leader)
    shown = witness.simulate(pressed.reference, control)
    return Account(threshold, problem, pressed, shown)


def pressed_reference(cell: Cell, carry: Carry, leader: int = 0) -> Pressed:
    """As a job presses: with robust forces where the workcell states what is uncertain, smoothed so
    that controllers can follow them and never below what is needed."""
    squeeze = chosen_squeeze(cell.workcell, SqueezeSettings(leader=leader))
    extra = extra_force(cell.workcell, squeeze, carry.time, carry, carry.normal_force)
    press = carry.normal_force[:, 1 - leader] + extra
    return Pressed(carry_reference(cell, carry, press, leader), squeeze)


def driven_carry(cell: Cell, x: Array) -> Carry:
    """A decision vector's carry from rest to rest: the fastest within its force limit where it has
    one, else the closest to the reference speeds.

    Raises:
        WitnessError: there is none.
    """
    if cell.workcell.task.time_law == "optimal":
        timing = time_path(cell.timing_model, x, cell.timing_model.drive_limits(float(x[-1])))
    else:
        timing = closest_to_reference_timing(cell.timing_model, x)
    if not timing.ok or timing.carry is None:
        raise WitnessError(f"the trajectory cannot be driven: {timing.reason}")
    return timing.carry
