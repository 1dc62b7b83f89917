"""Boxes at rest between other pads, simulated: they slip just below the planned forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.carry import Carry
from hybrid_opt.witness.box import Witness, drive_of
from hybrid_opt.witness.scene import (
    SimulationSettings,
    pressed_places,
    presses_on_box,
    rim,
    tilt_centre,
)
from symbolic.array import Array
from symbolic.contact.load import load_function
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.hybrid_opt.witness.carries import carry_along
from tests.symbolic.cells import ROOT, call, with_payload

pytest.importorskip("mujoco")


def shipped(name: str) -> Workcell:
    return load(ROOT / "studies" / "workcells" / f"{name}.toml")


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
        # Far off the line between the pads, whose pressures are shared as planned.
        ("fork", (0.05, 0.0, 0.0)),
        ("drum", (0.0, 0.0, 0.0)),
    ],
)
def test_the_planned_forces_are_the_least_of_pads_that_the_planned_moments_drive(
    name: str, centre_of_mass: tuple[float, float, float]
) -> None:
    """A drum between pads 30 degrees off opposite; a crate held by three pads."""
    cell = with_payload(shipped(name), centre_of_mass=np.array(centre_of_mass))
    carry, moments = at_rest(cell)
    settings = SimulationSettings(pads="driven")
    witness, drive = Witness(cell, settings), drive_of(carry, settings, moments=moments)
    assert not witness.simulate(drive, 0.98).holds
    assert witness.simulate(drive, 1.02).holds


def test_pads_that_press_evenly_need_more_where_a_load_twists() -> None:
    """A fork needs as much in the middle, and a third more for a load far off it."""
    found = []
    for off in (0.0, 0.05):
        cell = with_payload(shipped("fork"), centre_of_mass=np.array([off, 0.0, 0.0]))
        drive = drive_of(at_rest(cell)[0], SimulationSettings())
        found.append([Witness(cell).simulate(drive, factor).holds for factor in (0.98, 1.02, 1.2)])
    assert found == [[False, True, True], [False, False, False]]


def test_a_fork_tilts_about_the_middle_of_its_pads() -> None:
    fork, pad = shipped("fork").contacts
    np.testing.assert_allclose(fork.T_box_pad[:3, :3] @ tilt_centre(fork), [0.08, 0.0, 0.0])
    np.testing.assert_allclose(tilt_centre(pad), 0.0)


def test_pads_press_on_plates_where_the_payload_is_no_box() -> None:
    assert presses_on_box(shipped("fork"))
    assert presses_on_box(shipped("uneven"))
    assert not presses_on_box(shipped("drum"))


def test_a_rectangles_rim_runs_through_its_corners() -> None:
    (first, _) = shipped("drum").contacts
    found = rim(first, 8)
    assert found.shape == (8, 2)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [0.03, 0.015]
    np.testing.assert_allclose(found[::2], corners)
    np.testing.assert_allclose(pressed_places(first, "driven", 8), corners)
    np.testing.assert_allclose(found[1::2], (corners + np.roll(corners, -1, axis=0)) / 2)
