"""What the simulated cell says of a carry: threshold, and forces beside those it was told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from hybrid_opt.cell import Cell
from hybrid_opt.errors import WitnessError
from hybrid_opt.robust.force import soft_model
from hybrid_opt.robust.squeeze import SqueezeSettings, commanded_forces
from hybrid_opt.witness.arms import Account, CellWitness
from hybrid_opt.witness.reference import driven_carry, pressed_reference
from studies.study.simulation import MOST_SAMPLES, stored_simulation
from symbolic.array import Array
from symbolic.records import Uncertainty
from symbolic.records.task import initial_decision
from tests.symbolic.cells import rack_cell


def made() -> tuple[Cell, Array]:
    cell = Cell(rack_cell())
    return cell, initial_decision(cell.workcell.task)


def test_a_carry_is_driven_as_its_time_law_says() -> None:
    cell, x = made()
    closest = driven_carry(cell, x)
    assert np.abs(closest.rate[[0, -1]]).max() < 1e-6
    with pytest.raises(WitnessError, match="cannot be driven"):
        driven_carry(cell, x + 5.0)


def test_forces_beside_what_was_told_are_stored_from_the_carrys_beginning() -> None:
    """One short run of the whole cell, pressed as recommended."""
    cell, x = made()
    carry = driven_carry(cell, x)
    pressed, squeeze = pressed_reference(cell, carry)
    assert squeeze.factor is None
    shown = CellWitness(cell.workcell).simulate(pressed, "leader")
    found = stored_simulation(Account(None, "none", pressed, squeeze, shown), "a", "b", "leader")
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
    cell, x = made()
    carry = driven_carry(cell, x)
    unsure = replace(cell.workcell, uncertainty=Uncertainty(friction=0.1))
    other = Cell(unsure)
    other.compiled = cell.compiled  # which knows nothing of what is uncertain
    pressed, squeeze = pressed_reference(other, carry)
    needed = soft_model(unsure).hold(carry, unsure.uncertainty)[0]
    assert squeeze.factor is None
    told = pressed.normal_force[2:, 1]
    assert (told >= needed - 1e-6).all()
    assert told.max() == pytest.approx(needed.max(), rel=1e-6)
