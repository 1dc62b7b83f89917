"""The witness against closed forms: at rest and in short motions, also by other pads, what turns,
and what is said of it."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache, partial

import mujoco
import numpy as np
import pytest

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.simulation.arms import CarrySimulation, CellSimulation
from hybrid_opt.extras.simulation.box import BoxSimulation, bisected, drive_of, workcell_of_case
from hybrid_opt.extras.simulation.reference import driven_carry, pressed_reference
from hybrid_opt.extras.simulation.scene import (
    SimulationSettings,
    compiled,
    patch_area,
    scene_text,
    tilt_centre,
)
from hybrid_opt.robust.cases import nominal_case
from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.squeeze import SqueezeSettings, commanded_forces
from studies.research.hand_carries import carry_along
from studies.study.simulation import MOST_SAMPLES, stored_simulation
from symbolic.array import Array
from symbolic.contact.load import load_function
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.simulation.carries import least_forces
from tests.refusals import refused
from tests.symbolic.cells import (
    call,
    hand_cell,
    with_contacts,
    with_payload,
)

STILL = np.zeros(6)
DRIVEN = SimulationSettings(pads="driven")


def planned(path: Array, duration: float = 0.4, friction: float = 1.0) -> Carry:
    cell = with_contacts(hand_cell(), friction=(friction, friction))
    carry = carry_along(cell, path, duration)
    return replace(carry, normal_force=least_forces(carry))


def threshold(
    carry: Carry,
    settings: SimulationSettings | None = None,
    leader: int = 0,
    disturbance: Array = STILL[:3],
    moments: Array | None = None,
) -> float:
    witness = BoxSimulation(carry.workcell, settings, disturbance)
    drive = drive_of(carry, witness.settings, leader=leader, moments=moments)
    return bisected(partial(witness.simulate, drive), 0.9, 1.1, 5).factor


def of_case(carry: Carry, case: Array) -> BoxSimulation:
    return BoxSimulation(workcell_of_case(carry.workcell, case), disturbance=case[8:11])


@pytest.mark.parametrize("settings", [SimulationSettings(), DRIVEN])
@pytest.mark.parametrize("friction", [1.0, 0.3])
def test_a_box_at_rest_slips_below_the_least_force(
    friction: float, settings: SimulationSettings
) -> None:
    """N = m g / (2 mu); driven pads, which only springs keep upright, need no more."""
    assert threshold(planned(STILL, friction=friction), settings) == pytest.approx(1.0, abs=0.006)


def test_moments_that_oppose_one_another_move_pressures_not_the_box() -> None:
    carry = planned(STILL)
    witness, turned = BoxSimulation(carry.workcell, DRIVEN), []
    for moment in (0.0, 0.5, 1.0):
        # About the box's z axis: the pressure moves to one side of both pads.
        moments = np.tile([[0.0, 0.0, moment], [0.0, 0.0, -moment]], (len(carry) + 1, 1, 1))
        outcome = witness.simulate(drive_of(carry, DRIVEN, moments=moments), 1.5)
        assert outcome.holds
        turned.append(outcome.turn.max())
    assert max(turned) < 1e-3


@pytest.mark.parametrize(("axis", "leader"), [(2, 0), (2, 1), (0, 0)])
def test_a_moved_box_slips_below_the_least_force(axis: int, leader: int) -> None:
    """Up to 2.9 m/s^2 upwards, which needs a third more, or across."""
    carry = planned(0.08 * np.eye(6)[axis])
    assert carry.peak_normal_force[0] > (1.25 if axis == 2 else 1.0) * 49.05
    assert threshold(carry, leader=leader) == pytest.approx(1.0, abs=0.01)


def raised(by: float = 0.05, friction: float = 1.0) -> Workcell:
    """The hand-written cell with its pads above the centre of mass."""
    cell = with_contacts(hand_cell(), friction=(friction, friction))
    places = [contact.T_box_pad.copy() for contact in cell.contacts]
    for T in places:
        T[2, 3] = by
    first, second = (
        replace(contact, T_box_pad=T) for contact, T in zip(cell.contacts, places, strict=True)
    )
    return replace(cell, contacts=(first, second))


@pytest.mark.parametrize(
    ("acceleration", "tilt", "friction"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0), 1.0),
        ((4.0, 0.0, 0.0), (0.0, 0.0), 1.0),
        ((4.0, 0.0, 0.0), (0.0, 0.0), 0.5),
        ((0.0, 2.0, 0.0), (0.0, 0.0), 0.5),
        ((0.0, 0.0, 4.0), (0.0, 0.0), 0.5),
        ((0.0, 0.0, 0.0), (0.3, 0.0), 1.0),
        ((0.0, 0.0, 0.0), (0.0, 0.8), 1.0),
        ((3.0, 1.0, 1.0), (0.2, 0.4), 1.0),
    ],
)
def test_statics_of_pads_that_press_evenly(
    acceleration: tuple[float, ...], tilt: tuple[float, float], friction: float
) -> None:
    """Constant accelerations along each axis, roll and pitch. Nothing of the plan but the force is
    known to the simulator: points all over the pads share pressure, friction and torsion as they
    come, orientation is kept. About the pads' line alone, the force is also the fit of the exact
    disc by N1 + N2 = |(F_t, 1.5 tau / r)|_p / mu, p = 1.7. What gives way turns towards where it
    would hang: slips count from 0.1 mm on."""
    cell = raised(friction=friction)
    carry = carry_along(cell, STILL, 0.3)
    pose = carry.pose.copy()
    pose[:, 3:5] = tilt
    carry = replace(carry, pose=pose)
    case = nominal_case(cell)
    case[8:11] = acceleration
    force = robust_model(cell).least_squeeze(carry, case[None])[0]
    if not (acceleration[1] or tilt[0]):
        pulled = np.add(acceleration, [0.0, 0.0, 9.81])
        along = np.array([np.cos(tilt[1]), -np.sin(tilt[1])]) @ pulled[[0, 2]]
        torsion = 1.5 * 0.05 * 10.0 * along / cell.contacts[0].patch_radius
        both = np.array([10.0 * np.linalg.norm(pulled), torsion])
        by_hand = (np.abs(both) ** 1.7).sum() ** (1.0 / 1.7) / friction
        np.testing.assert_allclose(force.sum(axis=1), by_hand, rtol=0.012)
    carry = replace(carry, normal_force=force)
    settings = SimulationSettings(slip=1e-4, settle=0.04)
    found = threshold(carry, settings, disturbance=np.array(acceleration))
    assert found == pytest.approx(1.0, abs=0.025)


def test_pads_on_adjacent_faces_hold_at_rest_from_the_least_force_on() -> None:
    """Where little more than the least force would stop a box that falls until they press."""
    carry, _ = at_rest(shipped("corner").workcell)
    assert threshold(carry) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    "path", [(0.25, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.15, 0.0, 0.3, 0.0), (0.1, 0.05) * 3]
)
def test_carries_of_pads_that_press_evenly(path: tuple[float, ...]) -> None:
    carry = carry_along(raised(), np.array(path), 0.5)
    carry = replace(carry, normal_force=robust_model(carry.workcell).nominal(carry))
    assert threshold(carry) == pytest.approx(1.0, abs=0.02)


def test_a_pad_gives_as_its_layer_says() -> None:
    cell, settings = hand_cell(), SimulationSettings()
    model, text = compiled(mujoco, scene_text(cell, settings, 0, np.zeros(3)))
    assert mujoco.MjModel.from_xml_string(text).nv == model.nv
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[3] = data.qpos[-4] = 1.0
    data.qfrc_applied[int(model.joint("press").dofadr[0])] = 60.0
    for _ in range(2000):
        mujoco.mj_step(model, data)
    given = -np.mean([contact.dist for contact in data.contact])
    stiffness = settings.layer * patch_area(cell.contacts[0])
    assert given == pytest.approx(60.0 / stiffness, rel=1e-3)


def test_a_turning_box_stays_with_its_pads_when_pressed_well() -> None:
    """Turned and moved at once, the box neither slips nor turns on the carriage."""
    path = np.array([0.05, 0.03, 0.05, 0.2, -0.15, 0.3])
    carry = carry_along(hand_cell(), path, 0.8)
    carry = replace(carry, normal_force=np.full((len(carry), 2), 120.0))
    witness = BoxSimulation(carry.workcell)
    outcome = witness.simulate(drive_of(carry, witness.settings))
    assert outcome.holds
    assert outcome.time[-1] == pytest.approx(carry.duration, abs=3e-3)
    assert outcome.slip.max() < 1e-4
    assert outcome.turn.max() < 2e-3
    assert outcome.begins(1e-3) == float("inf")


def test_too_little_force_is_told_with_pad_and_time() -> None:
    carry = planned(STILL)
    witness = BoxSimulation(carry.workcell)
    outcome = witness.simulate(drive_of(carry, witness.settings), 0.5)
    assert not outcome.holds
    assert outcome.begins(1e-3) <= outcome.time[-1]
    assert outcome.slip[-1, outcome.pad] > 1e-3


def test_a_case_weighs_and_rubs_as_it_says() -> None:
    """Twenty percent more mass with ten percent less friction needs 1.2 / 0.9 times the force, and
    2 m/s^2 upwards as much more."""
    carry = planned(STILL)
    case = nominal_case(carry.workcell)
    case[0:2] *= 0.9
    case[4] *= 1.2
    case[10] = 2.0
    witness = of_case(carry, case)
    drive, needed = drive_of(carry, witness.settings), 1.2 / 0.9 * 11.81 / 9.81
    assert not witness.simulate(drive, 0.99 * needed).holds
    assert witness.simulate(drive, 1.01 * needed).holds


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
    witness = BoxSimulation(carry.workcell)
    drive = drive_of(carry, witness.settings)
    with pytest.raises(SimulationError, match=r"1\.5"):
        bisected(partial(witness.simulate, drive), 1.5, 2.0, 1)
    with refused(SettingsError, "time-step"):
        SimulationSettings(time_step=0.01)
    with refused(SettingsError, "contact-points"):
        SimulationSettings(layer=0.0)
    with refused(SettingsError, "not-at-rest"):
        drive_of(replace(carry, rate=np.ones((len(carry), 6))), witness.settings)
    with refused(SettingsError, "shape"):
        drive_of(carry, witness.settings, np.ones(3))


def test_without_the_simulator_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SimulationError, match="pip install"):
        BoxSimulation(hand_cell())


def at_rest(cell: Workcell) -> tuple[Carry, Array]:
    """Level and still, pressed with the planned force, and the planned moments."""
    still = np.zeros(6)
    load = call(load_function(cell), still, still, still)
    carry = carry_along(cell, still, 0.3)
    carry = replace(carry, normal_force=np.tile(load["normal_force"], (len(carry), 1)))
    moments = np.empty((len(carry) + 1, 2, 3))
    for i, contact in enumerate(cell.contacts):
        wrench, arm = load[f"wrench_{i + 1}"], contact.T_box_pad[:3, :3] @ tilt_centre(contact)
        moments[:, i] = wrench[3:] - np.cross(arm, wrench[:3])
    return carry, moments


@pytest.mark.parametrize(
    ("name", "centre_of_mass"),
    [
        ("drum", (-0.04, 0.0, 0.0)),
        ("fork", (0.0, 0.0, 0.0)),
    ],
)
def test_the_planned_forces_are_the_least_of_pads_that_the_planned_moments_drive(
    name: str, centre_of_mass: tuple[float, float, float]
) -> None:
    """A drum between pads 30 degrees off opposite; a crate held by three pads."""
    cell = with_payload(shipped(name).workcell, centre_of_mass=np.array(centre_of_mass))
    carry, moments = at_rest(cell)
    settings = SimulationSettings(pads="driven")
    witness, drive = BoxSimulation(cell, settings), drive_of(carry, settings, moments=moments)
    assert not witness.simulate(drive, 0.98).holds
    assert witness.simulate(drive, 1.02).holds


def test_a_box_that_many_points_hold_stays() -> None:
    """Steps that are not solved to their last digits would let it drift by 0.05 mm."""
    carry, _ = at_rest(shipped("fork").workcell)
    witness = BoxSimulation(carry.workcell, SimulationSettings(points=91))
    outcome = witness.simulate(drive_of(carry, witness.settings), 1.2)
    assert outcome.slip.max() < 1e-5


@pytest.mark.parametrize("off", [0.0, 0.025])
def test_a_fork_is_held_from_the_least_force_on_at_which_its_pads_press_alike(off: float) -> None:
    """A load beside its middle, too, until the box has turned and the pads press differently."""
    cell = shipped("fork").workcell
    carry, _ = at_rest(with_payload(cell, centre_of_mass=np.array([off, 0.0, 0.0])))
    assert threshold(carry, SimulationSettings(slip=1e-4)) == pytest.approx(0.985, abs=0.025)


@cache
def hand_made() -> tuple[Cell, Carry]:
    """The rack, and its carry as a job drives it."""
    cell = shipped("rack")
    return cell, driven_carry(cell, cell.initial)


def test_a_carry_is_driven_as_its_time_law_says() -> None:
    cell, closest = hand_made()
    assert np.abs(closest.rate[[0, -1]]).max() < 1e-6
    with refused(SimulationError, "not-drivable"):
        driven_carry(cell, cell.initial + 5.0)


def test_forces_beside_what_was_told_are_stored_from_the_carrys_beginning() -> None:
    """One short run of the whole cell, pressed as recommended."""
    cell, carry = hand_made()
    pressed, squeeze = pressed_reference(cell, carry)
    assert squeeze.factor is None
    shown = CellSimulation(cell.workcell).simulate(pressed, "leader")
    found = stored_simulation(
        CarrySimulation(None, "none", pressed, squeeze, shown), "a", "b", "leader"
    )
    assert found.arrives
    assert found.duration == pytest.approx(carry.duration)
    assert 0.0 <= found.time[0] < 0.02
    assert found.time[-1] == pytest.approx(carry.duration, abs=0.02)
    assert len(found.time) <= MOST_SAMPLES
    assert np.isnan(found.factor)
    assert found.robust
    told = commanded_forces(cell.workcell, carry, SqueezeSettings())[0].max(axis=0)
    np.testing.assert_allclose(found.peaks[0], told, rtol=0.01)
    assert found.largest_error < 0.1


def test_an_uncertain_cell_is_pressed_with_its_robust_forces() -> None:
    cell, carry = hand_made()
    unsure = replace(cell.workcell, uncertainty=Uncertainty(friction=0.1))
    other = Cell(unsure)
    other.compiled = cell.compiled  # which knows nothing of what is uncertain
    pressed, squeeze = pressed_reference(other, carry)
    needed = robust_model(unsure).hold(carry, unsure.uncertainty)[0]
    assert squeeze.factor is None
    told = pressed.normal_force[2:, 1]
    assert (told >= needed - 1e-6).all()
    assert told.max() == pytest.approx(needed.max(), rel=1e-6)
