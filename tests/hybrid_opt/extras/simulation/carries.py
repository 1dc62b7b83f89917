"""Short carries with forces in closed form, for the witness, and its word on longer ones."""

from __future__ import annotations

import numpy as np

from hybrid_opt.carry import ArmMotion, Carry
from hybrid_opt.cell import Cell
from hybrid_opt.extras.simulation.box import BoxSimulation, drive_of, planned_moments
from hybrid_opt.extras.simulation.scene import SimulationSettings
from studies.research.plain.motion import angular_rates
from symbolic.array import Array
from symbolic.records import Workcell

SAMPLES = 101


def carry_along(workcell: Workcell, path: Array, duration: float) -> Carry:
    """A carry from rest to rest by path (6,), a pose's change, with as yet no forces.

    The motion is the quintic 10 s^3 - 15 s^4 + 6 s^5.
    """
    s = np.linspace(0.0, 1.0, SAMPLES)
    place = 10 * s**3 - 15 * s**4 + 6 * s**5
    speed = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
    growth = (60 * s - 180 * s**2 + 120 * s**3) / duration**2
    start = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    pose, rate, second = (
        start + np.outer(place, path),
        np.outer(speed, path),
        np.outer(growth, path),
    )
    turning = [
        angular_rates(*rows) for rows in zip(pose[:, 3:], rate[:, 3:], second[:, 3:], strict=True)
    ]
    none = np.zeros((SAMPLES, 6))
    arm = ArmMotion(none, none, none, none, none)
    return Carry(
        workcell=workcell,
        x=np.zeros(1),
        timing="limits",
        parameter=s,
        time=duration * s,
        pose=pose,
        rate=rate,
        second_rate=second,
        angular_velocity=np.array([omega for omega, _ in turning]),
        angular_acceleration=np.array([alpha for _, alpha in turning]),
        normal_force=np.zeros((SAMPLES, 2)),
        tangential_force=np.zeros((SAMPLES, 2)),
        contact_force=np.zeros((SAMPLES, 2, 3)),
        pressure_shift=np.zeros((SAMPLES, 2)),
        point_moment_residual=np.zeros((SAMPLES, 3)),
        moment_residual=np.zeros((SAMPLES, 3)),
        arms=(arm, arm),
    )


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
