"""Simulations of a study's carries in hands that hold by themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.carry import box_motion
from hybrid_opt.extras.simulation.hands import own_forces
from hybrid_opt.robust.force import interpreted_robust_model
from studies.research.hand_carries import carry_along
from studies.study.simulation import _simulated_hands
from symbolic.read.cell import load
from tests.symbolic.cells import RACK


@pytest.mark.compiled
def test_a_study_simulates_carries_in_hands() -> None:
    """The threshold is that of the planned forces; the robust ones hold without a slip."""
    pytest.importorskip("mujoco")
    cell = load(RACK.with_name("plate.toml"))
    carry = carry_along(cell, np.array([0.2, 0.1, 0.15, 0.0, 0.0, 0.0]), 1.6)
    planned = interpreted_robust_model(cell).nominal(box_motion(carry))
    found = _simulated_hands(replace(carry, normal_force=planned), "plate", "0", "leader")
    assert found.slips < found.holds
    assert 0.8 < found.holds < 1.05
    assert found.robust
    assert found.arrives
    assert found.slip < 1e-4
    assert 0.0 < found.begins < found.duration


def test_forces_are_stated_for_the_weaker_hands() -> None:
    cell = load(RACK.with_name("plate.toml"))
    first, second = cell.contacts
    unequal = replace(cell, contacts=(first, replace(second, holding_force=450.0)))
    np.testing.assert_allclose(own_forces(unequal, np.array([90.0, 80.0])), [90.0, 120.0])
