"""What a box motion asks of the contacts: statics in closed form, balance and symmetry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from studies.research.plain.load import sample_load
from studies.research.plain.motion import angular_rates, rotation
from symbolic.array import Array
from symbolic.contact.load import load_function
from symbolic.records import Workcell
from tests.symbolic.cells import call, hand_cell, solid_box, with_contacts, with_payload


def load(cell: Workcell, pose: Array, rate: Array, second: Array) -> dict[str, Array]:
    return call(load_function(cell), pose, rate, second)


def at_rest(
    cell: Workcell, acceleration: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> dict[str, Array]:
    """Level box without velocity and with a given acceleration of its centre."""
    pose = np.array([0.1, -0.2, 0.8, 0.0, 0.0, 0.0])
    return load(cell, pose, np.zeros(6), np.concatenate([acceleration, np.zeros(3)]))


def ten_kilogram_cell(mu: float = 0.5) -> Workcell:
    cell = with_payload(hand_cell(), mass=10.0, inertia=solid_box(10.0, [0.3, 0.4, 0.25]))
    return with_contacts(cell, friction=(mu, mu))


def random_cell(rng: np.random.Generator) -> Workcell:
    mass = rng.uniform(1.0, 20.0)
    cell = with_payload(
        hand_cell(),
        mass=mass,
        centre_of_mass=rng.uniform(-0.05, 0.05, 3),
        inertia=solid_box(mass, [0.3, 0.4, 0.25]) + 0.01 * mass * np.ones((3, 3)) * 0.1,
    )
    friction = rng.uniform(0.3, 1.5, 2)
    return with_contacts(cell, friction=(friction[0], friction[1]))


def random_motion(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """A box pose within moderate tilt, its rate and second rate."""
    pose = np.concatenate([rng.uniform(-1.0, 1.0, 3), rng.uniform(-0.6, 0.6, 3)])
    return pose, rng.normal(scale=0.7, size=6), rng.normal(scale=2.0, size=6)


def rounding(result: dict[str, Array]) -> float:
    """Tolerance for two ways of computing a load.

    An unloaded contact leaves one direction of moment to the damping of the solve.
    """
    n = result["normal_force"]
    return 1e-8 if n.min() > 1e-3 * n.max() else 1e-6


# m = 10 kg, mu = 0.5, contacts 0.4 m apart: figures confirmed to 1e-4 N by an independent
# program for the level box.
@pytest.mark.parametrize(
    ("acceleration", "expected"),
    [
        ((0.0, 0.0, 0.0), (98.1, 98.1)),
        ((0.0, 0.0, 2.0), (118.1, 118.1)),
        # Contact 1 on the +y face presses towards -y: accelerated that way it is the pushed side.
        ((0.0, -1.0, 0.0), (103.1, 93.1)),
        ((0.0, 1.0, 0.0), (93.1, 103.1)),
    ],
)
def test_reference_figures(
    acceleration: tuple[float, float, float], expected: tuple[float, float]
) -> None:
    result = at_rest(ten_kilogram_cell(), acceleration)
    np.testing.assert_allclose(result["normal_force"], expected, atol=1e-4)


@given(mass=st.floats(0.5, 25.0), mu=st.floats(0.1, 2.0))
def test_level_box_at_rest_needs_half_its_weight_over_friction(mass: float, mu: float) -> None:
    cell = with_contacts(with_payload(hand_cell(), mass=mass), friction=(mu, mu))
    result = at_rest(cell)
    np.testing.assert_allclose(result["normal_force"], mass * 9.81 / (2 * mu), rtol=1e-12)
    resultant = np.linalg.norm(result["contact_force"].reshape(2, 3), axis=1)
    np.testing.assert_allclose(resultant, mass * 9.81 / 2 * np.sqrt(1 + 1 / mu**2), rtol=1e-12)


@given(mass=st.floats(0.5, 25.0), mu=st.floats(0.1, 2.0), a=st.floats(-5.0, 5.0))
def test_acceleration_along_the_squeeze_axis_shifts_the_difference(
    mass: float, mu: float, a: float
) -> None:
    cell = with_contacts(with_payload(hand_cell(), mass=mass), friction=(mu, mu))
    normal = at_rest(cell, (0.0, -a, 0.0))["normal_force"]
    assert normal[0] - normal[1] == pytest.approx(mass * a, abs=1e-9)
    assert normal.sum() >= mass * 9.81 / mu - 1e-9


@pytest.mark.parametrize("offset", [0.01, 0.025, 0.04])
def test_offset_along_the_box_is_carried_by_equal_shifts(offset: float) -> None:
    """Weight at (offset, 0, 0) from the pads' line: each vertical share moves under it."""
    cell = with_payload(ten_kilogram_cell(), centre_of_mass=np.array([offset, 0.0, 0.0]))
    result = at_rest(cell)
    np.testing.assert_allclose(result["pressure_shift"], offset, rtol=1e-9)
    np.testing.assert_allclose(result["shift_vector"][[0, 3]], offset, rtol=1e-9)
    np.testing.assert_allclose(result["moment_residual"], 0.0, atol=1e-9)


