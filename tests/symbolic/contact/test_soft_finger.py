"""Soft fingers against the exact limit curves of patches under even pressure, against statics, and
against forces that are looked for by bisection."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.robust.cases import nominal_case
from symbolic.array import Array
from symbolic.contact.grasp import balance_of, facing_wrenches
from symbolic.contact.soft_finger import (
    SoftPatch,
    least_soft_squeeze,
    torsion_capacity,
)
from symbolic.contact.worst_cases import case_squeeze_function
from symbolic.records import Contact, Workcell
from tests.symbolic.cells import hand_cell, with_contacts, with_task

MASS, GRAVITY = 10.0, 9.81


def cell_of(
    height: float = 0.0, friction: float = 1.0, half_sides: tuple[float, float] | None = None
) -> Workcell:
    """A solid box between two pads across y, these a height above its centre."""
    cell = with_contacts(hand_cell(), friction=(friction, friction))
    cell = with_task(cell, allocation="soft-finger")
    contacts = []
    for contact in cell.contacts:
        T = contact.T_box_pad.copy()
        T[2, 3] = height
        contacts.append(replace(contact, T_box_pad=T, half_sides=half_sides))
    return replace(cell, contacts=(contacts[0], contacts[1]))


def sliding(contact: Contact, way: float) -> Array:
    """(n, 3) tangential force and torsion of a patch that slides about centres of rotation beside
    its middle, for unit normal force and friction: its exact limit curve, by quadrature.

    Args:
        way: angle of the tangential force from the pad's x axis [rad].
    """
    if contact.half_sides is None:
        r, angle = np.meshgrid((np.arange(200) + 0.5) / 200, np.arange(256) * 2.0 * np.pi / 256)
        at = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)
        points = contact.patch_radius * at.reshape(-1, 2)
        weight = r.ravel() / r.sum()
    else:
        x, y = contact.half_sides
        along = (np.arange(160) + 0.5) / 80 - 1.0
        points = np.array(np.meshgrid(x * along, y * along)).reshape(2, -1).T
        weight = np.full(len(points), 1.0 / len(points))
    found = []
    size = np.linalg.norm(points, axis=1).max()
    for distance in [0.0, *np.geomspace(0.03, 30.0, 40)]:
        centre = distance * size * np.array([-np.sin(way), np.cos(way)])
        arm = points - centre
        moved = np.column_stack([-arm[:, 1], arm[:, 0]])
        moved /= np.linalg.norm(moved, axis=1)[:, None] + 1e-15
        torsion = weight @ (points[:, 0] * moved[:, 1] - points[:, 1] * moved[:, 0])
        found.append([*(weight @ moved), torsion])
    return np.array(found)


def asked_for(contact: Contact, wrench: Array) -> float:
    """Normal force that (1) asks for with unit friction, by bisection."""
    patch = SoftPatch.of(contact, contact.T_box_pad[:3, :3])
    grip = ca.SX.sym("grip")
    capacity = ca.Function("c", [grip], [torsion_capacity(grip, ca.SX(wrench[:2]), patch)[0]])
    low, high = 0.0, 10.0
    for _ in range(60):
        middle = (low + high) / 2.0
        enough = float(capacity(middle)) >= abs(wrench[2])
        low, high = (low, middle) if enough else (middle, high)
    return float(np.hypot(high, np.linalg.norm(wrench[:2])))


@pytest.mark.parametrize(
    ("half_sides", "least", "most"),
    [(None, -0.004, 0.0035), ((0.03, 0.03), -0.008, 0.005), ((0.04, 0.02), -0.004, 0.03)],
)
def test_forces_are_those_of_the_exact_limit_curve(
    half_sides: tuple[float, float] | None, least: float, most: float
) -> None:
    contact = cell_of(half_sides=half_sides).contacts[0]
    errors = [
        asked_for(contact, wrench) - 1.0
        for way in (0.0, 0.5, 1.1, np.pi / 2)
        for wrench in sliding(contact, way)
    ]
    assert least < min(errors) <= max(errors) < most


def least(cell: Workcell, pose: Array, acceleration: Array) -> Array:
    """(2,) normal forces at a pose (6,) under an acceleration (3,) of the box."""
    second = np.concatenate([acceleration, np.zeros(3)])
    function = case_squeeze_function(cell)
    return np.asarray(function(pose, np.zeros(6), second, nominal_case(cell))).ravel()


def test_level_and_still_it_is_the_paper_s_force() -> None:
    for friction in (0.3, 1.0):
        found = least(cell_of(friction=friction), np.zeros(6), np.zeros(3))
        np.testing.assert_allclose(found, MASS * GRAVITY / (2.0 * friction), rtol=1e-9)


def test_a_box_that_hangs_pitched_below_its_pads_twists_them() -> None:
    """tau = m g h sin(pitch) is torsion: both pads reach the limit surface together."""
    height, pitch = 0.055, 0.5
    cell = cell_of(height=height)
    pose = np.array([0.0, 0.0, 1.0, 0.0, pitch, 0.0])
    force = least(cell, pose, np.zeros(3))
    weight = MASS * GRAVITY
    torsion = weight * height * np.sin(pitch)
    radius = cell.contacts[0].patch_radius
    assert force[0] == pytest.approx(force[1], rel=1e-9)
    wrench = np.array([weight / 2.0, 0.0, torsion / 2.0]) / force[0]
    curve = sliding(cell.contacts[0], 0.0)
    at = np.argmin(np.abs(np.hypot(*curve[:, :2].T) / curve[:, 2] - wrench[0] / wrench[2]))
    scale = np.linalg.norm(wrench * [1, 1, 1 / radius]) / np.linalg.norm(
        curve[at] * [1, 1, 1 / radius]
    )
    assert scale == pytest.approx(1.0, abs=0.03)  # the curve's points are so far apart


def test_a_pull_along_y_above_the_centre_loads_one_pad_more() -> None:
    """m a h turns about x: half of it over the distance of the pads is added to one tangential
    force and taken off the other, beside what the pull itself adds to one normal force."""
    height, friction, pull = 0.10, 0.8, 1.0
    cell = cell_of(height=height, friction=friction)
    apart = abs(cell.contacts[0].T_box_pad[1, 3] - cell.contacts[1].T_box_pad[1, 3])
    force = least(cell, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.0, pull, 0.0]))
    more = MASS * pull * height / apart
    needed = np.array([MASS * GRAVITY / 2 + more, MASS * GRAVITY / 2 - more]) / friction
    # Contact 1 presses towards -y: pad 2 gives the pull.
    assert force[1] - force[0] == pytest.approx(MASS * pull, rel=1e-9)
    assert force[0] == pytest.approx(max(needed[0], needed[1] - MASS * pull), rel=1e-6)


COEFFICIENT = st.floats(0.3, 1.2)
PART = st.floats(-1.0, 1.0)


@given(
    friction=st.tuples(COEFFICIENT, COEFFICIENT),
    radii=st.tuples(st.floats(0.015, 0.05), st.floats(0.015, 0.05)),
    force=st.tuples(PART, PART, PART),
    moment=st.tuples(PART, PART, PART),
    beside=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
)
def test_it_is_the_least_force_that_holds(
    friction: tuple[float, float],
    radii: tuple[float, float],
    force: tuple[float, float, float],
    moment: tuple[float, float, float],
    beside: tuple[float, float],
) -> None:
    """Against bisection: at every squeeze the balance of both pads is solved as a linear system."""
    load = np.array([60.0, 60.0, 30.0]) * force, np.array([2.0, 2.0, 1.0]) * moment
    arms = np.array([[*beside, -0.2], [0.0, 0.05, 0.2]])
    patches = [SoftPatch(2.0 / 3.0 * r, r * np.eye(2)) for r in radii]
    held = least_soft_squeeze(
        ca.SX(load[0]),
        ca.SX(load[1]),
        (ca.SX(arms[0]), ca.SX(arms[1])),
        ca.SX(ca.DM(friction)),
        (patches[0], patches[1]),
        offset=True,
    )
    found = np.asarray(ca.evalf(held.normal)).ravel()

    grip = ca.SX.sym("grip")
    tangent = ca.SX.sym("tangent", 2)
    capacity = [
        ca.Function("c", [grip, tangent], [torsion_capacity(grip, tangent, patch)[0]])
        for patch in patches
    ]

    def holds(n_2: float) -> bool:
        normal = np.array([n_2 + load[0][2], n_2])
        if normal.min() < 0.0:
            return False
        matrix, right = np.zeros((6, 6)), np.concatenate(load)
        for i, sign in enumerate((1.0, -1.0)):
            for k, axis in enumerate(np.eye(3)[:2]):
                matrix[:, 2 * i + k] = np.concatenate([axis, np.cross(arms[i], axis)])
            pressed = sign * normal[i] * np.array([0.0, 0.0, 1.0])
            right = right - np.concatenate([pressed, np.cross(arms[i], pressed)])
        matrix[5, 4] = 1.0
        matrix[2, 5] = 1.0
        solved = np.linalg.solve(matrix, right)
        left = (np.array(friction) * normal) ** 2 - np.sum(solved[:4].reshape(2, 2) ** 2, axis=1)
        if left.min() < 0.0:
            return False
        carried = [float(capacity[i](np.sqrt(left[i]), solved[2 * i : 2 * i + 2])) for i in (0, 1)]
        return bool(sum(carried) >= abs(solved[4]))

    low, high = 0.0, 1e4
    if not holds(high):
        return  # pads so far beside one another that pressing harder does not help
    for _ in range(60):
        middle = (low + high) / 2.0
        low, high = (low, middle) if holds(middle) else (middle, high)
    np.testing.assert_allclose(found, [high + load[0][2], high], rtol=1e-5, atol=1e-3)


@given(
    friction=st.tuples(COEFFICIENT, COEFFICIENT),
    force=st.tuples(PART, PART, PART),
    moment=st.tuples(PART, PART, PART),
    scale=st.floats(0.1, 10.0),
)
def test_it_grows_with_the_load_and_asks_for_no_less_than_pads_that_choose_their_pressure(
    friction: tuple[float, float],
    force: tuple[float, float, float],
    moment: tuple[float, float, float],
    scale: float,
) -> None:
    arms = (ca.DM([0.0, 0.0, -0.2]), ca.DM([0.0, 0.0, 0.2]))
    f, m = ca.DM([60.0 * x for x in force]), ca.DM(list(moment))
    radius = 0.03
    patch = SoftPatch(2.0 / 3.0 * radius, radius * np.eye(2))

    def soft(by: float) -> Array:
        held = least_soft_squeeze(
            ca.SX(by * f), ca.SX(by * m), arms, ca.SX(ca.DM(friction)), (patch, patch)
        )
        return np.asarray(ca.evalf(held.normal)).ravel()

    np.testing.assert_allclose(soft(scale), scale * soft(1.0), rtol=1e-6, atol=1e-5)
    balance = ca.MX(balance_of(f, m, arms))
    asked = (balance, ca.MX(ca.DM(friction)), ca.MX(ca.DM([radius, radius])))
    chosen = np.asarray(ca.evalf(facing_wrenches(*asked, "squeeze"))).ravel()[[0, 6]]
    assert (soft(1.0) >= chosen * (1.0 - 1e-4) - 1e-3).all()
