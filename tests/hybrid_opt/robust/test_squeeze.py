"""Commanded forces never fall below what is needed, and have no corner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.robust.force import RobustModel, soft_model
from hybrid_opt.robust.squeeze import (
    RESERVE,
    SqueezeSettings,
    chosen_squeeze,
    extra_force,
    smooth_above,
)
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty
from tests.hybrid_opt.job.jobs import rack, rack_job

FORCES = st.lists(st.floats(0.0, 200.0), min_size=2, max_size=40)


@given(FORCES, st.floats(0.05, 5.0), st.floats(0.01, 0.5))
def test_the_smoothed_curve_is_nowhere_below(
    forces: list[float], duration: float, width: float
) -> None:
    time = np.linspace(0.0, duration, len(forces))
    smooth = smooth_above(time, np.array(forces), width)
    assert (smooth >= np.array(forces) - 1e-9).all()
    assert smooth.max() <= max(forces) + 1e-9


def test_a_jump_becomes_a_smooth_rise_before_it() -> None:
    time = np.array([0.0, 0.5, 0.5, 1.0])
    grid = np.linspace(0.0, 1.0, 1001)
    step = np.interp(grid, time, [50.0, 50.0, 60.0, 60.0])
    smooth = smooth_above(grid, step, 0.1)
    assert smooth[290] == pytest.approx(50.0)
    assert smooth[510] == pytest.approx(60.0)
    # Kernel of (1 - s^2)^3 over 0.2 s: its largest value times the jump bounds the rate.
    assert np.gradient(smooth, grid).max() < 10.0 * 1.2 / 0.1
    assert abs(np.gradient(smooth, grid)[[1, -2]]).max() < 1e-6


def test_the_factor_multiplies_the_squeeze() -> None:
    for phase in rack_job().phases:
        if phase.name in ("lift", "carry", "set_down"):
            least, normal = phase.force.least, phase.force.normal
            assert (normal >= least - 1e-9).all()
            assert (normal.sum(axis=1) >= 1.3 * least.sum(axis=1) - 1e-9).all()
            # The motion fixes the difference of both forces, whatever the squeeze.
            np.testing.assert_allclose(
                normal[:, 0] - normal[:, 1], least[:, 0] - least[:, 1], atol=1e-9
            )


def test_an_uncertain_cell_is_pressed_robustly() -> None:
    uncertain = replace(rack().workcell, uncertainty=Uncertainty(friction=0.2, mass=0.05))
    squeeze = chosen_squeeze(uncertain, SqueezeSettings())
    assert squeeze.factor is None
    carry = rack_job().timing.carry
    assert carry is not None
    extra = extra_force(uncertain, squeeze, carry.time, carry, carry.normal_force)
    commanded = carry.normal_force[:, 1] + extra
    needed = np.maximum(
        (1.0 + RESERVE) * RobustModel(uncertain).robust_force(carry).commanded,
        soft_model(uncertain).hold(carry, uncertain.uncertainty)[0],
    )
    assert (commanded >= needed - 1e-6).all()
    assert commanded.max() <= needed.max() + 1e-6


def test_a_cell_without_uncertainty_gets_the_factor() -> None:
    assert Uncertainty().is_empty
    assert not Uncertainty(disturbance=np.array([0.0, 0.1, 0.0])).is_empty
    assert chosen_squeeze(rack().workcell, SqueezeSettings()).factor == 1.3
    assert chosen_squeeze(rack().workcell, SqueezeSettings(1.1)).factor == 1.1


@pytest.mark.parametrize(
    "arguments", [{"factor": 0.9}, {"factor": 100.0}, {"leader": 2}, {"smoothing": 0.0}]
)
def test_settings_are_checked(arguments: dict[str, float]) -> None:
    with pytest.raises(SettingsError):
        SqueezeSettings(**arguments)  # type: ignore[arg-type]
