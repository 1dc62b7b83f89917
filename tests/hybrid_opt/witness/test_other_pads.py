"""Boxes at rest between other pads, simulated: they slip just below the planned forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.witness.box import Drive, Witness
from hybrid_opt.witness.scene import (
    SimulationSettings,
    pressed_places,
    presses_on_box,
    rim,
    tilt_centre,
)
from symbolic.contact.load import load_function
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.symbolic.cells import ROOT, call, with_payload

pytest.importorskip("mujoco")

DURATION = 0.5


def shipped(name: str) -> Workcell:
    return load(ROOT / "studies" / "workcells" / f"{name}.toml")


def at_rest(cell: Workcell, settings: SimulationSettings) -> Drive:
    """Level and still, pressed with the planned force."""
    still = np.zeros(6)
    press = call(load_function(cell), still, still, still)["normal_force"][1]
    n = int(DURATION / settings.time_step)
    none = np.zeros((n, 3))
    return Drive(
        leader=0,
        time=np.asarray(settings.time_step * np.arange(n) - settings.settle, dtype=float),
        position=none,
        velocity=none,
        acceleration=none,
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        spin=none,
        spin_rate=none,
        press=np.full(n, press),
        tilt=np.zeros((n, 2, 2)),
        own=np.zeros(n),
    )


@pytest.mark.parametrize(
    ("name", "centre_of_mass"), [("drum", (-0.04, 0.0, 0.0)), ("fork", (0.0, 0.0, 0.0))]
)
def test_the_planned_forces_are_the_least(
    name: str, centre_of_mass: tuple[float, float, float]
) -> None:
    """A drum between pads 30 degrees off opposite; a crate held by three pads."""
    cell = with_payload(shipped(name), centre_of_mass=np.array(centre_of_mass))
    settings = SimulationSettings()
    witness, drive = Witness(cell, settings), at_rest(cell, settings)
    assert not witness.simulate(drive, 0.98).holds
    assert witness.simulate(drive, 1.02).holds


@pytest.mark.parametrize(
    ("name", "centre_of_mass", "holds"),
    [
        ("fork", (0.025, 0.0, 0.0), 1.03),
        ("fork", (0.05, 0.0, 0.0), 1.03),
        # By torsion; how the four corners share the pressure is not driven.
        ("drum", (0.0, 0.0, 0.0), 1.06),
    ],
)
def test_pads_that_the_planned_moments_drive_need_little_more(
    name: str, centre_of_mass: tuple[float, float, float], holds: float
) -> None:
    """Loads far off the line between the pads, whose pressures are shared as planned."""
    cell = with_payload(shipped(name), centre_of_mass=np.array(centre_of_mass))
    settings = SimulationSettings(tilt_stiffness=300.0)
    drive, still = at_rest(cell, settings), np.zeros(6)
    load = call(load_function(cell), still, still, still)
    tilt = np.zeros((len(drive.time), 2, 2))
    for i, contact in enumerate(cell.contacts):
        axes, wrench = contact.T_box_pad[:3, :3], load[f"wrench_{i + 1}"]
        moment = wrench[3:] - np.cross(axes @ tilt_centre(contact), wrench[:3])
        tilt[:, i] = axes[:, :2].T @ moment
    witness, drive = Witness(cell, settings), replace(drive, tilt=tilt)
    assert not witness.simulate(drive, 0.98).holds
    assert witness.simulate(drive, holds).holds


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
    np.testing.assert_allclose(pressed_places(first, "rim", 8), corners)
    np.testing.assert_allclose(found[1::2], (corners + np.roll(corners, -1, axis=0)) / 2)