@pytest.mark.parametrize("offset", [0.01, 0.025, 0.04])
def test_offset_along_the_squeeze_axis_is_carried_by_the_normal_forces(offset: float) -> None:
    """m g dy = N (d_1 + d_2) with opposite vertical shifts and N = m g / (2 mu)."""
    mu = 0.5
    cell = with_payload(ten_kilogram_cell(mu), centre_of_mass=np.array([0.0, offset, 0.0]))
    result = at_rest(cell)
    np.testing.assert_allclose(result["pressure_shift"], mu * offset, rtol=1e-9)
    assert result["shift_vector"][2] == pytest.approx(-result["shift_vector"][5], rel=1e-9)


def test_offset_below_the_pads_needs_no_shift() -> None:
    cell = with_payload(ten_kilogram_cell(), centre_of_mass=np.array([0.0, 0.0, -0.05]))
    np.testing.assert_allclose(at_rest(cell)["pressure_shift"], 0.0, atol=1e-9)


@given(seed=st.integers(0, 2**31))
def test_agrees_with_the_plain_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell, motion = random_cell(rng), random_motion(rng)
    expected = sample_load(cell, *motion)
    tolerance = rounding(expected)
    for name, value in load(cell, *motion).items():
        np.testing.assert_allclose(
            value, expected[name], atol=tolerance, rtol=tolerance, err_msg=name
        )


@given(seed=st.integers(0, 2**31))
def test_contact_forces_and_gravity_move_the_box_as_newton_and_euler_say(seed: int) -> None:
    """Balance recomputed from the motion of the centre of mass, itself differentiated in time."""
    rng = np.random.default_rng(seed)
    cell, (pose, rate, second) = random_cell(rng), random_motion(rng)
    payload, result = cell.payload, load(cell, pose, rate, second)

    def centre_of_mass(t: float) -> Array:
        at = pose + rate * t + second * t**2 / 2.0
        return at[:3] + rotation(at[3:]) @ payload.centre_of_mass

    h = 1e-4
    acceleration = (centre_of_mass(h) - 2 * centre_of_mass(0.0) + centre_of_mass(-h)) / h**2
    forces = result["contact_force"].reshape(2, 3)
    weight = payload.mass * np.array([0.0, 0.0, -9.81])
    assert forces.sum(axis=0) + weight == pytest.approx(payload.mass * acceleration, abs=1e-4)

    # The same balance to rounding, with the acceleration from axes carried round.
    omega, alpha = angular_rates(pose[3:], rate[3:], second[3:])
    R = rotation(pose[3:])
    c = R @ payload.centre_of_mass
    exact = second[:3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
    assert np.abs(forces.sum(axis=0) + weight - payload.mass * exact).max() < 1e-9

    inertia = R @ payload.inertia @ R.T
    needed = inertia @ alpha + np.cross(omega, inertia @ omega)
    shifts = result["shift_vector"].reshape(2, 3)
    exerted = sum(
        np.cross(R @ contact.T_box_pad[:3, 3] + shifts[i] - c, forces[i])
        for i, contact in enumerate(cell.contacts)
    )
    assert exerted + result["moment_residual"] == pytest.approx(needed, abs=1e-9)


@given(seed=st.integers(0, 2**31))
def test_forces_stay_in_their_friction_cones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell, (pose, rate, second) = random_cell(rng), random_motion(rng)
    forces = load(cell, pose, rate, second)["contact_force"].reshape(2, 3)
    for force, contact in zip(forces, cell.contacts, strict=True):
        normal = rotation(pose[3:]) @ contact.T_box_pad[:3, 2]
        along = force @ normal
        assert along >= -1e-9
        assert np.linalg.norm(force - along * normal) <= contact.friction * along + 1e-8
