"""Shifts of elastic pads' pressure against statics by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from symbolic.contact.elastic import SHEAR, free_shift, pressure_shifts
from symbolic.records import Workcell
from tests.symbolic.cells import hand_cell

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
    bending, opposed = radius**2 / 4.0, SHEAR * apart(cell) ** 2 / 4.0
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
    bending, opposed = sides[1] ** 2 / 3.0, SHEAR * apart(cell) ** 2 / 4.0
    expected = 1.5 * bending / (bending + opposed) / NORMAL[0, 0] / (sides[1] / 3.0)
    np.testing.assert_allclose(pressure_shifts(cell, load, NORMAL), expected, rtol=1e-9)
    assert free_shift(first) == pytest.approx(0.01 / 3.0)
