"""What a patch carries: where the centre of pressure is, which pad layers give way."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.contact.elastic import free_shift, pressure_shifts
from symbolic.contact.paper import pressure_shift, required_moment
from symbolic.records import Contact, Workcell
from tests.symbolic.cells import call, hand_cell, solid_box


def _shift() -> ca.Function:
    names = ("moment", "arm_1", "arm_2", "force_1", "force_2", "tangent_1", "tangent_2")
    moment, *pairs = symbols = [ca.SX.sym(name, 3) for name in names]
    arms, forces, tangents = (tuple(pairs[k : k + 2]) for k in (0, 2, 4))
    shifts, point, residual = pressure_shift(moment, arms, forces, tangents)
    outputs = ["shift_1", "shift_2", "point_residual", "residual"]
    return ca.Function("shift", symbols, [*shifts, point, residual], list(names), outputs)


SHIFT = _shift()


def random_case(seed: int) -> tuple[list[Array], Array]:
    """Inputs of `SHIFT` for two opposite pads that press and carry, and the contact normal."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    normal = R[:, 2]
    presses = rng.uniform(20.0, 150.0, 2)
    forces = [
        sign * press * normal + R[:, :2] @ rng.normal(scale=40.0, size=2)
        for sign, press in zip((1.0, -1.0), presses, strict=True)
    ]
    arms = [-0.2 * normal + rng.normal(scale=0.03, size=3), 0.2 * normal]
    return [rng.normal(scale=3.0, size=3), *arms, *forces, R[:, 0], R[:, 1]], normal


def lever(inputs: list[Array]) -> Array:
    _, _, _, *forces, a, b = inputs
    return np.column_stack([np.cross(t, f) for f in forces for t in (a, b)])


@given(seed=st.integers(0, 2**31))
def test_agrees_with_the_pseudo_inverse(seed: int) -> None:
    inputs, _ = random_case(seed)
    moment, arm_1, arm_2, force_1, force_2, a, b = inputs
    missing = moment - np.cross(arm_1, force_1) - np.cross(arm_2, force_2)
    A = lever(inputs)
    d = np.linalg.pinv(A) @ missing
    plane = np.column_stack([a, b])
    result = call(SHIFT, *inputs)
    # The damping of 1e-12 relative counts by the square of the condition number.
    tolerance = 1e-11 * np.linalg.cond(A) ** 2 * max(1.0, float(np.abs(d).max()))
    np.testing.assert_allclose(result["point_residual"], missing, atol=1e-12)
    np.testing.assert_allclose(result["shift_1"], plane @ d[:2], atol=tolerance)
    np.testing.assert_allclose(result["shift_2"], plane @ d[2:], atol=tolerance)


def test_pure_squeeze_leaves_the_moment_about_its_axis() -> None:
    """Without tangential force no shift turns the box about the normal: that part remains."""
    missing = np.array([1.0, 2.0, 3.0])
    z = np.eye(3)[2]
    inputs = [missing, -0.2 * z, 0.2 * z, 80.0 * z, -80.0 * z, np.eye(3)[0], np.eye(3)[1]]
    result = call(SHIFT, *inputs)
    np.testing.assert_allclose(result["residual"], [0.0, 0.0, 3.0], atol=1e-9)
    d = np.linalg.pinv(lever(inputs), rcond=1e-6) @ missing
    np.testing.assert_allclose([*result["shift_1"][:2], *result["shift_2"][:2]], d, atol=1e-11)


def test_without_forces_nothing_is_carried() -> None:
    zero = np.zeros(3)
    result = call(SHIFT, [0.1, 0.2, 0.3], zero, zero, zero, zero, [1, 0, 0], [0, 1, 0])
    np.testing.assert_allclose(result["residual"], [0.1, 0.2, 0.3])
    assert not result["shift_1"].any()


@given(seed=st.integers(0, 2**31))
def test_required_moment_is_the_rate_of_angular_momentum(seed: int) -> None:
    """Finite difference of R I R^T omega along a rotation with constant angular acceleration."""
    rng = np.random.default_rng(seed)
    R0 = Rotation.random(rng=rng)
    omega, alpha = rng.normal(size=3), rng.normal(size=3)
    inertia = solid_box(10.0, [0.3, 0.4, 0.25]) + 0.01 * np.ones((3, 3))
    h = 1e-5

    def momentum(t: float) -> Array:
        R = (Rotation.from_rotvec(omega * t + alpha * t**2 / 2.0) * R0).as_matrix()
        value: Array = R @ inertia @ R.T @ (omega + alpha * t)
        return value

    ours: Array = np.array(
        required_moment(ca.DM(inertia), ca.DM(R0.as_matrix()), ca.DM(omega), ca.DM(alpha))
    )[:, 0]
    assert ours == pytest.approx((momentum(h) - momentum(-h)) / (2 * h), abs=1e-7)


NORMAL = np.array([[60.0, 60.0]])


def apart(cell: Workcell) -> float:
    first, second = (contact.T_box_pad[:3, 3] for contact in cell.contacts)
    return float(np.linalg.norm(first - second))


def level(cell: Workcell) -> Workcell:
    """Pads at the height of the box frame's origin."""
    contacts = []
    for contact in cell.contacts:
        T = contact.T_box_pad.copy()
        T[[0, 2], 3] = 0.0
        contacts.append(replace(contact, T_box_pad=T))
    return replace(cell, contacts=(contacts[0], contacts[1]))


def test_forces_through_the_middle_shift_nothing() -> None:
    load = np.array([[20.0, 5.0, 98.1, 0.0, 0.0, 0.0]])
    assert pressure_shifts(level(hand_cell()), load, NORMAL).max() < 1e-12


def test_two_discs_bear_a_moment_across_mostly_by_opposed_tangential_forces() -> None:
    """Turned by an angle, each pad gives shear times half the distance, and its own bending
    stiffness, a quarter of its radius squared for a unit of its area."""
    cell, moment = level(hand_cell()), 3.0
    radius = cell.contacts[0].patch_radius
    bending, opposed = radius**2 / 4.0, Contact.layer_shear * apart(cell) ** 2 / 4.0
    per_pad = moment / 2.0 * bending / (bending + opposed)
    expected = per_pad / NORMAL[0, 0] / (radius / 4.0)
    found = pressure_shifts(cell, np.array([[0, 0, 0, moment, 0, 0]]), NORMAL)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert found.max() < 0.2  # a few per cent of the radius, as simulated pads show


@pytest.mark.parametrize("sides", [(0.03, 0.01), (0.01, 0.03)])
def test_a_rectangle_lifts_off_at_a_third_of_its_half_side(sides: tuple[float, float]) -> None:
    cell = level(hand_cell())
    first, second = (
        replace(contact, half_sides=sides, patch_radius=float(np.hypot(*sides)))
        for contact in cell.contacts
    )
    cell = replace(cell, contacts=(first, second))
    axis = cell.contacts[0].T_box_pad[:3, 0]  # along x of the pads: bends them along y
    load = np.concatenate([np.zeros(3), 3.0 * axis])[None]
    bending, opposed = sides[1] ** 2 / 3.0, Contact.layer_shear * apart(cell) ** 2 / 4.0
    expected = 1.5 * bending / (bending + opposed) / NORMAL[0, 0] / (sides[1] / 3.0)
    np.testing.assert_allclose(pressure_shifts(cell, load, NORMAL), expected, rtol=1e-9)
    assert free_shift(first) == pytest.approx(0.01 / 3.0)
