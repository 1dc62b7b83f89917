"""Timing under the joint allocation: a patch that is used up to its rim is no limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybrid_opt.timing import TimingLimits, TimingModel, TimingStatus, time_path
from hybrid_opt.timing.robustness import robustness_margins
from symbolic.records import Allocation
from tests.hybrid_opt.timing.cells import initial, timing_of
from tests.symbolic.cells import hand_cell

SMALL_PATCH, OFFSET = 0.012, 0.05
"""[m] Neither holds the box without pressing harder."""


def off_centre(allocation: Allocation) -> TimingModel:
    cell = hand_cell()
    along = cell.contacts[0].T_box_pad[:3, 2]
    payload = replace(cell.payload, centre_of_mass=OFFSET * along)
    first, second = (replace(contact, patch_radius=SMALL_PATCH) for contact in cell.contacts)
    task = replace(cell.task, allocation=allocation)
    return timing_of(replace(cell, payload=payload, contacts=(first, second), task=task), 50)


def test_what_the_joint_allocation_holds_can_be_timed() -> None:
    refused = time_path(off_centre("paper"), initial(), TimingLimits())
    assert refused.status is TimingStatus.INFEASIBLE_AT_REST
    assert refused.place is not None
    assert refused.place.constraint == "pressure shift"
    model = off_centre("joint")
    timing = time_path(model, initial(), TimingLimits())
    assert timing.status is TimingStatus.OK
    assert timing.carry is not None
    assert "pressure shift" not in timing.use
    assert timing.carry.pressure_shift.max() <= SMALL_PATCH * (1.0 + 1e-6)
    assert np.abs(timing.carry.moment_residual).max() < 1e-5
    names = [margin.quantity for margin in robustness_margins(model, timing.carry)]
    assert not any(name.startswith("patch radius") for name in names)
