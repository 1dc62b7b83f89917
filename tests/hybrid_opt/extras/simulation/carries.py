"""Short carries with forces in closed form, for the witness, and its word on longer ones."""

from __future__ import annotations

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.extras.simulation.box import BoxSimulation, drive_of, planned_moments
from hybrid_opt.extras.simulation.scene import SimulationSettings
from symbolic.array import Array


def least_forces(carry: Carry) -> Array:
    """(n, 2) N_1 and N_2 of a level box whose pads lie across y, in line with its centre."""
    payload, friction = carry.workcell.payload, carry.workcell.contacts[0].friction
    force = payload.mass * (carry.second_rate[:, :3] + [0.0, 0.0, 9.81])
    along = -force[:, 1]  # contact 1, on the +y face, presses towards -y
    total = np.hypot(force[:, 0], force[:, 2]) / friction
    assert (np.abs(along) <= total).all()
    return np.column_stack([total + along, total - along]) / 2.0


def assert_driven_pads_hold(cell: Cell, carry: Carry) -> None:
    """Pads at their rims, turned by the planned moments, hold with 5 % more than the plan, and not
    with as much less."""
    settings = SimulationSettings(pads="driven")
    witness = BoxSimulation(cell.workcell, settings)
    drive = drive_of(carry, settings, moments=planned_moments(cell, carry))
    assert witness.simulate(drive, 1.05).holds
    assert not witness.simulate(drive, 0.95).holds
