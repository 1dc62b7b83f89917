"""Linearisations of what is not convex touch it and allow rest; a used-up patch can be no limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybrid_opt.timing import TimingLimits, TimingModel, TimingStatus, time_path
from hybrid_opt.timing.robustness import robustness_margins
from hybrid_opt.timing.solve import linearised_rows
from symbolic.read.cell import load
from symbolic.records import Allocation
from tests.hybrid_opt.timing.cells import initial, timing_of
from tests.symbolic.cells import hand_cell
from tests.symbolic.read.samples import RACK


def test_rows_allow_rest_and_touch_the_value_where_they_are_made() -> None:
    rng = np.random.default_rng(1)
    shape = (500, 3)
    value, at_rest = rng.uniform(-0.5, 1.2, shape), rng.uniform(-0.99, 0.99, shape)
    gradient = rng.normal(size=(*shape, 2))
    z = np.column_stack([rng.normal(size=500), rng.uniform(0.01, 1.0, 500)])
    rows = linearised_rows(value, gradient, at_rest, z)
    assert (rows.bound > 0.0).all()
    beyond = rows.alpha * z[:, :1] + rows.beta * z[:, 1:] - rows.bound
    # Only a bound that is raised although the row itself allows rest leaves the value.
    touches = np.abs(beyond - (value - 1.0)) < 1e-9
    raised = 1.0 - value + np.einsum("nkd,nd->nk", gradient, z) < (1.0 - at_rest) / 2.0
    assert touches.all()
    assert 100 < raised.sum() < 1400


def test_a_tilted_path_whose_patches_rest_nearly_uses_up_is_timed() -> None:
    """Rows whose bounds were raised cut nothing off there: 25 iterations came to one timing."""
    x = np.zeros((3, 6))
    x[:, [0, 2, 4]] = [
        [-0.3860, 0.9217, 0.3455],
        [-0.2815, 1.1587, 0.5980],
        [-0.1818, 1.2105, 0.4803],
    ]
    timing = time_path(TimingModel(load(RACK), 100), x.ravel(), TimingLimits(force=65.0))
    assert timing.ok, timing.reason
    assert timing.iterations < 10
    assert abs(timing.duration - 1.865) < 0.01


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
