"""Linearisations of what is not convex: they touch it, and allow rest."""

from __future__ import annotations

import numpy as np

from hybrid_opt.timing import TimingLimits, TimingModel, time_path
from hybrid_opt.timing.rows import linearised_rows
from symbolic.read.cell import load
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
