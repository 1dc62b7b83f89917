"""The shipped cell whose pads press on adjacent faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.timing import TimingLimits, TimingModel
from hybrid_opt.timing.solve import time_path
from symbolic.contact.load import load_function
from symbolic.read.cell import load
from tests.hybrid_opt.cells import shipped
from tests.symbolic.cells import ROOT, call

CORNER = ROOT / "studies" / "workcells" / "corner.toml"


def test_at_rest_both_pads_hold_half_of_the_crate() -> None:
    """Across the edge the forces lie in the line of both pads, at 45 degrees to both normals."""
    workcell = load(CORNER)
    first, second = workcell.contacts
    assert abs(first.T_box_pad[:3, 2] @ second.T_box_pad[:3, 2]) < 1e-12
    still = np.zeros(6)
    found = call(load_function(workcell), still, still, still)
    one, two = found["contact_force"].reshape(2, 3)
    weight = 9.81 * workcell.payload.mass
    np.testing.assert_allclose(one + two, [0.0, 0.0, weight], atol=1e-9 * weight)
    np.testing.assert_allclose([one[2], two[2]], weight / 2.0, rtol=1e-4)
    np.testing.assert_allclose(found["normal_force"][0], found["normal_force"][1], rtol=1e-4)
    for contact, force in zip(workcell.contacts, (one, two), strict=True):
        normal = contact.T_box_pad[:3, 2]
        along = normal @ force
        assert np.linalg.norm(force - along * normal) <= contact.friction * along


def test_soft_fingers_need_more_but_hold_it_as_well() -> None:
    workcell = load(CORNER)
    even = replace(workcell, task=replace(workcell.task, allocation="soft-finger"))
    still = np.zeros(6)
    least, found = (call(load_function(cell), still, still, still) for cell in (workcell, even))
    assert (found["normal_force"] >= least["normal_force"] * (1.0 - 1e-4)).all()
    np.testing.assert_allclose(found["pressure_shift"], 0.0, atol=1e-9)
    np.testing.assert_allclose(found["moment_residual"], 0.0, atol=1e-6)


@pytest.mark.slow
def test_compiled_passes_agree_with_the_independent_timing() -> None:
    """Where a program finds the contact forces, within a force limit that decides."""
    cell = shipped("corner").drivable()
    path, limits = cell.initial[: cell.workcell.task.n_path], TimingLimits(force=30.0)
    assert cell.path_timer.compiled
    found = cell.path_timer.time(path, limits)
    other = time_path(TimingModel(cell.compiled, cell.path_timer.intervals), path, limits)
    assert found.ok
    assert found.duration == pytest.approx(other.duration, rel=5e-3)
    assert found.peak_force.max() == pytest.approx(30.0, rel=2e-3)


@pytest.mark.slow
def test_its_carry_is_feasible_certified_and_drivable_and_pads_hold_it() -> None:
    cell = shipped("corner")
    carry = cell.carry(cell.initial)
    assert carry.judgement is not None
    assert carry.judgement.feasible
    assert np.abs(carry.moment_residual).max() < 1e-9
    assert cell.certify(cell.initial).is_free
    timing = time_path(cell.timing_model, cell.initial, TimingLimits(reference_speed=True))
    assert timing.ok, timing.reason
    assert timing.carry is not None
    pytest.importorskip("mujoco")
    from tests.hybrid_opt.witness.carries import assert_driven_pads_hold

    assert_driven_pads_hold(cell, timing.carry)
