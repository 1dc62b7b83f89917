"""What is commanded holds pads that press evenly, in every case of a set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.robust.cases import random_cases
from hybrid_opt.robust.force import BoxMotion, closes_evenly, soft_model
from hybrid_opt.robust.squeeze import SqueezeSettings, pressed_beyond
from symbolic.read.cell import load
from symbolic.records import Uncertainty, Workcell
from tests.symbolic.cells import RACK, rack_cell

SET = Uncertainty(
    friction=0.2,
    mass=0.05,
    centre_of_mass=np.full(3, 0.01),
    pad_position=0.005,
    disturbance=np.full(3, 0.3),
)


def motions(rng: np.random.Generator, n: int = 30) -> BoxMotion:
    pose = np.column_stack([rng.uniform(-0.5, 0.5, (n, 3)), rng.uniform(-0.4, 0.4, (n, 3))])
    return BoxMotion(pose, rng.uniform(-0.5, 0.5, (n, 6)), rng.uniform(-3.0, 3.0, (n, 6)))


@pytest.fixture(scope="module")
def rack() -> Workcell:
    return rack_cell()


def test_no_random_case_needs_more(rack: Workcell) -> None:
    model, rng = soft_model(rack), np.random.default_rng(1)
    motion = motions(rng)
    commanded, _ = model.hold(motion, SET)
    needed = model.least_squeeze(motion, random_cases(rack, SET, 4000, rng))[:, :, 1]
    share = (needed / commanded).max()
    assert 0.75 < share <= 1.0


def test_nothing_uncertain_is_the_nominal_force(rack: Workcell) -> None:
    model, motion = soft_model(rack), motions(np.random.default_rng(2))
    np.testing.assert_allclose(
        model.hold(motion, Uncertainty())[0], model.nominal(motion)[:, 1], rtol=1e-12
    )


@pytest.mark.parametrize("settings", [SqueezeSettings(), SqueezeSettings(1.0)])
def test_what_is_commanded_holds_even_pads(rack: Workcell, settings: SqueezeSettings) -> None:
    """Although the plan, here none at all, asks for less."""
    model, motion = soft_model(rack), motions(np.random.default_rng(3))
    time, planned = np.linspace(0.0, 2.0, 30), np.zeros((30, 2))
    extra, squeeze = pressed_beyond(rack, settings, time, motion, planned)
    assert (extra >= model.nominal(motion)[:, 1] * (1.0 - 1e-9)).all()
    assert "press evenly" in str(squeeze)


def test_pads_that_only_choosing_their_pressure_would_close_are_told() -> None:
    cell, still = load(RACK.with_name("corner.toml")), BoxMotion(*[np.zeros((2, 6))] * 3)
    slippery = [replace(contact, friction=0.9) for contact in cell.contacts]
    assert closes_evenly(cell)
    assert not closes_evenly(replace(cell, contacts=(slippery[0], slippery[1])))
    time = np.array([0.0, 1.0])
    _, squeeze = pressed_beyond(cell, SqueezeSettings(), time, still, np.zeros((2, 2)))
    assert "press evenly" in str(squeeze)
