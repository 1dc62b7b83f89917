"""The witness against closed forms: what holds at rest and in short motions, and what turns."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from hybrid_opt.carry import Carry
from hybrid_opt.errors import WitnessError
from hybrid_opt.robust.cases import nominal_case
from hybrid_opt.robust.force import soft_model
from hybrid_opt.witness.box import (
    PlannedMoments,
    Witness,
    drive_of,
    witness_of_case,
    workcell_of_case,
)
from hybrid_opt.witness.scene import SimulationSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from tests.hybrid_opt.witness.carries import carry_along, least_forces
from tests.symbolic.cells import hand_cell, with_contacts

STILL = np.zeros(6)


def planned(path: Array, duration: float = 0.4, friction: float = 1.0) -> Carry:
    cell = with_contacts(hand_cell(), friction=(friction, friction))
    carry = carry_along(cell, path, duration)
    return replace(carry, normal_force=least_forces(carry))


def threshold(carry: Carry, steps: int = 5, leader: int = 0) -> float:
    witness = Witness(carry.workcell)
    drive = drive_of(carry, witness.settings, leader=leader)
    return witness.threshold(drive, 0.95, 1.05, steps).factor


@pytest.mark.parametrize("friction", [1.0, 0.3])
def test_a_box_at_rest_slips_below_the_least_force(friction: float) -> None:
    """N = m g / (2 mu), within 0.5 %."""
    assert threshold(planned(STILL, friction=friction)) == pytest.approx(1.0, abs=0.005)


def test_pads_that_tilt_hold_as_well_and_follow_their_moments() -> None:
    """Pads that only springs keep upright need no more force; moments that oppose one another move
    both centres of pressure, not the box."""
    carry = planned(STILL)
    settings = SimulationSettings(tilt_stiffness=300.0)
    witness = Witness(carry.workcell, settings)
    assert witness.threshold(drive_of(carry, settings), 0.95, 1.05, 4).factor == pytest.approx(
        1.0, abs=0.005
    )
    turned = []
    for moment in (0.0, 0.5, 1.0):
        # About the box's z axis: the pressure moves to one side of both pads.
        at_rest = np.array([[0.0, 0.0, moment], [0.0, 0.0, -moment]])
        moments = PlannedMoments(np.tile(at_rest, (len(carry), 1, 1)), at_rest)
        outcome = witness.simulate(drive_of(carry, settings, moments=moments), 1.5)
        assert outcome.holds
        turned.append(outcome.turn.max())
    assert max(turned) < 1e-3


@pytest.mark.parametrize("leader", [0, 1])
def test_a_lifted_box_slips_below_the_least_force(leader: int) -> None:
    """Up to 2.9 m/s^2 upwards, which needs a third more."""
    carry = planned(np.array([0.0, 0.0, 0.08, 0.0, 0.0, 0.0]))
    assert carry.peak_normal_force[0] > 1.25 * 49.05
    assert threshold(carry, leader=leader) == pytest.approx(1.0, abs=0.01)


def test_a_box_moved_across_slips_below_the_least_force() -> None:
    carry = planned(np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert threshold(carry) == pytest.approx(1.0, abs=0.01)


def test_a_turning_box_stays_with_its_pads_when_pressed_well() -> None:
    """Turned and moved at once, the box neither slips nor turns on the carriage."""
    path = np.array([0.05, 0.03, 0.05, 0.2, -0.15, 0.3])
    carry = carry_along(hand_cell(), path, 0.8)
    carry = replace(carry, normal_force=np.full((len(carry), 2), 120.0))
    witness = Witness(carry.workcell)
    outcome = witness.simulate(drive_of(carry, witness.settings))
    assert outcome.holds
    assert outcome.time[-1] == pytest.approx(carry.duration, abs=2e-3)
    assert outcome.slip.max() < 1e-4
    assert outcome.turn.max() < 2e-3
    assert outcome.begins(1e-3) == float("inf")


def test_too_little_force_is_told_with_pad_and_time() -> None:
    carry = planned(STILL)
    witness = Witness(carry.workcell)
    outcome = witness.simulate(drive_of(carry, witness.settings), 0.5)
    assert not outcome.holds
    assert outcome.begins(1e-3) <= outcome.time[-1]
    assert outcome.slip[-1, outcome.pad] > 1e-3


def test_a_case_weighs_and_rubs_as_it_says() -> None:
    """Twenty percent more mass with ten percent less friction needs 1.2 / 0.9 times the force."""
    carry = planned(STILL)
    case = nominal_case(carry.workcell)
    case[0:2] *= 0.9
    case[4] *= 1.2
    witness = witness_of_case(carry.workcell, case)
    drive = drive_of(carry, witness.settings)
    assert not witness.simulate(drive, 0.99 * 1.2 / 0.9).holds
    assert witness.simulate(drive, 1.01 * 1.2 / 0.9).holds


def test_a_disturbance_acts_as_an_acceleration() -> None:
    carry = planned(STILL)
    case = nominal_case(carry.workcell)
    case[10] = 2.0
    witness = witness_of_case(carry.workcell, case)
    drive = drive_of(carry, witness.settings)
    assert not witness.simulate(drive, 0.99 * 11.81 / 9.81).holds
    assert witness.simulate(drive, 1.01 * 11.81 / 9.81).holds


def test_a_case_moves_pads_and_mass() -> None:
    cell = hand_cell()
    case = nominal_case(cell)
    case[5:8] = [0.01, 0.0, 0.0]
    case[11:15] = [0.002, 0.0, 0.0, 0.003]
    found = workcell_of_case(cell, case)
    plane = cell.contacts[0].T_box_pad[:3, :2]
    for i, by in enumerate((plane @ [0.002, 0.0], plane @ [0.0, 0.003])):
        moved = found.contacts[i].T_box_pad[:3, 3] - cell.contacts[i].T_box_pad[:3, 3]
        np.testing.assert_allclose(moved, by, atol=1e-15)
    np.testing.assert_array_equal(found.payload.centre_of_mass, [0.01, 0.0, 0.0])
    # Known about the nominal centre of mass: about the true one there is less, m d^2 across d.
    less = cell.payload.inertia - found.payload.inertia
    np.testing.assert_allclose(less, 10.0 * 1e-4 * np.diag([0.0, 1.0, 1.0]), atol=1e-12)


def test_misuse_is_told() -> None:
    carry = planned(STILL)
    witness = Witness(carry.workcell)
    drive = drive_of(carry, witness.settings)
    with pytest.raises(WitnessError, match=r"holds at 1\.5"):
        witness.threshold(drive, 1.5, 2.0, 1)
    with pytest.raises(SettingsError, match="two time steps"):
        SimulationSettings(time_step=0.01)
    with pytest.raises(SettingsError, match="stiffness of the pads"):
        SimulationSettings(tilt_stiffness=0.0)
    with pytest.raises(SettingsError, match="start and end at rest"):
        drive_of(replace(carry, rate=np.ones((len(carry), 6))), witness.settings)
    with pytest.raises(SettingsError, match="samples"):
        drive_of(carry, witness.settings, np.ones(3))


def test_without_the_simulator_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(WitnessError, match="pip install"):
        Witness(hand_cell())


@pytest.mark.parametrize(
    "path",
    [
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.25, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.15, 0.0, 0.3, 0.0),
        (0.1, 0.05, 0.1, 0.1, 0.2, 0.1),
    ],
)
def test_pads_that_press_evenly_slip_below_the_soft_finger_force(path: tuple[float, ...]) -> None:
    """Nothing of the plan but the motion and the force is known to the simulator: points all over
    the pads share pressure, friction and torsion as they come, orientation is kept."""
    cell = hand_cell()
    raised = [contact.T_box_pad.copy() for contact in cell.contacts]
    for T in raised:
        T[2, 3] = 0.05
    first, second = (
        replace(contact, T_box_pad=T) for contact, T in zip(cell.contacts, raised, strict=True)
    )
    carry = carry_along(replace(cell, contacts=(first, second)), np.array(path), 0.5)
    press = soft_model(carry.workcell).nominal(carry)[:, 1]
    settings = SimulationSettings(pads="even", points=37)
    witness = Witness(carry.workcell, settings)
    found = witness.threshold(drive_of(carry, settings, press), 0.9, 1.1, 5)
    assert found.factor == pytest.approx(1.0, abs=0.03)
